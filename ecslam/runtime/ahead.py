"""What can be done for a frame before its turn comes, by the threads that read it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ..config import Config
from ..types import Frame, Intrinsics


def preparation(
    config: Callable[[], Config],
    camera: Intrinsics,
    device: str,
    number: Callable[[Frame], int] = lambda frame: frame.index,
) -> Callable[[Frame], Frame]:
    """Smooth the depth of frames, look at its relief and at their light, find the corners of those that will need them,
    make keyframes of those whose turn it will be, and put images for a GPU where it can fetch them by itself.

    config: asked for every frame. number: which frame of the run it will be, if all before it are of use. What is
    missing, or was found with other settings, is made good when it is needed.
    """

    def prepare(frame: Frame) -> Frame:
        from ..denoising import denoised  # torch is not imported at the start
        from ..earlier import light, relief
        from ..keyframes import prepared
        from ..pixels import find_corners

        now = config()
        frame = denoised(frame, now)
        if now.exposure or not now.movers:
            frame = replace(frame, relief=relief(frame.depth))
        if now.exposure:
            frame = replace(frame, light=light(frame.color))
        turn = number(frame) % now.keyframe_every == 0
        if now.fus and (now.tracking.iterations > 0 or turn):
            frame = replace(frame, corners=find_corners(frame.color, now))
        if turn:
            frame = prepared(frame, camera, now)
        if device.startswith("cuda"):
            frame = replace(frame, color=pinned(frame.color, device), depth=pinned(frame.depth, device))
        return frame

    return prepare


def pinned(array: np.ndarray, device: str) -> np.ndarray:
    """A copy in page-locked memory of ``device``, or the array itself where there is none to be had. numpy copies
    alone, torch would wake all its threads in each of the threads that read."""
    import torch

    try:
        with torch.cuda.device(torch.device(device).index or 0):
            held = torch.empty(array.nbytes, dtype=torch.uint8, pin_memory=True)
    except RuntimeError:
        return array
    copy = held.numpy().view(array.dtype).reshape(array.shape)
    np.copyto(copy, array)
    return copy
