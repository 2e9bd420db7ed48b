"""What a camera is really like, in a small file beside a recording, and the recording as that camera saw it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..atomic import write_named
from ..strict_yaml import is_number, kind_of, nearest, parse_yaml
from ..types import Calibration, Frame, InputError, Intrinsics, Sequence
from .lens import LookUp
from .reading import read_text
from .views import SequenceView

FILE = "calibration.yaml"
PINHOLE, SIZE, ERRORS = ("fx", "fy", "cx", "cy"), ("width", "height"), ("radial", "inverse_depth")
KEYS = (*PINHOLE, *SIZE, *ERRORS)
MOST = {"radial": 0.5, "inverse_depth": 0.2}
ABOUT = """\
# What a depth camera is really like. fx, fy, cx, cy in pixels of width x height images. A measured depth d, in metres,
# becomes 1/(1/d + inverse_depth); a pixel's ray (x, y, 1) becomes (s x, s y, 1) with s = 1 + radial (x^2 + y^2).
"""
SAMPLES = 10_000
OUTSIDE = -9.0  # pixels


def read_calibration(path: Path) -> Calibration:
    """The calibration in a YAML file that holds ``KEYS``; ``ERRORS`` may be left out and are 0 then.

    Raises InputError, in one line that names the file, for what cannot be read or is no camera.
    """
    values = parse_yaml(read_text(path), str(path))
    if not isinstance(values, Mapping):
        raise InputError(f"{path}: must hold keys and values such as fx: 525, not {kind_of(values)}")
    for key in values:
        if key not in KEYS:
            raise InputError(f"{path}: unknown key {key!r}{nearest(str(key), list(KEYS))}; it takes {', '.join(KEYS)}")
    missing = [key for key in KEYS if key not in values and key not in ERRORS]
    if missing:
        raise InputError(f"{path}: {', '.join(missing)} missing; add what the calibration says")
    given = {key: _number(path, key, value) for key, value in values.items()}
    fx, fy, cx, cy, width, height = (given[key] for key in (*PINHOLE, *SIZE))
    camera = Intrinsics(fx, fy, cx, cy, int(width), int(height))
    if not (0 <= camera.cx < camera.width and 0 <= camera.cy < camera.height):
        raise InputError(
            f"{path}: the principal point ({camera.cx:g}, {camera.cy:g}) lies outside {camera.width}x{camera.height} "
            "images; correct cx and cy, or width and height"
        )
    return Calibration(camera, *(given.get(key, 0.0) for key in ERRORS))


def _number(path: Path, key: str, value: Any) -> float:
    """A value that its key can have. Raises InputError."""
    if not is_number(value):
        raise InputError(f"{path}: {key} must be a finite number, not {kind_of(value)} {value!r}")
    if key in SIZE and value != int(value):
        raise InputError(f"{path}: {key} must be a whole number of pixels, not {value!r}")
    if key in (*PINHOLE[:2], *SIZE) and value <= 0:
        raise InputError(f"{path}: {key} = {value:g}; it must be above 0, in pixels")
    most = MOST.get(key, np.inf)
    if abs(value) > most:
        raise InputError(f"{path}: {key} = {value:g} is out of range; it must lie in {-most:g} .. {most:g}")
    return float(value)


def write_calibration(path: Path, calibration: Calibration) -> None:
    """Replace ``path`` by a file that ``read_calibration`` reads back to an equal one, where its camera is an ideal
    pinhole without a rolling shutter (neither is part of the file). Raises InputError when it cannot be written."""
    k = calibration.camera
    given = {key: float(getattr(k, key)) for key in PINHOLE} | {key: int(getattr(k, key)) for key in SIZE}
    given |= {key: float(getattr(calibration, key)) for key in ERRORS}
    text = ABOUT + "".join(f"{key}: {value!r}\n" for key, value in given.items())
    write_named(path, text.encode())


def calibration_of(sequence: Sequence) -> Calibration:
    """The camera of a sequence's frames, with what has been put right in them already by a calibration."""
    camera, inner = replace(sequence.intrinsics, distortion=()), sequence
    while isinstance(inner, SequenceView):
        if isinstance(inner, CalibratedView):
            return replace(inner.calibration, camera=camera)
        inner = inner.base
    return Calibration(camera)


