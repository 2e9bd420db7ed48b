"""ScanNet and BundleFusion (.sens): one file with colour, depth, poses and cameras, or a folder that holds one.

From https://github.com/ScanNet/ScanNet: SensReader's sensorData.h, and issues 2, 9, 39 and 92. Little-endian: a header,
then for each frame a fixed part and its two images. A pose without an estimate is all -inf; a recording that never had
poses has the identity everywhere. Time stamps are microseconds where there are any: ScanNet has none, but now and then
a frame with a random one. Colour and depth show the same view, so colour is resized to depth.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..types import FrameError, InputError, Intrinsics
from .files import FileSequence
from .images import decode_color, to_metres
from .reading import MAX_PIXELS, finite_poses, rigid, same_shape
from .scannet import find_mesh

SUFFIXES = (".sens",)
VERSION = 4
FRAMES_PER_S = 30.0
MOST_NAME_BYTES = 4096
MOST_FRAMES = 1 << 20
MOST_IMAGE_BYTES = 64 << 20
COLOR_KINDS, DEPTH_KINDS = ("raw", "png", "jpeg"), ("raw_ushort", "zlib_ushort", "occi_ushort")
READ_COLOR, READ_DEPTH = (1, 2), (1,)
USUAL_STEP_S = 1e-3, 1.0
SAME_CAMERA = 0.02  # of the image's width; ScanNet's two have centres that are up to 0.5 % apart
SAME_PLACE_M = 0.005

MATRIX = ("<f4", (4, 4))
HEADER = np.dtype(
    [
        ("color_camera", *MATRIX),
        ("color_place", *MATRIX),
        ("depth_camera", *MATRIX),
        ("depth_place", *MATRIX),
        ("color_kind", "<i4"),
        ("depth_kind", "<i4"),
        ("color_size", "<u4", 2),
        ("depth_size", "<u4", 2),
        ("depth_scale", "<f4"),
        ("frames", "<u8"),
    ]
)
FRAME = np.dtype(
    [
        ("pose", *MATRIX),
        ("color_us", "<u8"),
        ("depth_us", "<u8"),
        ("color_bytes", "<u8"),
        ("depth_bytes", "<u8"),
    ]
)


def sniff(path: Path) -> bool:
    """Whether it is a .sens file, or a folder that holds one."""
    return _is_stream(path) or (path.is_dir() and len(_streams(path)) == 1)


@dataclass(eq=False, kw_only=True)
class SensorStream(FileSequence):
    """Frames lie in one file. starts: [N] where their images begin, bytes. frames: [N] their fixed parts, ``FRAME``."""

    file: Path
    starts: NDArray[np.int64]
    frames: NDArray[Any]

    def _place(self) -> Path:
        return self.file

    def _stored(self, index: int, size: tuple[int, int]) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        place = f"{self.file}: frame {index}"
        lengths = int(self.frames["color_bytes"][index]), int(self.frames["depth_bytes"][index])
        if sum(lengths) > MOST_IMAGE_BYTES:
            raise FrameError(f"{place}: images of {sum(lengths) >> 20} MiB: damaged; copy the file again")
        try:
            with self.file.open("rb") as file:
                file.seek(int(self.starts[index]))
                data = file.read(sum(lengths))
        except OSError as error:
            raise FrameError(f"{place}: cannot be read ({error.strerror})") from None
        color = decode_color(f"{place}, colour", data[: lengths[0]], self.color_size)
        return color, to_metres(_inflate(f"{place}, depth", data[lengths[0] :], size), self.depth_scale)


def open(path: Path) -> SensorStream:
    """Open the file, or the folder that holds it; looks at the fixed part of each frame. Raises InputError."""
    file = _streams(path)[0] if path.is_dir() else path
    with file.open("rb", buffering=0) as stream:
        header = _read_header(stream, file)
        starts, frames = _walk(stream, file, int(header["frames"]))
    color_size, (width, height) = (tuple(header[name].tolist()) for name in ("color_size", "depth_size"))
    same_shape(color_size, (width, height), file)
    times, time_notes = _times(frames["depth_us"])
    poses, pose_notes = _poses(frames["pose"].astype(np.float64))
    return SensorStream(
        name=path.name if path.is_dir() else path.stem,
        layout="sens",
        preset="scannet",
        intrinsics=_camera(header["depth_camera"], width, height),
        color_files=[],
        depth_files=[],
        depth_scale=float(header["depth_scale"]),
        times=times,
        poses=poses,
        color_size=color_size,
        mesh_file=find_mesh(file.stem, file.parent),
        notes=(*_two_cameras(header), *time_notes, *pose_notes),
        file=file,
        starts=starts,
        frames=frames,
    )


def _streams(folder: Path) -> list[Path]:
    return [each for each in folder.iterdir() if _is_stream(each) and each.name[0] != "."]


def _is_stream(path: Path) -> bool:
    return path.suffix.lower() in SUFFIXES and path.is_file()


def _read_header(stream: BinaryIO, file: Path) -> Any:
    """A record of ``HEADER``, once it is sure that its numbers make sense."""
    start = stream.read(12)
    version, length = struct.unpack("<IQ", start) if len(start) == 12 else (None, 0)
    if version != VERSION:
        raise InputError(f"{file}: not a .sens file of version {VERSION}; is it the right file, and copied as a whole?")
    if length > MOST_NAME_BYTES:
        raise InputError(f"{file}: a sensor's name of {length} bytes: damaged; copy it again")
    stream.seek(length, 1)
    data = stream.read(HEADER.itemsize)
    if len(data) < HEADER.itemsize:
        raise InputError(f"{file}: truncated within its header; copy it again")
    header = np.frombuffer(data, HEADER)[0]
    for what in ("color", "depth"):
        width, height = header[f"{what}_size"].tolist()
        if not 0 < width * height <= MAX_PIXELS:
            raise InputError(f"{file}: {what} images of {width}x{height} pixels; damaged, or not made for this")
    _require_kind(file, "colour", int(header["color_kind"]), COLOR_KINDS, READ_COLOR)
    _require_kind(file, "depth", int(header["depth_kind"]), DEPTH_KINDS, READ_DEPTH)
    return header


def _require_kind(file: Path, what: str, kind: int, names: tuple[str, ...], read: tuple[int, ...]) -> None:
    if kind not in read:
        name = names[kind] if 0 <= kind < len(names) else f"unknown ({kind})"
        known = " or ".join(names[each] for each in read)
        raise InputError(f"{file}: {what} is compressed as {name}, but {known} is read; write the file again with that")


def _walk(stream: BinaryIO, file: Path, count: int) -> tuple[NDArray[np.int64], NDArray[Any]]:
    """Where the images of each frame begin, and the fixed parts."""
    if not 0 < count <= MOST_FRAMES:
        raise InputError(f"{file}: claims to have {count} frames; damaged, or never closed: copy or record it again")
    at = stream.tell()
    end = stream.seek(0, 2)
    starts, parts = [], []
    for index in range(count):
        stream.seek(at)
        part = stream.read(FRAME.itemsize)
        at += FRAME.itemsize
        starts.append(at)
        if len(part) == FRAME.itemsize:
            at += sum(struct.unpack_from("<QQ", part, FRAME.itemsize - 16))
        if len(part) < FRAME.itemsize or at > end:
            raise InputError(f"{file}: ends within frame {index} of {count}: truncated, or damaged; copy it again")
        parts.append(part)
    return np.array(starts, np.int64), np.frombuffer(b"".join(parts), FRAME)


def _inflate(place: str, data: bytes, size: tuple[int, int]) -> NDArray[np.uint16]:
    """uint16 [H, W] from zlib's format. Raises FrameError."""
    stream, length = zlib.decompressobj(), 2 * size[0] * size[1]
    try:
        raw = stream.decompress(data, length + 1)
    except zlib.error:
        raise FrameError(f"{place}: damaged; copy the file again") from None
    if len(raw) != length or not stream.eof:
        raise FrameError(f"{place}: not {size[0]}x{size[1]} values of 16 bits; damaged")
    return np.frombuffer(raw, "<u2").reshape(size[1], size[0])


