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


class Orders(NamedTuple):
    """What a reader is told first. sequence: pickled. slots: how many."""

    sequence: bytes
    camera: Intrinsics
    slots: int


class Order(NamedTuple):
    """Read the frame ``number``, prepare it as ``config`` wants it, and put its images into ``slot``."""

    number: int
    config: Config
    slot: int


def serve(line: int, memory: int) -> None:
    """Do what comes over a ``line``, until it is cut; both are open files, ``memory`` that of the slots."""
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
    now: list[Config] = []
    prepare = preparation(lambda: now[0], orders.camera, "cpu")
    while True:
        order: Order = line.recv()
        now[:] = [order.config]
        found = read(sequence, prepare, order.number)
        line.send(slots.put(found, order.slot) if isinstance(found, Frame) else found)
