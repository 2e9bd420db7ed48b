"""A process that reads and prepares frames for another one: see ``readers``. It ends when nobody listens any more."""

from __future__ import annotations

import pickle
import select
import socket
from contextlib import suppress
from typing import Any, NamedTuple

from ..config import Config
from ..datasets.prefetch import read
from ..datasets.slots import Slots
from ..types import Frame, Intrinsics
from .ahead import preparation

GREETING = "ready"
CUT = EOFError, OSError, pickle.UnpicklingError


class Order(NamedTuple):
    """Read the frame ``number``, prepare it as ``config`` wants it, and put its images into ``slot``."""

    number: int
    config: Config
    slot: int


class Orders(NamedTuple):
    """What a reader is told first. sequence: pickled. slots: how many. trial: read for practice, which on a new machine
    compiles what there is to compile."""

    sequence: bytes
    camera: Intrinsics
    slots: int
    trial: Order


def serve(line: int, memory: int) -> None:
    """Do what comes over a ``line``, until it is cut; both are open files, ``memory`` that of the slots. Greets when it
    can be told more, and when it has done its trial."""
    try:
        _serve(Line(socket.socket(fileno=line)), memory)
    except CUT:
        return


class Line:
    """Objects over a socket, in either direction. What it does raises one of ``CUT`` when the other end is gone. Unlike
    those of ``multiprocessing`` it closes its file once, whoever comes first."""

    def __init__(self, end: socket.socket) -> None:
        self._end, self._file, self._coming = end, end.makefile("rwb"), select.poll()
        self._coming.register(end, select.POLLIN)

    def send(self, item: object) -> None:
        """Send it."""
        pickle.dump(item, self._file, pickle.HIGHEST_PROTOCOL)
        self._file.flush()

    def receive(self) -> Any:
        """What comes next; waits for it."""
        return pickle.load(self._file)

    def waiting(self) -> bool:
        """Whether something has come."""
        return bool(self._coming.poll(0))

    def close(self) -> None:
        """Cut it."""
        with suppress(*CUT):
            self._file.close()
        self._end.close()


def _serve(line: Line, memory: int) -> None:
    import cv2
    import torch

    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    line.send(GREETING)
    orders: Orders = line.receive()
    sequence, slots = pickle.loads(orders.sequence), Slots(orders.camera, orders.slots, memory)
    now = [orders.trial.config]
    prepare = preparation(lambda: now[0], orders.camera, "cpu")
    read(sequence, prepare, orders.trial.number)
    line.send(GREETING)
    while True:
        order: Order = line.receive()
        now[:] = [order.config]
        found = read(sequence, prepare, order.number)
        line.send(slots.put(found, order.slot) if isinstance(found, Frame) else found)
