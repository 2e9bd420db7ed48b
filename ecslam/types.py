"""The nouns of the project: frozen value types, with shapes and units in the docstrings. Imports numpy only."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray


def words(error: BaseException) -> str:
    """What an error says, or its kind where it says nothing."""
    return str(error) or type(error).__name__


class InputError(Exception):
    """Something the user gave cannot be used. The message is one line: what is wrong, where, and what to do.

    The command line prints it without a traceback and exits with code 2.
    """


class FrameError(InputError):
    """One frame cannot be read (missing, truncated, wrong size ...). A run skips the frame and counts it."""


@dataclass(frozen=True)
class Intrinsics:
    """Pinhole camera, OpenCV convention (x right, y down, z forward); all values in pixels.

    ``distortion`` holds OpenCV's (k1, k2, p1, p2[, k3]) and is empty for an ideal pinhole. A ``Sequence`` returns
    images that are already undistorted, so the engine never looks at it. ``readout_s``: seconds from the first row to
    the last where depth is read row by row (a rolling shutter), 0 where all of it is seen at once.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: tuple[float, ...] = ()
    readout_s: float = 0.0

    def matrix(self) -> NDArray[np.float64]:
        """The 3x3 calibration matrix K."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], np.float64)

    def resized(self, width: int, height: int) -> Intrinsics:
        """The same camera at another image size (pixel centres at integer coordinates)."""
        sx, sy = width / self.width, height / self.height
        return Intrinsics(
            self.fx * sx,
            self.fy * sy,
            (self.cx + 0.5) * sx - 0.5,
            (self.cy + 0.5) * sy - 0.5,
            width,
            height,
            self.distortion,
            self.readout_s,
        )


@dataclass(frozen=True)
class Calibration:
    """What a depth camera is really like, where a recording says otherwise.

    camera: the pinhole camera. radial: a pixel that ``camera`` puts on the ray (x, y, 1) saw along (s x, s y, 1), where
    s = 1 + radial (x^2 + y^2). inverse_depth: 1/m, added to the inverse of every measured depth, as an error of
    disparity is.
    """

    camera: Intrinsics
    radial: float = 0.0
    inverse_depth: float = 0.0


@dataclass(frozen=True)
class Corners:
    """Corners of an image. index: int64 [K], flat pixel indices, strongest first. settings: by what they were found."""

    index: NDArray[np.int64]
    settings: tuple[float, ...]


@dataclass(frozen=True)
class Frame:
    """One RGB-D image.

    index: position in the sequence. timestamp: seconds. color: uint8 [H, W, 3], RGB. depth: float32 [H, W], metres
    along the optical axis, exactly 0 where there is none (never NaN or Inf). c2w_gt: float64 [4, 4] camera-to-world
    ground truth in metres, or None. corners: of ``color``, where somebody has looked for them already. relief, light:
    of ``depth`` and ``color``, likewise (see ``earlier``). keyframe: what ``keyframes.prepared`` made of it. measured:
    what was measured, where ``depth`` has been smoothed since. gain: times which its luminance would be at the exposure
    of the first frame (see ``exposure``).
    """

    index: int
    timestamp: float
    color: NDArray[np.uint8]
    depth: NDArray[np.float32]
    c2w_gt: NDArray[np.float64] | None = None
    corners: Corners | None = None
    relief: NDArray[np.float32] | None = None
    light: NDArray[np.float32] | None = None
    keyframe: object = None
    measured: NDArray[np.float32] | None = None
    gain: float = 1.0

    def require_fit(self, camera: Intrinsics) -> None:
        """Raises FrameError where colour or depth are no arrays of the size of ``camera`` and of the type above."""
        size = camera.height, camera.width
        for name, kind, shape in (("color", "uint8", (*size, 3)), ("depth", "float32", size)):
            array: NDArray[np.generic] = getattr(self, name)
            if array.dtype != kind or array.shape != shape:
                found = f"{array.dtype} {list(array.shape)}"
                raise FrameError(f"frame {self.index}: {name} is {found}, but its camera makes {kind} {list(shape)}")


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh. vertices: float32 [V, 3] metres; faces: int32 [F, 3]; colors: uint8 [V, 3] RGB or None."""

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]
    colors: NDArray[np.uint8] | None = None

    def face_normals(self) -> NDArray[np.float64]:
        """Normals [F, 3] of the faces, each twice as long as its face is large."""
        a, b, c = (self.vertices[corner].astype(np.float64) for corner in self.faces.T)
        return np.cross(b - a, c - a)

    def vertex_normals(self) -> NDArray[np.float64]:
        """Unit normals [V, 3], the mean over the faces around a vertex weighted by area; zero where it has none."""
        face, total = self.face_normals(), np.zeros((len(self.vertices), 3))
        for corner in self.faces.T:
            for axis in range(3):
                total[:, axis] += np.bincount(corner, face[:, axis], len(total))
        return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)


@runtime_checkable
class Sequence(Protocol):
    """What a data set looks like to the engine. Indexing reads from disk; everything else is cheap.

    name: shown to people, e.g. ``7scenes-redkitchen``. layout: ``synthetic``, or as a file of ``datasets`` calls it,
    e.g. ``tum``. preset: the preset that suits this layout when the user names none. bounds: float64 [2, 3] scene box
    in metres in the frame of the ground truth, or None when unknown.
    """

    name: str
    layout: str
    preset: str
    intrinsics: Intrinsics
    bounds: NDArray[np.float64] | None

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> Frame:
        """Read frame ``index`` (0 <= index < len). Raises ``FrameError`` when it cannot be read."""
        ...

    def __iter__(self) -> Iterator[Frame]: ...

    def timestamps(self) -> NDArray[np.float64]:
        """[N] seconds, one per frame, without reading images."""
        ...

    def poses_gt(self) -> NDArray[np.float64] | None:
        """[N, 4, 4] camera-to-world, NaN-filled where a frame has none; None when the sequence has no ground truth."""
        ...

    def reference_mesh(self) -> Mesh | None:
        """The ground-truth surface, for evaluation only; None where there is none."""
        ...
