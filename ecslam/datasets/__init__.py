"""Sequences of RGB-D images: one file a layout, opened by ``open_sequence`` without saying which it is."""

from .addresses import calibrated_address, lasting_address, named_calibration_only, split_address
from .pace import KeepingUp, Live, Playback
from .prefetch import Prefetch
from .registry import calibration_place, open_sequence
from .views import problems, select_frames

__all__ = [
    "KeepingUp",
    "Live",
    "Playback",
    "Prefetch",
    "calibrated_address",
    "calibration_place",
    "lasting_address",
    "named_calibration_only",
    "open_sequence",
    "problems",
    "select_frames",
    "split_address",
]
