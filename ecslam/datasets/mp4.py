"""When each frame of an MP4 file is shown, from its sample tables (ISO/IEC 14496-12), without decoding anything."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..types import InputError

MOST_TABLE_BYTES = 64 << 20
MOST_FRAMES = 1 << 20


@dataclass(frozen=True)
class VideoTrack:
    """size: (width, height) as stored, pixels. times: [N] seconds after the first frame, in the order of display, all
    of them: also those that an edit list cuts off."""

    size: tuple[int, int]
    times: NDArray[np.float64]


def read_track(path: Path) -> VideoTrack:
    """The video track of an MP4 file. Raises InputError."""
    try:
        with path.open("rb") as file:
            movie = _movie(file, path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    try:
        return next(filter(None, (_track(body) for kind, body in _boxes(movie) if kind == b"trak")))
    except StopIteration:
        raise InputError(f"{path}: holds no video; is it the right file?") from None
    except (ValueError, KeyError, IndexError, struct.error):
        raise InputError(
            f"{path}: the video has damaged tables, or no frames; copy it again from where it was recorded"
        ) from None


def _movie(file: BinaryIO, path: Path) -> memoryview:
    """The body of the box "moov", which a recorder writes last. Raises InputError."""
    end = file.seek(0, 2)
    at = 0
    while at + 8 <= end:
        file.seek(at)
        header = file.read(16)
        size, kind = struct.unpack_from(">I4s", header)
        start = 8
        if size == 1 and len(header) == 16:
            size, start = struct.unpack_from(">Q", header, 8)[0], 16
        elif size == 0:
            size = end - at
        if at == 0 and kind != b"ftyp":
            raise InputError(f"{path}: not an MP4 file; is it the right file?")
        if size < start or at + size > end:
            break
        if kind == b"moov" and size <= MOST_TABLE_BYTES:
            file.seek(at + start)
            return memoryview(file.read(size - start))
        at += size
    raise InputError(
        f"{path}: a truncated video, without the table of its frames at the end (moov); copy it again, or record again "
        "where the recording was cut short"
    )


def _boxes(data: memoryview) -> Iterator[tuple[bytes, memoryview]]:
    """The boxes that follow one another in ``data``: kind and body. Raises ValueError."""
    at = 0
    while at + 8 <= len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        if not 8 <= size <= len(data) - at:
            raise ValueError
        yield kind, data[at + 8 : at + size]
        at += size


def _track(body: memoryview) -> VideoTrack | None:
    """The track where it is a video's. Raises ValueError, KeyError, IndexError and struct.error where it is damaged."""
    media = dict(_boxes(dict(_boxes(body))[b"mdia"]))
    if bytes(media[b"hdlr"][8:12]) != b"vide":
        return None
    tables = dict(_boxes(dict(_boxes(media[b"minf"]))[b"stbl"]))
    units_per_s = struct.unpack_from(">I", media[b"mdhd"], 20 if media[b"mdhd"][0] == 1 else 12)[0]
    (count,) = struct.unpack_from(">I", tables[b"stsz"], 8)
    steps = _runs(tables[b"stts"], ">u4", count)
    shown = np.concatenate([[0], np.cumsum(steps[:-1], dtype=np.int64)])
    if b"ctts" in tables:
        shown = shown + _runs(tables[b"ctts"], ">i4", count)
    times = np.sort(shown) / units_per_s
    width, height = struct.unpack_from(">HH", tables[b"stsd"], 40)
    if not (units_per_s and width and height) or (np.diff(times) <= 0).any():
        raise ValueError
    return VideoTrack((width, height), times - times[0])


def _runs(table: memoryview, kind: str, count: int) -> NDArray[np.int64]:
    """[count] values of a table of runs (length, value). Raises ValueError when it has other than ``count``."""
    (entries,) = struct.unpack_from(">I", table, 4)
    runs = np.frombuffer(table, np.dtype([("length", ">u4"), ("value", kind)]), entries, 8)
    if not 0 < count <= MOST_FRAMES or int(runs["length"].sum(dtype=np.int64)) != count:
        raise ValueError
    return np.repeat(runs["value"].astype(np.int64), runs["length"])
