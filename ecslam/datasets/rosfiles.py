"""The bytes of single messages in recordings of ROS: .bag (ROS 1), .mcap and .db3 (ROS 2), plain or compressed."""

from __future__ import annotations

import bz2
import sqlite3
import threading
from collections import OrderedDict
from contextlib import closing
from pathlib import Path
from typing import BinaryIO, NamedTuple

from ..types import FrameError

MOST_BYTES = 256 << 20  # of a message, or of a chunk unpacked
CHUNKS_KEPT = 4
SQLITE_ERRORS = sqlite3.Error, ValueError, TypeError, OverflowError  # also of what is of another type, or no text
ZSTD = b"\x28\xb5\x2f\xfd"


class DamagedError(Exception):
    """The bytes are not what the format asks for, or end too early."""


class Chunk(NamedTuple):
    """A compressed part of a file. at, size: where it lies; full: bytes when unpacked."""

    at: int
    size: int
    packing: str
    full: int


class Place(NamedTuple):
    """Where a message lies. time_ns: of its header. at, size: in the file, or in ``chunk`` unpacked; ``at`` is the row
    in SQLite."""

    time_ns: int
    file: Path
    chunk: Chunk | None
    at: int
    size: int


class Reader:
    """The bytes of a message, from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._chunks: OrderedDict[tuple[Path, int], bytes] = OrderedDict()  # the last few: colour and depth share them

    def read(self, place: Place) -> bytes:
        """Raises FrameError."""
        try:
            return unpacked_message(self._stored(place))
        except OSError as error:
            raise FrameError(f"{place.file}: cannot be read ({error.strerror}); put it back") from None
        except DamagedError as error:
            raise FrameError(f"{place.file}: {error}; copy or record it again") from None

    def _stored(self, place: Place) -> bytes:
        if place.file.suffix.lower() == ".db3":
            return _row(place)
        if place.chunk is not None:
            return self._chunk(place.file, place.chunk)[place.at : place.at + place.size]
        with place.file.open("rb", buffering=0) as stream:
            return exactly(stream, place.at, place.size)

    def _chunk(self, file: Path, chunk: Chunk) -> bytes:
        key = file, chunk.at
        with self._lock:
            if key in self._chunks:
                self._chunks.move_to_end(key)
                return self._chunks[key]
        with file.open("rb", buffering=0) as stream:
            data = unpack(exactly(stream, chunk.at, chunk.size), chunk.packing, chunk.full)
        with self._lock:
            self._chunks[key] = data
            while len(self._chunks) > CHUNKS_KEPT:
                self._chunks.popitem(last=False)
        return data


def exactly(stream: BinaryIO, at: int, size: int) -> bytes:
    """``size`` bytes from position ``at``. Raises DamagedError when there are fewer, or it is more than makes sense."""
    if not 0 <= size <= MOST_BYTES:
        raise DamagedError(f"a message or chunk of {size >> 20} MiB, more than is read")
    stream.seek(at)
    data = stream.read(size)
    if len(data) != size:
        raise DamagedError("it ends too early")
    return data


def printable(text: str) -> str:
    """What a file says, for a message of one line."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def open_sqlite(file: Path) -> sqlite3.Connection:
    """Read only; nothing is written beside it."""
    return sqlite3.connect(f"{file.absolute().as_uri()}?immutable=1", uri=True)


def _row(place: Place) -> bytes:
    try:
        with closing(open_sqlite(place.file)) as database:
            row = database.execute("SELECT data FROM messages WHERE id = ?", (place.at,)).fetchone()
    except SQLITE_ERRORS as error:
        raise DamagedError(f"a damaged database ({printable(str(error))})") from None
    if row is None or not isinstance(row[0], bytes):
        raise DamagedError("a message is gone")
    return row[0]


def unpacked_message(data: bytes) -> bytes:
    """A message as it was sent; rosbag2 may have compressed each by itself."""
    return unpack(data, "zstd", MOST_BYTES) if data.startswith(ZSTD) else data


def unpack(data: bytes, packing: str, most: int) -> bytes:
    """Decompress to at most ``most`` bytes. Raises DamagedError."""
    import lz4.frame
    import zstandard

    if most > MOST_BYTES:
        raise DamagedError(f"a chunk of {most >> 20} MiB, more than is read")
    try:
        if packing == "lz4":
            return lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=most)
        if packing == "bz2":
            return bz2.BZ2Decompressor().decompress(data, max_length=most)
        if packing == "zstd":
            if zstandard.frame_content_size(data) > most:
                raise DamagedError("it unpacks to more than it says")
            return zstandard.ZstdDecompressor().decompress(data, max_output_size=most)
    except (OSError, ValueError, RuntimeError, EOFError, zstandard.ZstdError):
        raise DamagedError(f"damaged {packing} data") from None
    raise DamagedError(f"compressed with {packing!r}, which is not read")
