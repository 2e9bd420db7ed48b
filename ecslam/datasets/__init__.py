"""Sequences of RGB-D images: one file a layout, opened by ``open_sequence`` without saying which it is."""

from .prefetch import Prefetch
from .registry import open_sequence, split_address
from .views import problems, select_frames

__all__ = ["Prefetch", "open_sequence", "problems", "select_frames", "split_address"]
