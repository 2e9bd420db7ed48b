"""Where the messages of a recording of ROS lie, by walking over its records without reading what they hold.

From http://wiki.ros.org/Bags/Format/2.0, https://mcap.dev/spec and the tables of rosbag2's SQLite storage. The readers
of ``rosbags`` go through every byte from one end to the other; here gigabytes open at once, and a recording that broke
off before its index was written is read as far as it goes.
"""

from __future__ import annotations

import sqlite3
import struct
from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

from ..types import InputError
from .prefetch import workers
from .rosfiles import (
    SQLITE_ERRORS,
    ZSTD,
    Chunk,
    DamagedError,
    Place,
    exactly,
    open_sqlite,
    printable,
    unpack,
    unpacked_message,
)

GLANCE = 192  # bytes of a record that are read in passing
MOST_ABOUT_BYTES = 16 << 20  # of what describes a topic
STAMP = slice(4, 12)  # of a message that begins with a header; before it a number (ROS 1) or how it is encoded (ROS 2)
BAG_MAGIC, MCAP_MAGIC = b"#ROSBAG V2.0\n", b"\x89MCAP0\r\n"
Wanted = Callable[[str, str], bool]


@dataclass
class Index:
    """What a recording holds. ros1: how messages are encoded. types: by topic, as ``sensor_msgs/msg/Image``. places: by
    topic, in the order of recording. lost: what of the files could not be read, one sentence each."""

    ros1: bool = False
    types: dict[str, str] = field(default_factory=dict)
    places: dict[str, list[Place]] = field(default_factory=lambda: defaultdict(list))
    lost: list[str] = field(default_factory=list)


def find_messages(files: list[Path], wanted: Wanted) -> Index:
    """Of topics and their types that are ``wanted``, in the ``files`` of one recording. Raises InputError."""
    index = Index()
    walks = {".bag": _BagWalk, ".mcap": _McapWalk, ".db3": _SqliteWalk}
    for file in files:
        walk = walks[file.suffix.lower()](file, index, wanted)
        try:
            with closing(walk):
                walk.run()
        except OSError as error:
            raise InputError(f"{file}: cannot be read ({error.strerror})") from None
        except DamagedError as error:
            if not walk.topics:
                raise InputError(f"{file}: {error}; copy or record it again") from None
            index.lost.append(f"{file.name} is damaged or breaks off ({error}): what comes before is read")
        if walk.damaged_chunks:
            index.lost.append(f"{walk.damaged_chunks} chunks of {file.name} are damaged and are left out")
    return index


class _Walk:
    """Over one file. topics: by connection, as that format calls its channels. kept: connections that are wanted."""

    def __init__(self, file: Path, index: Index, wanted: Wanted) -> None:
        self.file, self.index, self.wanted = file, index, wanted
        self.topics: dict[object, str] = {}
        self.kept: set[object] = set()
        self.damaged_chunks = 0
        self._pool = ThreadPoolExecutor(workers())
        self._coming: deque[tuple[Chunk, Future[bytes]]] = deque()

    def run(self) -> None:
        """Raises DamagedError, OSError."""
        raise NotImplementedError

    def topic(self, connection: object, name: str, kind: str) -> None:
        package, _, rest = kind.partition("/")
        name = self.topics[connection] = printable(name)
        kind = self.index.types[name] = f"{package}/msg/{rest.removeprefix('msg/')}"
        (self.kept.add if self.wanted(name, kind) else self.kept.discard)(connection)

    def packed(self, data: bytes, chunk: Chunk) -> None:
        """The records of a compressed chunk, later: threads unpack. A damaged one costs no other."""
        self._coming.append((chunk, self._pool.submit(unpack, data, chunk.packing, chunk.full)))
        self._walk_chunks(2 * workers())

    def close(self) -> None:
        """Walk over the last chunks."""
        self._walk_chunks(0)
        self._pool.shutdown()

    def _walk_chunks(self, left: int) -> None:
        while len(self._coming) > left:
            chunk, data = self._coming.popleft()
            try:
                self.records(BytesIO(data.result()), 0, chunk.full, chunk, inside=True)
            except DamagedError:
                self.damaged_chunks += 1

    def records(self, stream: BinaryIO, at: int, end: int, chunk: Chunk | None = None, inside: bool = False) -> None:
        """Those from ``at`` to ``end``, of the file or of ``chunk``. Raises DamagedError."""
        raise NotImplementedError

    def message(self, connection: object, time_ns: int, chunk: Chunk | None, at: int, size: int, start: bytes) -> None:
        """start: at least its first 12 bytes. time_ns: of recording, for messages that have no time."""
        order = "<" if self.index.ros1 or start[1:2] == b"\x01" else ">"
        if len(start[STAMP]) == 8:
            seconds, rest = struct.unpack(f"{order}II", start[STAMP])
            time_ns = 10**9 * seconds + rest or time_ns
        self.index.places[self.topics[connection]].append(Place(time_ns, self.file, chunk, at, size))


