"""A socket for the page. It needs no viser, so that a busy port is found before anything slow is begun."""

from __future__ import annotations

import os
import socket

from ecslam.types import InputError


def bind(host: str, port: int) -> socket.socket:
    """A listening socket (``port`` 0: any free one). Raises InputError when the port is busy or the host not ours."""
    if not 0 <= port <= 65535:
        raise InputError(f"--port {port}: a port lies in 0 .. 65535; 0 takes any free one")
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[
            0
        ]
    except OSError:
        raise InputError(
            f"--host {host}: no such host; 127.0.0.1 serves this machine, 0.0.0.0 all its networks"
        ) from None
    listener = socket.socket(family, kind)
    if os.name == "posix":  # elsewhere it would share a port that is busy
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind(address)
        listener.listen(128)
    except OSError as error:
        listener.close()
        hint = "choose another --port (0 takes any free one)" if port else "choose an address of this machine"
        raise InputError(f"--host {host} --port {port}: cannot listen there ({error.strerror}); {hint}") from None
    return listener