def _camera(matrix: NDArray[np.float32], width: int, height: int) -> Intrinsics:
    k = matrix.tolist()
    return Intrinsics(k[0][0], k[1][1], k[0][2], k[1][2], width, height)


def _two_cameras(header: Any) -> Iterator[str]:
    """What the header says against colour and depth being one picture."""
    width, height = header["depth_size"].tolist()
    color = _camera(header["color_camera"], *header["color_size"].tolist()).resized(width, height)
    differs = np.abs(color.matrix() - _camera(header["depth_camera"], width, height).matrix()).max()
    if differs > SAME_CAMERA * width:
        yield f"by its header, the cameras of colour and depth differ by {differs:.0f} pixels: is colour registered?"
    apart = float(np.abs(header["color_place"] - header["depth_place"])[:3, 3].max())
    if apart > SAME_PLACE_M:
        yield f"by its header, the cameras of colour and depth are {apart * 100:.1f} cm apart: is colour registered?"


def _times(stamps_us: NDArray[np.uint64]) -> tuple[NDArray[np.float64], tuple[str, ...]]:
    """[N] seconds."""
    times = stamps_us.astype(np.float64) / 1e6
    steps = np.diff(times)
    if len(steps) and (steps > 0).all() and USUAL_STEP_S[0] <= np.median(steps) <= USUAL_STEP_S[1]:
        return times, ()
    note = f"its time stamps are of no use, so {FRAMES_PER_S:g} frames/s are assumed"
    return np.arange(len(times)) / FRAMES_PER_S, (note,) if stamps_us.any() else ()


def _poses(stored: NDArray[np.float64]) -> tuple[NDArray[np.float64] | None, tuple[str, ...]]:
    if (stored == np.eye(4)).all():
        return None, ("each of its poses is the identity, which is taken for none",)
    poses, notes = rigid(stored)
    return poses if finite_poses(poses).any() else None, notes