def calibrated_by(sequence: Sequence, path: Path) -> SequenceView:
    """The sequence as the camera in a file saw it, with a note that says so. Raises InputError naming the file."""
    calibration = read_calibration(path)
    try:
        view = calibrated(sequence, calibration)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    errors = "".join(f", {key} {value:g}" for key in ERRORS if (value := getattr(calibration, key)))
    view.notes = (*view.notes, f"the camera is that of {path.name}{errors}")
    return view


def calibrated(sequence: Sequence, calibration: Calibration) -> SequenceView:
    """The same sequence as its camera really saw it. Raises InputError where the calibration is of images of another
    shape or bends them back over themselves."""
    return CalibratedView(sequence, np.arange(len(sequence)), calibration)


@dataclass(eq=False)
class CalibratedView(SequenceView):
    """Frames of a sequence as ``calibration`` says that they are. See ``calibrated``."""

    calibration: Calibration

    def __post_init__(self) -> None:
        super().__post_init__()
        seen, k = self.base.intrinsics, self.calibration.camera
        if seen.width * k.height != seen.height * k.width:
            raise InputError(
                f"a calibration of {k.width}x{k.height} images, but these are {seen.width}x{seen.height}; "
                "give that of their camera"
            )
        camera = k.resized(seen.width, seen.height)
        self.intrinsics = replace(camera, distortion=(), readout_s=seen.readout_s)
        farthest = _farthest(self.intrinsics)
        if 1 + 3 * self.calibration.radial * farthest**2 <= 0:
            raise InputError(
                f"radial = {self.calibration.radial:g} folds the corners of the image back; it must be above "
                f"{-1 / (3 * farthest**2):.3g} with this camera"
            )

    def __getitem__(self, index: int) -> Frame:
        """Read frame ``index`` of the view. Raises FrameError, and IndexError outside 0 .. len - 1."""
        frame = super().__getitem__(index)
        frame.require_fit(self.intrinsics)
        color, depth = frame.color, frame.depth
        if self.calibration.radial:
            color, depth = self._straight.color(color), self._straight.depth(depth)
        return replace(frame, color=color, depth=_corrected(depth, self.calibration.inverse_depth))

    @cached_property
    def _straight(self) -> LookUp:
        """Where each pixel of the pinhole finds what it sees: the bend is told for pixels as they are stored, so its
        inverse is looked up, along a radius; what is beyond the farthest one is sent out of the image."""
        k = self.intrinsics
        stored = np.linspace(0, _farthest(k), SAMPLES)
        v, u = np.mgrid[: k.height, : k.width]
        x, y = (u - k.cx) / k.fx, (v - k.cy) / k.fy
        radius = np.hypot(x, y)
        found = np.interp(radius, stored * (1 + self.calibration.radial * stored**2), stored, right=2 * stored[-1])
        shrink = np.divide(found, radius, out=np.ones_like(radius), where=radius > 0)
        u, v = k.cx + k.fx * x * shrink, k.cy + k.fy * y * shrink
        inside = (u >= 0) & (u <= k.width - 1) & (v >= 0) & (v <= k.height - 1)
        return LookUp(*(np.where(inside, at, OUTSIDE) for at in (u, v)))


def _farthest(camera: Intrinsics) -> float:
    """How far from the optical axis the farthest pixel sees, at a distance of 1."""
    x = max(camera.cx, camera.width - 1 - camera.cx) / camera.fx
    y = max(camera.cy, camera.height - 1 - camera.cy) / camera.fy
    return float(np.hypot(x, y))


def _corrected(depth: NDArray[np.float32], inverse_depth: float) -> NDArray[np.float32]:
    """Depth [H, W] whose inverse is larger by ``inverse_depth``; 0 where that would not be positive."""
    factor = 1 + np.float32(inverse_depth) * depth
    return np.divide(depth, factor, out=np.zeros_like(depth), where=factor > 0)
