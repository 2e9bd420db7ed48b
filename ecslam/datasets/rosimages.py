"""Images in messages of ROS: sensor_msgs/Image, and CompressedImage as JPEG, PNG or compressedDepth.

The header of compressedDepth is that of ``compressed_depth_image_transport``: an int32 format and two float32 (a, b)
before a PNG, which holds 16UC1 as it was, or for 32FC1 inverse depth: q is a / (q - b) metres, and 0 is none.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from ..types import FrameError
from .images import PNG_SIGNATURE, decode_color, decode_depth, parse_header, require_size, to_metres
from .rosfiles import printable

COLORS = {  # encoding: channels, and how OpenCV makes RGB of it
    "rgb8": (3, None),
    "8UC3": (3, cv2.COLOR_BGR2RGB),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "8UC4": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB),
    "8UC1": (1, cv2.COLOR_GRAY2RGB),
}
DEPTHS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
GREY = ("mono8", "8UC1", "mono16")
UNNAMED = "0"  # the frame of all images that librealsense records, depth not registered
PACKED_HEADER = struct.Struct("<iff")


@dataclass(frozen=True)
class ImageKind:
    """What a message says about its image. encoding: as in ``COLORS`` or ``DEPTHS``, or something else. frame: of the
    camera that sees it, without a leading slash, "" where that is not told."""

    width: int
    height: int
    encoding: str
    packed: bool
    frame: str

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self.width, self.height

    @property
    def is_depth(self) -> bool:
        """Whether it can hold depth."""
        return self.encoding in DEPTHS

    @property
    def is_color(self) -> bool:
        """Whether it can hold colour, or grey."""
        return self.encoding in COLORS


def kind_of(message: Any, place: str) -> ImageKind:
    """Of an Image or CompressedImage. place: where it is from, for messages. Raises FrameError."""
    frame = printable(message.header.frame_id.strip("/"))
    frame = "" if frame == UNNAMED else frame
    if hasattr(message, "encoding"):
        return ImageKind(message.width, message.height, printable(message.encoding), False, frame)
    encoding, packed = _packed(message)
    header = parse_header(place, message.data[PACKED_HEADER.size if packed else 0 :].tobytes())
    if not packed:
        encoding = "bgr8" if header.bits == 8 and header.channels > 1 else "mono8" if header.bits == 8 else "16UC1"
    return ImageKind(header.width, header.height, encoding, True, frame)


def color_of(message: Any, size: tuple[int, int], place: str) -> NDArray[np.uint8]:
    """RGB uint8 [H, W, 3] from an Image or CompressedImage of (width, height) ``size``. Raises FrameError."""
    if not hasattr(message, "encoding"):
        return decode_color(place, message.data.tobytes(), size)
    if message.encoding not in COLORS:
        raise FrameError(f"{place}: encoding {message.encoding!r}, which is no colour; record rgb8 or bgr8")
    channels, conversion = COLORS[message.encoding]
    rows = _rows(message, "u1", channels, size, place)
    if conversion is None:
        return rows.copy()
    return cast("NDArray[np.uint8]", cv2.cvtColor(np.ascontiguousarray(rows), conversion))


def depth_of(message: Any, size: tuple[int, int], scale: float, place: str) -> NDArray[np.float32]:
    """Metres float32 [H, W], 0 = none, from an Image or CompressedImage of (width, height) ``size``. scale: units per
    metre of 16 bits. Raises FrameError."""
    if not hasattr(message, "encoding"):
        return _unpacked_depth(message, size, scale, place)
    if message.encoding not in DEPTHS:
        raise FrameError(f"{place}: encoding {message.encoding!r}, which is no depth; record 16UC1 or 32FC1")
    kind = (">" if message.is_bigendian else "<") + DEPTHS[message.encoding]
    values = _rows(message, kind, 1, size, place)[..., 0]
    if kind.endswith("u2"):
        return to_metres(values.astype(np.uint16), scale)
    return _known(values.astype(np.float32))


def _rows(message: Any, kind: str, channels: int, size: tuple[int, int], place: str) -> NDArray[Any]:
    """Values [H, W, C] as stored, without what fills up the rows."""
    require_size(place, (message.width, message.height), size)
    width, height = size
    used = width * channels * np.dtype(kind).itemsize
    if message.step < used or len(message.data) < message.step * height:
        raise FrameError(f"{place}: {len(message.data)} bytes in rows of {message.step}, too few; record it again")
    rows = message.data[: message.step * height].reshape(height, message.step)[:, :used]
    return np.ascontiguousarray(rows).view(kind).reshape(height, width, channels)


def _unpacked_depth(message: Any, size: tuple[int, int], scale: float, place: str) -> NDArray[np.float32]:
    encoding, packed = _packed(message)
    data = message.data.tobytes()
    if not packed:
        return to_metres(decode_depth(place, data, size), scale)
    _, a, b = PACKED_HEADER.unpack_from(data)
    raw = decode_depth(place, data[PACKED_HEADER.size :], size)
    if encoding != "32FC1":
        return to_metres(raw, scale)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return _known(np.where(raw > 0, np.float32(a) / (raw.astype(np.float32) - np.float32(b)), np.float32(0)))


def _packed(message: Any) -> tuple[str, bool]:
    """The encoding before compression, and whether the header of compressedDepth comes first; some tell neither."""
    encoding, _, _ = message.format.partition(";")
    at = PACKED_HEADER.size
    packed = message.data[at : at + len(PNG_SIGNATURE)].tobytes() == PNG_SIGNATURE
    return printable(encoding.strip()) or "16UC1", packed


def _known(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """0 where it is not finite or not positive."""
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))
