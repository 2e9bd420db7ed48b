"""A process that reads and prepares frames for another one: see ``readers``. It ends when nobody listens any more."""

from __future__ import annotations

import pickle
from multiprocessing.connection import Connection
from typing import NamedTuple

from ..config import Config
from ..datasets.prefetch import read
from ..datasets.slots import Slots
from ..types import Frame, Intrinsics
from .ahead import preparation

GREETING = "ready"


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
        _serve(Connection(line), memory)
    except (EOFError, OSError):
        return


def _serve(line: Connection, memory: int) -> None:
    import cv2
    import torch

    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    line.send(GREETING)
    orders: Orders = line.recv()
    sequence, slots = pickle.loads(orders.sequence), Slots(orders.camera, orders.slots, memory)
    now = [orders.trial.config]
    prepare = preparation(lambda: now[0], orders.camera, "cpu")
    read(sequence, prepare, orders.trial.number)
    line.send(GREETING)
    while True:
        order: Order = line.recv()
        now[:] = [order.config]
        found = read(sequence, prepare, order.number)
        line.send(slots.put(found, order.slot) if isinstance(found, Frame) else found)
