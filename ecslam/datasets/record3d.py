"""Record3D (.r3d, or unzipped): metadata, rgbd/0.jpg, rgbd/0.depth in metres and rgbd/0.conf, compressed by LZFSE.

An iPhone's or iPad's LiDAR or face camera, from the app's author at https://github.com/marek-simonik/record3d (issues
7, 27, 63, 64, 81, 93): ``K`` goes column by column; a pose is qx qy qz qw x y z, camera-to-world with OpenGL's axes,
and the identity throughout from the face camera; pictures lie as they were held. Unknown depth is NaN.
"""

from __future__ import annotations

import json
import re
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..indices import evenly
from ..types import FrameError, InputError, Intrinsics
from .files import FileSequence
from .images import HEADER_BYTES, decode_color, parse_header, read_bytes
from .reading import MAX_PIXELS, MAX_TEXT_BYTES, OPENGL, finite_poses, posed, rigid, same_shape
from .stray import ARKIT_TRUTH, FINER, LEAST_CONFIDENCE, finer, focus_note

SUFFIXES = (".r3d",)
FRAMES, DEPTH = "rgbd", r"rgbd/(\d{1,9})\.depth"
LIDAR = (192, 256)  # where metadata of an old version do not say
MOST_IMAGE_BYTES = 64 << 20
LEAST_CODED_BYTES, MOST_SPARE_BYTES = 12, 4096  # of LZFSE, beside what it holds


def sniff(path: Path) -> bool:
    """Whether it is an .r3d file, or a folder with metadata and rgbd/N.depth."""
    if path.is_file():
        return path.suffix.lower() in SUFFIXES
    return (path / "metadata").is_file() and any(re.fullmatch(DEPTH, name) for name in _names(path))


