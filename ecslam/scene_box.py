"""The scene box: where the map lies. Given, or around what the first frame measured; it grows with what is seen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .config import FieldConfig
from .field import box_of_points
from .pixels import Pixels

OUTSIDE_SHARE = 0.01
POINTS = 4096  # of a keyframe, about, looked at to see whether the box holds them


class SceneBox:
    """Says where the map begins and how far it has to reach. given: [2, 3] metres, or None."""

    def __init__(self, config: FieldConfig, given: NDArray[np.float64] | None) -> None:
        """given: for want of one in the configuration."""
        self.given = given if config.box is None else np.array(config.box, np.float64).reshape(2, 3)
        self._config, self._told = config, 0.0

    def first(self, pixels: Pixels, c2w: NDArray[np.float64]) -> NDArray[np.float64]:
        """The box [2, 3] to begin with: as given, or around the points of the first keyframe, seen from c2w [4, 4]."""
        return self._around(pixels.in_world(c2w)) if self.given is None else self.given

    def check(
        self, box: NDArray[np.float32], pixels: Pixels, c2w: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64] | None, str]:
        """What to extend ``box`` [2, 3] by where over 1 % of a keyframe's points lie outside it, else None; and a note.
        A box from the configuration stays, and the note says how many lie outside, again when they have doubled."""
        points = pixels.every(-(-len(pixels) // POINTS) or 1).in_world(c2w)
        low, high = box
        if not len(points) or ((points.min(0) >= low) & (points.max(0) <= high)).all():
            return None, ""
        x, y, z = ((points < low) | (points > high)).T
        outside = np.mean(x | y | z)
        if self._config.box is None:
            return self._around(points) if outside > OUTSIDE_SHARE else None, ""
        if outside <= max(OUTSIDE_SHARE, 2 * self._told):
            return None, ""
        self._told = outside
        return None, f"{outside:.0%} of the rays end outside field.box and are not mapped; widen it or leave it out"

    def _around(self, points: NDArray[np.float32]) -> NDArray[np.float64]:
        return box_of_points(points, self._config.box_margin_m)