class _BagWalk(_Walk):
    def run(self) -> None:
        self.index.ros1 = True
        with self.file.open("rb", buffering=0) as stream:
            if stream.read(len(BAG_MAGIC)) != BAG_MAGIC:
                raise DamagedError("not a bag of ROS 1, format 2.0")
            self.records(stream, len(BAG_MAGIC), self.file.stat().st_size)

    def records(self, stream: BinaryIO, at: int, end: int, chunk: Chunk | None = None, inside: bool = False) -> None:
        while at < end:
            fields, at, size, start = _bag_record(stream, at)
            kind, connection = fields.get(b"op"), fields.get(b"conn")
            if kind == b"\x07":
                about = _fields(exactly(stream, at, min(size, MOST_ABOUT_BYTES)))
                self.topic(connection, _text(fields[b"topic"]), _text(about[b"type"]))
            elif kind == b"\x05" and not inside:
                self._chunk(stream, at, size, min(at + size, end), fields)
            if at + size > end:
                raise DamagedError("its last record is cut off")
            if kind == b"\x02" and connection in self.kept:
                seconds, rest = fields[b"time"][:4], fields[b"time"][4:]
                time_ns = 10**9 * int.from_bytes(seconds, "little") + int.from_bytes(rest, "little")
                self.message(connection, time_ns, chunk, at, size, start)
            at += size

    def _chunk(self, stream: BinaryIO, at: int, size: int, end: int, fields: dict[bytes, bytes]) -> None:
        packing = _text(fields[b"compression"])
        if packing == "none":
            self.records(stream, at, end, inside=True)
            return
        chunk = Chunk(at, size, packing, int.from_bytes(fields[b"size"], "little"))
        self.packed(exactly(stream, at, size), chunk)


def _bag_record(stream: BinaryIO, at: int) -> tuple[dict[bytes, bytes], int, int, bytes]:
    """Its fields, where its data begin, how long they are, and the first of them."""
    stream.seek(at)
    glance = stream.read(GLANCE)
    length = int.from_bytes(glance[:4], "little")
    if length > MOST_ABOUT_BYTES:
        raise DamagedError("a record makes no sense")
    if 4 + length + 4 + STAMP.stop > len(glance):
        stream.seek(at)
        glance = stream.read(4 + length + 4 + STAMP.stop)
    if len(glance) < 4 + length + 4:
        raise DamagedError("it ends too early")
    size = int.from_bytes(glance[4 + length : 8 + length], "little")
    return _fields(glance[4 : 4 + length]), at + 8 + length, size, glance[8 + length :]


class _Fields(dict[bytes, bytes]):
    def __missing__(self, name: bytes) -> bytes:
        raise DamagedError(f"a record has no {name.decode()}")


def _fields(data: bytes) -> _Fields:
    """The fields of a ROS 1 record: each its length, its name, ``=`` and its value."""
    fields, at = _Fields(), 0
    while at + 4 <= len(data):
        end = at + 4 + int.from_bytes(data[at : at + 4], "little")
        name, _, value = data[at + 4 : end].partition(b"=")
        fields[name], at = value, end
    return fields


