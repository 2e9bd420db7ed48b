"""Ctrl-C, SIGTERM, and a terminal that closes: the first asks the engine to save and stop, the second quits at once."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from ..messages import Command, Quit, Stop
from .engine import Engine


@contextmanager
def quit_on_signals(engine: Engine) -> Iterator[list[int]]:
    """Within the block, SIGINT, SIGTERM and SIGHUP submit ``Quit``; another one ends the process. The list takes the
    number of the first. While a camera is on, a first SIGINT only switches that off, and the run is completed.

    SIGHUP stays ignored where it is (``nohup``). Call it in the main thread.
    """
    came: list[int] = []
    switched_off = False

    def handle(number: int, _: FrameType | None) -> None:
        nonlocal switched_off
        if number == signal.SIGINT and engine.live and not switched_off:
            switched_off = True
            print("camera off, completing the map; once more saves and ends", file=sys.stderr, flush=True)
            submit(Stop())
            return
        came.append(number)
        for each in numbers:
            signal.signal(each, signal.SIG_DFL)
        print("stopping after this frame and saving; once more quits at once", file=sys.stderr, flush=True)
        submit(Quit())

    def submit(command: Command) -> None:
        """In a thread of its own: the interrupted code may hold the lock that submit takes."""
        threading.Thread(target=engine.submit, args=(command,), daemon=True).start()

    numbers = [signal.SIGINT, signal.SIGTERM]
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    before = {number: signal.signal(number, handle) for number in numbers}
    try:
        yield came
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