class Parts:
    """The files of a recording, zipped or not; from any thread."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._zip = zipfile.ZipFile(path) if path.is_file() else None
        except (zipfile.BadZipFile, NotImplementedError, ValueError):
            raise InputError(f"{path}: not a recording of Record3D, or a truncated one; export it again") from None
        self.names = frozenset(self._zip.namelist() if self._zip else ["metadata", *_names(path)])

    def read(self, name: str, limit: int) -> bytes:
        """The first ``limit`` bytes. Raises FrameError."""
        if self._zip is None:
            return read_bytes(self.path / name, limit)
        try:
            with self._zip.open(name) as part:
                return part.read(limit)
        except (KeyError, zipfile.BadZipFile, zlib.error, RuntimeError, EOFError, OSError):
            raise FrameError(f"{self.path}: {name} is missing or damaged; export it again") from None


@dataclass(frozen=True)
class Metadata:
    """depth_size: (width, height). poses: [M, 4, 4] OpenCV's axes. lens: [M, 4] fx, fy, cx, cy of colour, or None;
    times: [M] seconds, or None."""

    camera: Intrinsics
    depth_size: tuple[int, int]
    fps: float
    poses: NDArray[np.float64]
    lens: NDArray[np.float64] | None
    times: NDArray[np.float64] | None


@dataclass(eq=False, kw_only=True)
class PhoneVideo(FileSequence):
    """Colour is shrunk, depth made finer, to one size. numbers: of frames. depth_size: (width, height) as stored."""

    parts: Parts
    numbers: list[int]
    depth_size: tuple[int, int]
    confident: bool

    def _place(self) -> Path:
        return self.parts.path

    def _images(self, index: int) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        name = f"{FRAMES}/{self.numbers[index]}"
        size = (self.intrinsics.width, self.intrinsics.height)
        color: NDArray[Any] = decode_color(
            f"{self.parts.path}: {name}.jpg", self.parts.read(f"{name}.jpg", MOST_IMAGE_BYTES), self.color_size
        )
        depth = np.nan_to_num(self._decoded(f"{name}.depth", "<f4"), nan=0, posinf=0, neginf=0).clip(0)
        if self.confident:
            depth[self._decoded(f"{name}.conf", "u1") < LEAST_CONFIDENCE] = 0
        if size != self.color_size:
            color = cv2.resize(color, size, interpolation=cv2.INTER_AREA)
        return color, depth if size == self.depth_size else finer(depth, size)

    def _decoded(self, name: str, kind: str) -> NDArray[Any]:
        """[H, W] of ``depth_size``. Raises FrameError."""
        import lzfse

        place = f"{self.parts.path}: {name}"
        length = self.depth_size[0] * self.depth_size[1] * np.dtype(kind).itemsize
        data = self.parts.read(name, length + MOST_SPARE_BYTES + 1)
        claimed = int.from_bytes(data[4:8], "little")
        if not LEAST_CODED_BYTES <= len(data) <= length + MOST_SPARE_BYTES or claimed > length:
            raise FrameError(f"{place} is damaged; export it again")
        try:
            raw = lzfse.decompress(data)
        except (lzfse.error, MemoryError):
            raise FrameError(f"{place} is damaged; export it again") from None
        if len(raw) != length:
            raise FrameError(f"{place} holds {len(raw)} bytes, not the {length} of its size; export it again")
        return np.frombuffer(raw, kind).reshape(self.depth_size[::-1])


def open(path: Path) -> PhoneVideo:
    """Open the file or folder. Raises InputError, also where the codec is not installed."""
    try:
        import lzfse  # noqa: F401
    except ImportError:
        raise InputError(f"{path}: reading Record3D needs lzfse; install it with: pip install lzfse") from None
    parts = Parts(path)
    about = _metadata(parts)
    found = sorted(int(match[1]) for match in (re.fullmatch(DEPTH, name) for name in parts.names) if match)
    numbers = [number for number in found if f"{FRAMES}/{number}.jpg" in parts.names]
    if not numbers:
        raise InputError(f"{path}: no frame has both rgbd/N.jpg and rgbd/N.depth; export it again as .r3d")
    color_size = _color_size(parts, numbers)
    same_shape(color_size, about.depth_size, path)
    factor = FINER if color_size[0] >= FINER * about.depth_size[0] else 1
    poses = np.full((len(numbers), 4, 4), np.nan)
    posed = [i for i, number in enumerate(numbers) if number < len(about.poses)]
    poses[posed] = about.poses[[numbers[i] for i in posed]]
    known = finite_poses(poses)
    unmoved = known.any() and bool((poses[known] == OPENGL).all())
    confident = any(name.endswith(".conf") for name in parts.names)
    stamped = about.times is not None and numbers[-1] < len(about.times)
    return PhoneVideo(
        name=path.name if path.is_dir() else path.stem,
        layout="record3d",
        preset="lite",
        intrinsics=about.camera.resized(factor * about.depth_size[0], factor * about.depth_size[1]),
        color_files=[],
        depth_files=[],
        depth_scale=1.0,
        times=about.times[numbers] if about.times is not None and stamped else np.array(numbers) / about.fps,
        poses=poses if known.any() and not unmoved else None,
        color_size=color_size,
        notes=tuple(_notes(about, len(found) - len(numbers), int((~known).sum()), bool(unmoved), confident)),
        parts=parts,
        numbers=numbers,
        depth_size=about.depth_size,
        confident=confident,
    )


def _names(folder: Path) -> list[str]:
    return [f"{FRAMES}/{each.name}" for each in (folder / FRAMES).iterdir()] if (folder / FRAMES).is_dir() else []


def _color_size(parts: Parts, numbers: list[int]) -> tuple[int, int]:
    """Of the first readable one of some spread pictures; metadata may tell another one, of the same shape."""
    for i in evenly(len(numbers), 9):
        name = f"{FRAMES}/{numbers[i]}.jpg"
        try:
            return parse_header(f"{parts.path}: {name}", parts.read(name, HEADER_BYTES)).size
        except FrameError:
            continue
    raise InputError(f"{parts.path}: none of the pictures looked at is readable; export it again")


def _metadata(parts: Parts) -> Metadata:
    place = f"{parts.path}: metadata"
    try:
        values = json.loads(parts.read("metadata", MAX_TEXT_BYTES))
        k = np.array(values["K"], np.float64).reshape(3, 3).T
        size, fps = (int(values["w"]), int(values["h"])), float(values.get("fps", 60))
        depth_size = int(values.get("dw", LIDAR[0])), int(values.get("dh", LIDAR[1]))
        lens = _table(values.get("perFrameIntrinsicCoeffs"), 4)
        poses, times = _table(values.get("poses"), 7), _table(values.get("frameTimestamps"), 1)
    except FrameError:
        raise InputError(f"{parts.path}: no readable metadata in it; export it again as .r3d") from None
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError, AttributeError) as error:
        raise InputError(f"{place}: not as the app writes it ({type(error).__name__}: {error})") from None
    if min(*size, *depth_size) < 1 or depth_size[0] * depth_size[1] * FINER**2 > MAX_PIXELS or not 0 < fps < np.inf:
        raise InputError(f"{place}: w, h, dw, dh or fps is out of range; export it again")
    good = None if lens is None else lens[np.isfinite(lens).all(1) & (lens > 0).all(1)]
    usual = k[[0, 1, 0, 1], [0, 1, 2, 2]] if good is None or not len(good) else np.median(good, axis=0)
    fx, fy, cx, cy = usual.tolist()
    return Metadata(
        Intrinsics(fx, fy, cx, cy, *size),
        depth_size,
        fps,
        _matrices(poses if poses is not None else np.empty((0, 7))),
        good,
        times[:, 0] if times is not None and np.isfinite(times).all() else None,
    )


def _table(rows: Any, columns: int) -> NDArray[np.float64] | None:
    """[M, columns]; None where there is none. Raises ValueError."""
    return np.array(rows, np.float64).reshape(len(rows), columns) if rows else None


def _matrices(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """[M, 4, 4] of rows qx qy qz qw x y z with OpenGL's axes: OpenCV's axes, NaN where a row is no pose."""
    return rigid(posed(rows[:, 4:], rows[:, :4]))[0] @ OPENGL


def _notes(about: Metadata, alone: int, without: int, unmoved: bool, confident: bool) -> Iterator[str]:
    if unmoved:
        yield "each of its poses is the identity, as from the face camera, which is taken for none"
    elif len(about.poses):
        yield ARKIT_TRUTH
        if without:
            yield f"{without} frames have no ground truth"
    if about.lens is not None:
        yield from focus_note(about.lens[:, 0])
    if alone:
        yield f"{alone} depth images have no picture and are left out"
    if not confident:
        yield "no confidence (rgbd/N.conf): depth at edges may be wrong by much"