class _McapWalk(_Walk):
    def run(self) -> None:
        self.schemas: dict[int, str] = {}
        with self.file.open("rb", buffering=0) as stream:
            if stream.read(len(MCAP_MAGIC)) != MCAP_MAGIC:
                raise DamagedError("not an MCAP file")
            self.records(stream, len(MCAP_MAGIC), self.file.stat().st_size)

    def records(self, stream: BinaryIO, at: int, end: int, chunk: Chunk | None = None, inside: bool = False) -> None:
        while at < end:
            stream.seek(at)
            glance = stream.read(GLANCE)
            kind, size, at = glance[0], int.from_bytes(glance[1:9], "little"), at + 9
            if kind == 0x0F:  # the end of data; what follows is indexes
                return
            if kind in (0x03, 0x04):
                about = _Cursor(exactly(stream, at, min(size, MOST_ABOUT_BYTES)))
                self._schema(about) if kind == 0x03 else self._channel(about)
            elif kind == 0x06 and not inside:
                self._chunk(stream, at, min(at + size, end), _Cursor(glance[9:]))
            if at + size > end:
                raise DamagedError("its last record is cut off")
            if kind == 0x05:
                connection, _, time_ns, _ = _Cursor(glance[9:]).numbers("<HIQQ")
                if connection in self.kept and size >= 22:
                    self._message(stream, connection, time_ns, chunk, at + 22, size - 22, glance[31:])
            at += size
        if not inside:
            raise DamagedError("its end is missing")

    def _message(
        self, stream: BinaryIO, connection: int, time_ns: int, chunk: Chunk | None, at: int, size: int, start: bytes
    ) -> None:
        if start.startswith(ZSTD):
            start = unpacked_message(exactly(stream, at, size))
        self.message(connection, time_ns, chunk, at, size, start)

    def _schema(self, about: _Cursor) -> None:
        (number,) = about.numbers("<H")
        self.schemas[number] = about.text()

    def _channel(self, about: _Cursor) -> None:
        number, schema = about.numbers("<HH")
        topic, encoding = about.text(), about.text()
        if encoding in ("cdr", "ros1"):
            self.index.ros1 = encoding == "ros1"
            self.topic(number, topic, self.schemas.get(schema, ""))

    def _chunk(self, stream: BinaryIO, at: int, end: int, about: _Cursor) -> None:
        _, _, full, _ = about.numbers("<QQQI")
        packing = about.text()
        (size,) = about.numbers("<Q")
        at += about.at
        if not packing:
            self.records(stream, at, min(at + size, end), inside=True)
            return
        self.packed(exactly(stream, at, size), Chunk(at, size, packing, full))


class _Cursor:
    """Numbers and texts of an MCAP record, one after the other. Raises DamagedError at its end."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def numbers(self, form: str) -> tuple[int, ...]:
        try:
            found = struct.unpack_from(form, self.data, self.at)
        except struct.error:
            raise DamagedError("a record is too short") from None
        self.at += struct.calcsize(form)
        return found

    def text(self) -> str:
        (length,) = self.numbers("<I")
        self.at += length
        return _text(self.data[self.at - length : self.at])


class _SqliteWalk(_Walk):
    def run(self) -> None:
        try:
            with closing(open_sqlite(self.file)) as database:
                for number, name, kind in database.execute("SELECT id, name, type FROM topics"):
                    self.topic(number, str(name), str(kind))
                for number in filter(self.kept.__contains__, self.topics):
                    for row, time_ns, size, start in _rows(database, number):
                        self.message(number, time_ns, None, row, size, start)
        except SQLITE_ERRORS as error:
            raise DamagedError(f"a damaged database: {printable(str(error))}") from None


def _rows(database: sqlite3.Connection, topic: object) -> Iterator[tuple[int, int, int, bytes]]:
    """Row, time of recording, size and first bytes of each message."""
    blob: Any = getattr(database, "blobopen", None)  # from Python 3.11; else SQLite reads the whole
    rows = database.execute("SELECT id, timestamp, length(data) FROM messages WHERE topic_id = ?", (topic,))
    for row, time_ns, size in rows:
        if blob is None:
            (start,) = database.execute("SELECT substr(data, 1, 12) FROM messages WHERE id = ?", (row,)).fetchone()
        else:
            with blob("messages", "data", row, readonly=True) as data:
                start = data.read(STAMP.stop)
        if start.startswith(ZSTD):
            start = unpacked_message(database.execute("SELECT data FROM messages WHERE id = ?", (row,)).fetchone()[0])
        yield row, time_ns, size, start


def _text(data: bytes) -> str:
    return data.decode("utf-8", "replace")
