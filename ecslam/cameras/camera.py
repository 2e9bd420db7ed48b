"""What a camera is to the rest: images with times, and how it is built."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ..datasets.recording import Rig


class Shot(NamedTuple):
    """What a camera sees at once. seconds: when. color: uint8 [h, w, 3], RGB. depth: uint16 [H, W], in the units of its
    ``rig``, 0 where there is none."""

    seconds: float
    color: NDArray[np.uint8]
    depth: NDArray[np.uint16]


class Camera(Protocol):
    """A depth camera that is on. Its arrays are the reader's to keep."""

    rig: Rig

    def read(self) -> Shot | None:
        """Wait for the next shot, some seconds at most; None when there will be no more. Raises InputError when the
        camera fails."""
        ...

    def close(self) -> None:
        """Switch it off."""
        ...
