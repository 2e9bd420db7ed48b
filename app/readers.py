"""Viewers that read and drop everything, for measuring what viewers cost an engine."""

from __future__ import annotations

import asyncio
import contextlib
import struct
import subprocess
import sys
import time
from collections.abc import Iterator

from ecslam.types import InputError

from .server import Dashboard

CONNECT_S = 60.0
_CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [1.0, 0, 0, 0],
    "position": [3.0, 3, 3],
    "look_at": [0.0, 0, 0],
    "up_direction": [0.0, 0, 1],
    "fov": 1.2,
    "near": 0.01,
    "far": 1000.0,
    "image_height": 600,
    "image_width": 800,
}


def greeting(port: int) -> bytes:
    """What a browser says first: the upgrade, and its camera as one masked binary frame."""
    import msgspec
    import viser

    host = f"127.0.0.1:{port}"
    body = msgspec.msgpack.encode(_CAMERA)
    upgrade = (
        f"GET / HTTP/1.1\r\nHost: {host}\r\nOrigin: http://{host}\r\nUpgrade: websocket\r\n"
        f"Connection: Upgrade\r\nSec-WebSocket-Key: {'A' * 22}==\r\nSec-WebSocket-Version: 13\r\n"
        f"Sec-WebSocket-Protocol: viser-v{viser.__version__}\r\n\r\n"
    )
    return upgrade.encode() + b"\x82\xfe" + struct.pack(">HI", len(body), 0) + body


@contextlib.contextmanager
def crowd(dashboard: Dashboard, count: int) -> Iterator[None]:
    """``count`` viewers in one process of their own, connected inside the block. Raises InputError if they cannot.

    They decode nothing: what a browser makes of the bytes is not the business of the engine's machine.
    """
    arguments = [sys.executable, "-m", __name__, str(dashboard.port), str(count), greeting(dashboard.port).hex()]
    with subprocess.Popen(arguments, stdin=subprocess.PIPE) as process:
        try:
            _wait_for(dashboard, count)
            yield
        finally:
            process.communicate()
    _wait_for(dashboard, 0)


def _wait_for(dashboard: Dashboard, count: int) -> None:
    end = time.monotonic() + CONNECT_S
    while len(list(dashboard.hub.viewers())) != count:
        if time.monotonic() > end:
            raise InputError(f"the page has {len(list(dashboard.hub.viewers()))} viewers, not {count}")
        time.sleep(0.02)


class _Reader(asyncio.BufferedProtocol):
    """Says ``hello`` and drops what it reads."""

    room = bytearray(1 << 20)

    def __init__(self, hello: bytes) -> None:
        self._hello = hello

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.WriteTransport)
        transport.write(self._hello)

    def get_buffer(self, sizehint: int) -> bytearray:
        return self.room

    def buffer_updated(self, nbytes: int) -> None:
        """Nothing is kept."""


async def _read(port: int, count: int, hello: bytes) -> None:
    """Keep ``count`` connections until standard input ends."""
    loop = asyncio.get_running_loop()
    for _ in range(count):
        await loop.create_connection(lambda: _Reader(hello), "127.0.0.1", port)
    await loop.run_in_executor(None, sys.stdin.read)


if __name__ == "__main__":
    asyncio.run(_read(int(sys.argv[1]), int(sys.argv[2]), bytes.fromhex(sys.argv[3])))
