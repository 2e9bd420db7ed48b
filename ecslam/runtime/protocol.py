"""The one door between an engine and whoever watches or steers it (the dashboard, the command line, a test)."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol, runtime_checkable

from ..messages import Ack, Command, Event, Snapshot


@runtime_checkable
class Subscription(Protocol):
    """One reader's view of the feed. Snapshots are newest-wins; events and acknowledgements are never dropped.

    overrun: the reader was too slow and the subscription has ended; it may subscribe again.
    """

    overrun: bool

    def get(self, timeout: float | None = None) -> Snapshot | Event | Ack | None:
        """The next message; waits at most ``timeout`` seconds (None: for ever). None on time-out and after close."""
        ...

    def close(self) -> None:
        """Stop receiving; a waiting ``get`` returns None. May be called more than once and from any thread."""
        ...


@runtime_checkable
class EngineHandle(Protocol):
    """What a live engine and the replay of a finished run have in common.

    sequences: addresses that ``Restart`` accepts (built-in rooms, folders under the data roots). presets: names that
    ``Restart`` and ``LoadPreset`` accept. run_folder: where exports are written.
    """

    @property
    def sequences(self) -> tuple[str, ...]:
        """Addresses that ``Restart`` accepts."""
        ...

    @property
    def presets(self) -> tuple[str, ...]:
        """Names that ``Restart`` and ``LoadPreset`` accept."""
        ...

    @property
    def run_folder(self) -> Path:
        """Where the run writes."""
        ...

    def submit(self, command: Command) -> int:
        """Give a command and return its id, which the ``Ack`` will carry. Never blocks; callable from any thread."""
        ...

    def latest(self) -> Snapshot | None:
        """The newest snapshot, or None before the first. Never blocks."""
        ...

    def subscribe(self) -> Subscription:
        """Start reading the feed from now on."""
        ...
