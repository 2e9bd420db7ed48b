"""Reading one image file that may be broken: headers first, nothing decoded that is not what the sequence promises.

OpenCV hands back None for an empty file, a full-size picture for half a JPEG, and gigabytes for a PNG of two megabytes
that claims to be huge. Here each of these is a ``FrameError`` that names the file.
"""

from __future__ import annotations

import stat
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from ..types import FrameError

SILENT = 0
(cv2.utils.logging if hasattr(cv2.utils, "logging") else cv2).setLogLevel(SILENT)  # broken files raise an exception

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
JPEG_SIGNATURE = b"\xff\xd8"
LAST_BYTES = {"PNG": b"IEND\xaeB`\x82", "JPEG": b"\xff\xd9"}
HEADER_BYTES = 1 << 18
NO_DEPTH = 65535  # what several cameras write instead of 0
MOST_PINHOLES = 0.03  # of the pixels; a Kinect's depth has under 0.002 of them
PINHOLE_RELIEF = 0.05  # of the distance

_PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}
_START_OF_FRAME = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_WITHOUT_LENGTH = frozenset(range(0xD0, 0xDA)) | {0x01}


@dataclass(frozen=True)
class ImageHeader:
    """What a file says about itself before it is decoded. bits: per channel."""

    kind: str
    width: int
    height: int
    channels: int
    bits: int

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self.width, self.height


def read_header(path: Path) -> ImageHeader:
    """The header of a PNG or JPEG file, from its first bytes. Raises FrameError."""
    return parse_header(path, read_bytes(path, HEADER_BYTES))


def read_color(path: Path, size: tuple[int, int]) -> NDArray[np.uint8]:
    """An 8-bit image as RGB uint8 [H, W, 3]. size: the (width, height) it must have. Raises FrameError."""
    return decode_color(path, read_bytes(path, _most_bytes(size) + 1), size)


def decode_color(place: Path | str, data: bytes, size: tuple[int, int]) -> NDArray[np.uint8]:
    """As ``read_color``, from the bytes of a PNG or JPEG file. place: where they are from, for messages."""
    header = _check(place, data, size)
    if header.bits != 8:
        raise FrameError(
            f"{place}: a {header.bits}-bit {header.kind}, but colour must have 8 bits; is it a depth image?"
        )
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    image = cast("NDArray[np.uint8]", _decode(place, data, flags, (size[1], size[0], 3), np.uint8))
    cv2.cvtColor(image, cv2.COLOR_BGR2RGB, dst=image)
    return image


def read_depth(path: Path, size: tuple[int, int]) -> NDArray[np.uint16]:
    """A 16-bit grey PNG, values as stored, uint16 [H, W]. size: the (width, height) it must have. Raises FrameError."""
    return decode_depth(path, read_bytes(path, _most_bytes(size) + 1), size)


def decode_depth(place: Path | str, data: bytes, size: tuple[int, int]) -> NDArray[np.uint16]:
    """As ``read_depth``, from the bytes of a PNG file. place: where they are from, for messages."""
    return cast("NDArray[np.uint16]", _decode_grey(place, data, size, "depth", np.uint16))


def read_levels(path: Path, size: tuple[int, int]) -> NDArray[np.uint8]:
    """An 8-bit grey PNG, values as stored, uint8 [H, W]. size: the (width, height) it must have. Raises FrameError."""
    data = read_bytes(path, _most_bytes(size) + 1)
    return cast("NDArray[np.uint8]", _decode_grey(path, data, size, "confidence", np.uint8))


def to_metres(raw: NDArray[np.uint16], scale: float) -> NDArray[np.float32]:
    """Depth in metres, float32 [H, W], from uint16 with ``scale`` units per metre; 0 and 65535 become exactly 0."""
    metres: NDArray[np.float32] = np.divide(raw, np.float32(scale), dtype=np.float32)
    metres[raw == NO_DEPTH] = 0
    return metres


