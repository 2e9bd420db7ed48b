"""Earlier views for tests."""

import numpy as np

from ecslam.earlier import EarlierViews
from ecslam.types import Frame


def remembering(frames: list[Frame]) -> tuple[EarlierViews, np.ndarray]:
    """What is remembered of these frames as keyframes, and the poses of these."""
    earlier = EarlierViews()
    for number, frame in enumerate(frames):
        earlier.remember(frame, number)
    return earlier, np.stack([frame.c2w_gt for frame in frames])
