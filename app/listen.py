"""A socket for the page. It needs no viser, so that a busy port is found before anything slow is begun."""

from __future__ import annotations

import contextlib
import ipaddress
import os
import socket

from ecslam.types import InputError

EVERYWHERE = ("0.0.0.0", "::", "")
# Nothing is sent to these: they only ask the system which of this machine's addresses would be the sender's.
_FAR_AWAY = {socket.AF_INET: "192.0.2.1", socket.AF_INET6: "2001:db8::1"}


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


def names_elsewhere(listener: socket.socket) -> tuple[str, ...]:
    """Under which addresses and which name other machines may know this one, for a socket on all of its networks."""
    both = listener.family == socket.AF_INET6 and not listener.getsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY)
    families = (socket.AF_INET, socket.AF_INET6) if both else (listener.family,)
    addresses = (_own_address(family) for family in families)
    return tuple(name for name in (*addresses, socket.gethostname()) if name and name != "localhost")


def _own_address(family: int) -> str:
    """The address of this machine that others see; "" without a network."""
    with contextlib.suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as asked:
        asked.connect((_FAR_AWAY[socket.AddressFamily(family)], 9))
        address = str(asked.getsockname()[0])
        return "" if ipaddress.ip_address(address).is_loopback else address
    return ""