def shrunk(color: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """A picture [H, W, 3] at ``size`` (width, height): a pixel of it is the mean of those that it covers."""
    return np.asarray(cv2.resize(color, size, interpolation=cv2.INTER_AREA), np.uint8)


def fill_pinholes(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """The same depth [H, W], 0 = none. Where it is speckled with single missing pixels, as after registration to a
    finer colour image without interpolation, those get what lies around them, except across depth edges: a surface seen
    through a sieve is hardly ever known where the next frame looks."""
    some = depth[::5] <= 0
    if (some[:, 1:-1] & ~some[:, :-2] & ~some[:, 2:]).mean() < MOST_PINHOLES:
        return depth
    hole, around = depth <= 0, np.ones((3, 3), np.uint8)
    far, near = cv2.dilate(depth, around), cv2.erode(np.where(hole, np.float32(np.inf), depth), around)
    filled = hole & (far > 0) & (far - near < PINHOLE_RELIEF * far)
    return np.where(filled, np.float32(0.5) * (far + near), depth)


def _decode_grey(place: Path | str, data: bytes, size: tuple[int, int], what: str, kind: type) -> NDArray[np.generic]:
    header = _check(place, data, size)
    bits = 8 * np.dtype(kind).itemsize
    if (header.kind, header.bits, header.channels) != ("PNG", bits, 1):
        found = f"{header.bits}-bit {header.kind} with {header.channels} channels"
        raise FrameError(
            f"{place}: {found}, but {what} must be a {bits}-bit PNG with one; export it again without conversion"
        )
    return _decode(place, data, cv2.IMREAD_UNCHANGED, (size[1], size[0]), kind)


def _most_bytes(size: tuple[int, int]) -> int:
    """More than a sensible image of this (width, height) takes."""
    return (1 << 20) + 8 * size[0] * size[1]


def _check(place: Path | str, data: bytes, size: tuple[int, int]) -> ImageHeader:
    """The header of what must be a complete image of the wanted size, still encoded."""
    header, limit = parse_header(place, data), _most_bytes(size)
    require_size(place, header.size, size)
    if len(data) > limit:
        raise FrameError(f"{place}: over {limit >> 20} MiB, too much for {_by(size)} pixels; replace it")
    if LAST_BYTES[header.kind] not in data[-64:]:
        raise FrameError(f"{place}: truncated {header.kind} (no end marker); copy it again")
    return header


def require_size(place: Path | str, found: tuple[int, int], size: tuple[int, int]) -> None:
    """Raises FrameError when an image of (width, height) ``found`` is not of the sequence's ``size``."""
    if found != size:
        raise FrameError(f"{place}: {_by(found)} pixels, but this sequence has {_by(size)}; remove or replace it")


def read_bytes(path: Path, limit: int) -> bytes:
    """The first ``limit`` bytes of a file that is not empty. Raises FrameError."""
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise FrameError(f"{path}: not a regular file; replace it by an image")
        with path.open("rb") as file:
            data = file.read(limit)
    except OSError as error:
        raise FrameError(f"{path}: cannot be read ({error.strerror}); put the image back") from None
    if not data:
        raise FrameError(f"{path}: empty file; copy it again")
    return data


def parse_header(place: Path | str, data: bytes) -> ImageHeader:
    """The header of a PNG or JPEG file, from its first bytes. place: where they are from. Raises FrameError."""
    if data.startswith(PNG_SIGNATURE):
        header = _png_header(data)
    elif data.startswith(JPEG_SIGNATURE):
        header = _jpeg_header(data)
    else:
        raise FrameError(f"{place}: neither PNG nor JPEG; convert it to one of them, depth to 16-bit PNG")
    if header is None or header.width < 1 or header.height < 1:
        raise FrameError(f"{place}: damaged or truncated header; copy it again")
    return header


def _png_header(data: bytes) -> ImageHeader | None:
    if len(data) < 26 or data[12:16] != b"IHDR":
        return None
    width, height, bits, colour_type = struct.unpack_from(">IIBB", data, 16)
    channels = _PNG_CHANNELS.get(colour_type)
    return None if channels is None else ImageHeader("PNG", width, height, channels, bits)


def _jpeg_header(data: bytes) -> ImageHeader | None:
    """Walk the segments up to the start of frame (ITU T.81, B.1.1)."""
    at = 2
    while at + 10 <= len(data):
        if data[at] != 0xFF:
            return None
        marker = data[at + 1]
        if marker in _START_OF_FRAME:
            bits, height, width, channels = struct.unpack_from(">BHHB", data, at + 4)
            return ImageHeader("JPEG", width, height, channels, bits)
        if marker == 0xFF:
            at += 1
        elif marker in _WITHOUT_LENGTH:
            at += 2
        else:
            at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return None


def _decode(place: Path | str, data: bytes, flags: int, shape: tuple[int, ...], dtype: type) -> NDArray[np.generic]:
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        image = None
    if image is None or image.shape != shape or image.dtype != dtype:
        raise FrameError(f"{place}: cannot be decoded; copy it again")
    return cast("NDArray[np.generic]", image)


def _by(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"
