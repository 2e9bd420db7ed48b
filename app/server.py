"""The dashboard as one call: ``start`` puts an engine (live or a replay) on a page, ``view`` opens finished runs."""

from __future__ import annotations

import secrets
import socket
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from ecslam.runtime.protocol import EngineHandle
from ecslam.types import InputError

from .front import close_viser, is_loopback, open_viser
from .hub import Hub
from .listen import EVERYWHERE, bind, names_elsewhere
from .replay import ReplayEngine
from .runs import load_run, truth_apart

DEFAULT_PORT = 8080
SHORTEST_TOKEN = 16
SAME_TRUTH_M = 1e-3


@dataclass(frozen=True)
class Dashboard:
    """A running dashboard. url: the address to open, token included; elsewhere: those to open on another machine.
    host, port: where it listens, as numbers."""

    url: str
    elsewhere: tuple[str, ...]
    host: str
    port: int
    hub: Hub
    engine: EngineHandle

    @property
    def ssh_hint(self) -> str:
        """How to bring the page to another machine."""
        near = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(self.host, self.host)
        there = urlsplit(self.url)._replace(netloc=f"localhost:{self.port}").geturl()
        return f"ssh -L {self.port}:{_in_url(near)}:{self.port} <this machine>, then open {there} there"

    def close(self) -> None:
        """Close the page; a live engine goes on, a replay ends."""
        self.hub.close()
        close_viser(self.hub.server)
        if isinstance(self.engine, ReplayEngine):
            self.engine.close()


def start(
    engine: EngineHandle,
    host: str = "127.0.0.1",
    port: int = DEFAULT_PORT,
    token: str | None = None,
    dark: bool = False,
    listener: socket.socket | None = None,
) -> Dashboard:
    """Serve the dashboard of ``engine``. Raises InputError for a busy port, an unknown host or a short token.

    port 0 takes any free port. A host that other machines can reach always needs a token: without one given a fresh
    one is made. The token is part of ``Dashboard.url``; the page then keeps it in a cookie. listener: what ``bind`` has
    given for ``host`` already; ``port`` does not count then.
    """
    if token is not None and (
        len(token) < SHORTEST_TOKEN or not token.isascii() or not token.replace("-", "_").isidentifier()
    ):
        raise InputError(f"token: use at least {SHORTEST_TOKEN} letters, digits, '-' or '_', beginning with a letter")
    if token is None and not is_loopback(host):
        token = f"t{secrets.token_urlsafe(24)}"
    listener = listener or bind(host, port)
    server = open_viser(listener, host, token, "EC-SLAM")
    hub = Hub(engine, server, dark)
    hub.start()
    address, bound = listener.getsockname()[:2]

    def url(name: str) -> str:
        return f"http://{_in_url(name)}:{bound}/" + (f"?token={token}" if token else "")

    here = "localhost" if host in (*EVERYWHERE, "127.0.0.1") else host
    others = names_elsewhere(listener) if host in EVERYWHERE else () if is_loopback(host) else (host,)
    return Dashboard(url(here), tuple(map(url, others)), address, bound, hub, engine)


def _in_url(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def view(runs: list[Path], host: str = "127.0.0.1", port: int = DEFAULT_PORT, dark: bool = False) -> Dashboard:
    """Open one finished run, or compare two on the same sequence. Raises InputError."""
    if not 1 <= len(runs) <= 2:
        raise InputError("view takes one run folder, or two to compare")
    loaded = [load_run(folder) for folder in runs]
    names = {run.sequence for run in loaded if run.sequence}
    if len(names) > 1:
        raise InputError(
            f"{runs[0]} and {runs[1]}: runs on different sequences ({', '.join(sorted(names))}) cannot be compared"
        )
    apart = max((truth_apart(loaded[0], other) for other in loaded[1:]), default=0.0)
    if apart > SAME_TRUTH_M:
        raise InputError(
            f"{runs[0]} and {runs[1]}: at the same frames their cameras really were {100 * apart:.1f} cm apart, so "
            "these are not runs on the same recording and cannot be compared"
        )
    return start(ReplayEngine(loaded[0], tuple(loaded[1:])), host, port, dark=dark)
