"""Frames read and prepared by processes: threads that do so hold Python's lock a little for every frame, and the
engine's thread, which lets go of it in every call of torch, has to wait for it as often (measured on 16 cores: it took
twice as long)."""

from __future__ import annotations

import os
import pickle
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress

from ..config import Config
from ..cores import cores
from ..datasets.prefetch import MOST_WORKERS, read
from ..datasets.slots import RESTING, Slots
from ..types import Frame, FrameError, Sequence
from .reader import CUT, GREETING, Line, Order, Orders

FEWEST_CORES = 6
LEFT = 2  # cores, for the engine
HELD = 4  # frames that the engine may hold, the last one and the one at work among them
MOST_BYTES = 16 << 20  # of a sequence, which every process is sent
THREADS = "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"
KEPT = {"MALLOC_MMAP_THRESHOLD_": str(32 << 20), "MALLOC_TRIM_THRESHOLD_": str(128 << 20)}
ALONE = KEPT | dict.fromkeys(THREADS, "1") | {"CUDA_VISIBLE_DEVICES": ""}
"""What a process is told by its environment: to keep the memory of images for the next ones (glibc), to take one core,
and to leave the GPU alone."""
PROGRAM = "import sys; sys.path[:] = {path!r}; from ecslam.runtime.reader import serve; serve({line}, {memory})"


def portable(sequence: Sequence, device: str) -> bytes | None:
    """The sequence, pickled, where processes should read it; None where threads do it as well: without a GPU, on few
    cores, where it cannot be sent or lies in memory, as what is built in, and where its class is not ours, which a
    process may not find."""
    enough = device.startswith("cuda") and hasattr(os, "memfd_create") and cores() >= FEWEST_CORES
    ours = type(sequence).__module__.startswith(__name__.partition(".")[0])
    if not (enough and ours) or sequence.layout == "synthetic":
        return None
    try:
        sent = pickle.dumps(sequence)
    except (pickle.PicklingError, TypeError, AttributeError):
        return None
    return sent if len(sent) <= MOST_BYTES else None


def processes() -> int:
    """How many are worth starting."""
    return min(cores() - LEFT, MOST_WORKERS)


class ReadingProcesses:
    """``Readers`` of ``datasets.prefetch``: threads that have a process each. One whose process is not up yet, or has
    died, reads by itself, and so does whoever finds no slot free."""

    def __init__(
        self,
        sent: bytes,
        sequence: Sequence,
        config: Callable[[], Config],
        prepare: Callable[[Frame], Frame],
        count: int,
        register: Callable[[Slots], None] = lambda slots: None,
    ) -> None:
        """sent: the ``sequence``, pickled. config: asked for every frame. prepare: what the threads make of frames,
        which must be what ``ahead.preparation`` makes of them. register: makes the slots known to a GPU. Raises OSError
        where no memory can be shared."""
        self.ahead = 2 * count
        self._sequence, self._config, self._prepare = sequence, config, prepare
        self._slots = Slots(sequence.intrinsics, self.ahead + HELD + RESTING)
        self._orders = Orders(sent, sequence.intrinsics, self._slots.count, Order(0, config(), 0))
        self._own = threading.local()
        self._helpers: list[Helper] = []
        self._pool = ThreadPoolExecutor(count, "prefetch", self._take_helper)
        self._registered = self._pool.submit(register, self._slots)

    def submit(self, index: int) -> Future[Frame | FrameError]:
        """See ``Readers``."""
        return self._pool.submit(self._read, index)

    def close(self) -> None:
        """See ``Readers``."""
        self._pool.shutdown(cancel_futures=True)
        for helper in self._helpers:
            helper.dismiss()
        self._helpers.clear()

    def _take_helper(self) -> None:
        self._own.helper = None
        with suppress(OSError):
            self._own.helper = Helper(self._orders, self._slots.file)
            self._helpers.append(self._own.helper)

    def _read(self, index: int) -> Frame | FrameError:
        helper: Helper | None = self._own.helper
        up = helper is not None and helper.ready() and self._registered.done()
        slot = self._slots.take() if up else None
        if helper is None or slot is None:
            return read(self._sequence, self._prepare, index)
        found = helper.read(Order(index, self._config(), slot))
        if isinstance(found, Frame):
            return self._slots.found(found, slot)
        self._slots.give_back(slot)
        return found or read(self._sequence, self._prepare, index)


class Helper:
    """A process that reads for the thread that has started it."""

    def __init__(self, orders: Orders, memory: int) -> None:
        """memory: the open file of the slots."""
        self._orders, self._greeted, self._gone = orders, 0, False
        mine, theirs = socket.socketpair()
        self._line = Line(mine)
        with theirs:
            program = PROGRAM.format(path=sys.path, line=theirs.fileno(), memory=memory)
            self._process = subprocess.Popen(
                [sys.executable, "-c", program],
                stdin=subprocess.DEVNULL,
                pass_fds=(theirs.fileno(), memory),
                env=os.environ | ALONE,
                start_new_session=True,  # Ctrl-C is for the program that was started
            )

    def ready(self) -> bool:
        """Whether it takes orders by now."""
        try:
            if self._greeted < 2 and not self._gone and self._line.waiting():
                self._greeted += self._line.receive() == GREETING
                if self._greeted == 1:
                    self._line.send(self._orders)
        except CUT:
            self._gone = True
        return self._greeted == 2 and not self._gone

    def read(self, order: Order) -> Frame | FrameError | None:
        """What came of an order; None where the process has died."""
        try:
            self._line.send(order)
            found: Frame | FrameError = self._line.receive()
            return found
        except CUT:
            self._gone = True
            return None

    def dismiss(self) -> None:
        """Let it end, and see to it that it does."""
        self._line.close()
        self._process.terminate()
        self._process.wait()


def page_lock(device: str, slots: Slots) -> None:
    """Let a GPU fetch from the slots by itself. Where that cannot be, the host copies, as it does anyway."""
    import numpy as np
    import torch

    memory = np.frombuffer(slots.memory, np.uint8)
    pointer, runtime = memory.ctypes.data, torch.cuda.cudart()

    def unlock() -> None:
        if not sys.is_finalizing():
            with torch.cuda.device(index):
                torch.cuda.synchronize()
                runtime.cudaHostUnregister(pointer)

    index = torch.device(device).index or 0
    with torch.cuda.device(index):
        if int(runtime.cudaHostRegister(pointer, memory.nbytes, 0)) == 0:
            slots.at_end(unlock)
