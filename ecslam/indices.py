"""Choosing some of many."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def evenly(count: int, limit: int) -> NDArray[np.int64]:
    """At most ``limit`` of the indices 0 .. ``count`` - 1, evenly spread: the first and, of several, the last."""
    return np.linspace(0.5, count - 0.5, min(count, limit)).astype(np.int64)
