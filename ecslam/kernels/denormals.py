"""Numbers below 1e-38: the weights of samples far behind a surface, and Adam's moments of what is no longer seen.

Intel's processors leave their fast path for each of them, and arithmetic takes a hundred times as long.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch

SMALLEST, ONE = np.float32(1e-45), np.float32(1)


@contextmanager
def flushed() -> Iterator[None]:
    """Within, they count as 0 in this thread, and for good in all that begin within: torch's own among them where it
    has not begun them yet. Outside nothing changes, since that is up to whoever calls. Also a decorator."""
    if flushes():
        yield
        return
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(False)


def flushes() -> bool:
    """Whether they count as 0 in this thread."""
    return bool(SMALLEST * ONE == 0)
