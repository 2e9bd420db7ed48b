"""A sequence of colour and depth files: what all layouts on disk have in common."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from ..types import Frame, InputError, Intrinsics, Mesh
from .images import fill_pinholes, read_color, read_depth, shrunk, to_metres
from .lens import Lens
from .meshes import load_mesh
from .registration import Registration


@dataclass(eq=False)
class FileSequence:
    """The ``Sequence`` that every layout on disk opens to; nothing writes to it afterwards.

    intrinsics: of the depth images; their distortion is removed from both images on reading. color_size: (width,
    height) of the colour files, which are resized where it differs. registration: where colour is to be moved to depth;
    intrinsics are then its ``camera``. depth_scale: stored units per metre. times: [N] seconds. poses: [N, 4, 4]
    camera-to-world, NaN where a frame has none, or None. notes: what opening it brought to light, one sentence each.
    Raises InputError when these do not belong together.
    """

    name: str
    layout: str
    preset: str
    intrinsics: Intrinsics
    color_files: list[Path]
    depth_files: list[Path]
    depth_scale: float
    times: NDArray[np.float64]
    poses: NDArray[np.float64] | None
    color_size: tuple[int, int]
    mesh_file: Path | None = None
    notes: tuple[str, ...] = ()
    bounds: NDArray[np.float64] | None = None
    registration: Registration | None = None

    def __post_init__(self) -> None:
        k = self.intrinsics
        if not (k.fx > 0 and k.fy > 0 and 0 <= k.cx < k.width and 0 <= k.cy < k.height):
            values = f"fx {k.fx:g}, fy {k.fy:g}, cx {k.cx:g}, cy {k.cy:g}"
            raise InputError(
                f"{self._place()}: the intrinsics ({values}) do not fit {k.width}x{k.height} images; "
                "focal lengths must be positive and the centre inside the image"
            )
        if not 0 < self.depth_scale < np.inf:
            raise InputError(f"{self._place()}: depth scale {self.depth_scale:g} is not a positive number")

    def _place(self) -> Path:
        """Where it lies, for messages."""
        return self.depth_files[0].parent

    def __len__(self) -> int:
        return len(self.times)

    def __iter__(self) -> Iterator[Frame]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, index: int) -> Frame:
        """Read frame ``index``. Raises FrameError when a file is unreadable, IndexError outside 0 .. len - 1."""
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        color, depth = self._images(index)
        return Frame(index, float(self.times[index]), color, depth, self._pose(index))

    def timestamps(self) -> NDArray[np.float64]:
        """[N] seconds."""
        return self.times

    def poses_gt(self) -> NDArray[np.float64] | None:
        """[N, 4, 4] camera-to-world, NaN-filled where a frame has none, or None."""
        return self.poses

    def reference_mesh(self) -> Mesh | None:
        """The ground-truth surface, or None. Raises InputError when its file is unreadable."""
        return None if self.mesh_file is None else load_mesh(self.mesh_file)

    def _images(self, index: int) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Colour [H, W, 3] and depth [H, W] of a frame. Raises FrameError."""
        if self.registration is not None:
            stored = self.registration.depth
            return self.registration.registered(*self._stored(index, (stored.width, stored.height)))
        size = (self.intrinsics.width, self.intrinsics.height)
        color, depth = self._stored(index, size)
        if self.color_size != size:
            color = shrunk(color, size)
        return self._lens.straight_color(color), fill_pinholes(self._lens.straight_depth(depth))

    def _stored(self, index: int, size: tuple[int, int]) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Colour at ``color_size`` and metres at ``size`` (width, height), as lenses drew them. Raises FrameError."""
        color = read_color(self.color_files[index], self.color_size)
        return color, to_metres(read_depth(self.depth_files[index], size), self.depth_scale)

    def _pose(self, index: int) -> NDArray[np.float64] | None:
        if self.poses is None or not np.isfinite(self.poses[index]).all():
            return None
        return cast("NDArray[np.float64]", self.poses[index])

    @cached_property
    def _lens(self) -> Lens:
        return Lens(self.intrinsics)
