"""Snapshots and messages from the engine to any number of readers, each at its own pace.

Snapshots are newest-wins: a slow reader skips the ones in between. Events and acknowledgements are never dropped: an
open subscription hands out every one of them, in order. Memory stays bounded all the same: a subscription whose unread
messages exceed ``MAX_BACKLOG`` messages or ``MAX_BACKLOG_BYTES`` is ended (``get`` returns None, ``overrun`` is True),
so a reader either has everything or knows that it has not; it may subscribe again.
"""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import fields, is_dataclass
from time import monotonic

import numpy as np

from ..messages import Ack, Event, Snapshot

MAX_BACKLOG = 10_000
MAX_BACKLOG_BYTES = 512 << 20


class FeedSubscription:
    """One reader's queue. ``get`` gives waiting messages first, in order, then the newest unread snapshot."""

    def __init__(self, feed: Feed) -> None:
        self._feed = feed
        self._changed = threading.Condition()
        self._messages: deque[tuple[Event | Ack, int]] = deque()
        self._bytes = 0
        self._snapshot: Snapshot | None = None
        self._closed = False
        self.overrun = False

    def get(self, timeout: float | None = None) -> Snapshot | Event | Ack | None:
        """The next message; waits at most ``timeout`` seconds (None: for ever). None on time-out and after close."""
        deadline = None if timeout is None else monotonic() + timeout
        with self._changed:
            while not (self._messages or self._snapshot or self._closed):
                left = None if deadline is None else deadline - monotonic()
                if (left is not None and left <= 0) or not self._changed.wait(left):
                    return None
            if self._closed:
                return None
            if self._messages:
                message, size = self._messages.popleft()
                self._bytes -= size
                return message
            snapshot, self._snapshot = self._snapshot, None
            return snapshot

    def close(self) -> None:
        """Stop receiving; a waiting ``get`` returns None. May be called more than once and from any thread."""
        self._feed.forget(self)
        with self._changed:
            self._closed = True
            self._messages.clear()
            self._snapshot = None
            self._changed.notify_all()

    def put(self, item: Snapshot | Event | Ack) -> None:
        """Called by the feed."""
        with self._changed:
            if self._closed:
                return
            if isinstance(item, Snapshot):
                self._snapshot = item
            else:
                size = array_bytes(item)
                self._messages.append((item, size))
                self._bytes += size
                self.overrun = len(self._messages) > MAX_BACKLOG or self._bytes > MAX_BACKLOG_BYTES
            self._changed.notify_all()
        if self.overrun:
            self.close()


class Feed:
    """The sending end. Callable from any thread; never waits for a reader."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._subscriptions: tuple[FeedSubscription, ...] = ()
        self._latest: Snapshot | None = None

    @property
    def watched(self) -> bool:
        """Whether anybody subscribes."""
        return bool(self._subscriptions)

    def publish(self, item: Snapshot | Event | Ack) -> None:
        """Hand ``item`` to every subscription."""
        if isinstance(item, Snapshot):
            self._latest = item
        for subscription in self._subscriptions:
            subscription.put(item)

    def latest(self) -> Snapshot | None:
        """The newest snapshot, or None before the first."""
        return self._latest

    def subscribe(self) -> FeedSubscription:
        """Read from now on; the newest snapshot so far comes first."""
        subscription = FeedSubscription(self)
        with self._lock:
            self._subscriptions = (*self._subscriptions, subscription)
        if self._latest is not None:
            subscription.put(self._latest)
        return subscription

    def forget(self, subscription: FeedSubscription) -> None:
        """Called by a subscription that closes."""
        with self._lock:
            self._subscriptions = tuple(s for s in self._subscriptions if s is not subscription)


def array_bytes(value: object) -> int:
    """Memory of the arrays in a message, in bytes (1 KiB for everything else)."""
    if isinstance(value, np.ndarray):
        return int(value.nbytes)
    if is_dataclass(value):
        return 1024 + sum(array_bytes(getattr(value, f.name)) for f in fields(value) if f.name != "command")
    return 0
