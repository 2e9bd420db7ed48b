"""The front door: viser behind checks of Host, Origin, token, messages and patience.

viser binds its own socket, checks nobody and trusts every message. Instead of standing a proxy in front of it (a
second port that would stay open to others on the machine), the WebSocket server that viser starts is wrapped while
viser is being constructed: it gets a socket that is already bound, answers requests only after ``Door.refuse`` and
sees each connection through ``_Guarded``. If a later viser starts its server another way, ``open_viser`` fails.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import http
import io
import ipaddress
import logging
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any
from urllib.parse import parse_qs, urlsplit

import viser
import websockets.asyncio.server
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from .broadcast import share_batches
from .guard import make_check
from .listen import EVERYWHERE
from .page import index_page

MAX_CLIENTS = 64
STALL_S = 15.0
MESSAGES_PER_S, BURST = 240.0, 480.0

_LOOPBACK_NAMES = frozenset({"localhost", "127.0.0.1", "::1"})
_construction = threading.Lock()
_log = logging.getLogger(f"{__name__}.websockets")
# A browser that has given up before it is answered, or a scan of ports, is nobody's mistake here.
_log.addFilter(lambda record: record.getMessage() != "opening handshake failed")


@dataclass(frozen=True)
class Door:
    """Who may come in. names: host names the page may be asked for under; any_address: under any IP address too."""

    names: frozenset[str]
    any_address: bool
    token: str | None
    cookie: str

    def refuse(self, request: Request) -> Response | None:
        """The answer to a request that must not pass, or None."""
        hosts, upgrade = request.headers.get_all("Host"), request.headers.get("Upgrade", "").lower() == "websocket"
        if len(hosts) != 1 or not self._knows(hosts[0]):
            return _plain(403, "This address is not served here.")
        origins = request.headers.get_all("Origin")
        own = {f"http://{hosts[0]}", f"https://{hosts[0]}"}
        if (upgrade and not origins) or any(origin not in own for origin in origins):
            return _plain(403, "Another page may not use this one.")
        if self.token is None:
            return None
        url = urlsplit(request.path)
        given = parse_qs(url.query).get("token", [""])[0]
        if not upgrade and given and _same(given, self.token):
            cookie = f"{self.cookie}={self.token}; Path=/; HttpOnly; SameSite=Strict"
            return _plain(303, "", {"Location": "/", "Set-Cookie": cookie})
        if _same(self._cookie(request), self.token):
            return None
        return _plain(401, "This dashboard needs its token: open the address that the terminal printed.")

    def _knows(self, host: str) -> bool:
        if not re.fullmatch(r"[\w.-]+(:\d+)?|\[[\da-fA-F:.]+\](:\d+)?", host):
            return False
        name = urlsplit(f"//{host}").hostname or ""
        return name in self.names or (self.any_address and _is_address(name))

    def _cookie(self, request: Request) -> str:
        pairs = (part.strip().partition("=") for line in request.headers.get_all("Cookie") for part in line.split(";"))
        return next((value for name, _, value in pairs if name == self.cookie), "")


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach ``host``."""
    return host in _LOOPBACK_NAMES or (_is_address(host) and ipaddress.ip_address(host).is_loopback)


def open_viser(listener: socket.socket, host: str, token: str | None, label: str) -> viser.ViserServer:
    """A viser server on ``listener`` behind the checks. Raises RuntimeError if viser cannot be wrapped."""
    port = listener.getsockname()[1]
    everywhere = host in EVERYWHERE
    own_names = (socket.gethostname(), socket.getfqdn()) if everywhere else (host,)
    door = Door(_LOOPBACK_NAMES | {name.lower() for name in own_names}, everywhere, token, f"ecslam_{port}")
    shell = _Shell(door, listener)
    share_batches()
    with _construction, _serving_through(shell), contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host=host, port=port, label=label, verbose=False)
    if not shell.serving:
        server.stop()
        raise RuntimeError(f"viser {viser.__version__} starts its server in a way that cannot be guarded")
    shell.accepts = make_check(server.gui)
    for message in (viser._messages.ShareUrlRequest, viser._messages.ShareUrlDisconnect):
        server._websock_server.unregister_handler(message)
    return server


def close_viser(server: viser.ViserServer) -> None:
    """Stop a server without viser's own words about it on the terminal."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


@contextlib.contextmanager
def _serving_through(shell: _Shell) -> Iterator[None]:
    original = websockets.asyncio.server.serve
    websockets.asyncio.server.serve = partial(shell.serve, original)  # type: ignore[misc, assignment]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = original  # type: ignore[misc]


class _Shell:
    """Stands in for ``websockets.asyncio.server.serve`` while viser is being constructed."""

    def __init__(self, door: Door, listener: socket.socket) -> None:
        self._door, self._listener, self._clients = door, listener, 0
        self.serving = False
        self.accepts: Callable[[bytes], bool] = lambda raw: False

    def serve(self, serve: Any, handler: Any, host: str, port: int, *, process_request: Any, **options: Any) -> Any:
        def answer(connection: Any, request: Request) -> Response | None:
            refusal = self._door.refuse(request)
            if refusal is not None or request.headers.get("Upgrade", "").lower() == "websocket":
                return refusal
            if urlsplit(request.path).path in ("/", "/index.html"):
                return index_page(request.headers)
            response: Response | None = process_request(connection, request)
            return response

        async def attend(connection: Any) -> None:
            if self._clients >= MAX_CLIENTS:
                await connection.close(1013, "too many viewers")
                return
            self._clients += 1
            try:
                await handler(_Guarded(connection, lambda raw: self.accepts(raw)))
            finally:
                self._clients -= 1

        self.serving = True
        return serve(attend, sock=self._listener, process_request=answer, logger=_log, **options)


class _Guarded:
    """A connection that hands over only what passes the check, at a bounded rate, and drops who stops reading."""

    def __init__(self, connection: Any, accepts: Callable[[bytes], bool]) -> None:
        self._connection, self._accepts = connection, accepts
        self._credit, self._paid = BURST, time.monotonic()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._connection, name)

    async def recv(self) -> bytes:
        while True:
            raw = await self._connection.recv()
            await self._pace()
            if isinstance(raw, bytes) and self._accepts(raw):
                return raw

    async def send(self, data: bytes) -> None:
        alarm = asyncio.get_running_loop().call_later(STALL_S, self._connection.transport.abort)
        try:
            await self._connection.send(data)
        finally:
            alarm.cancel()

    async def _pace(self) -> None:
        now = time.monotonic()
        self._credit = min(BURST, self._credit + (now - self._paid) * MESSAGES_PER_S) - 1
        self._paid = now
        if self._credit < 0:
            await asyncio.sleep(-self._credit / MESSAGES_PER_S)


def _plain(status: int, text: str, headers: dict[str, str] | None = None) -> Response:
    body = f"{text}\n".encode() if text else b""
    fields = {
        "Content-Type": "text/plain; charset=utf-8",
        "Content-Length": str(len(body)),
        "Cache-Control": "no-store",
    }
    phrase = http.HTTPStatus(status).phrase
    return Response(status, phrase, Headers({**fields, "Connection": "close", **(headers or {})}), body)


def _same(given: str, token: str) -> bool:
    return hmac.compare_digest(given.encode(), token.encode())


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
