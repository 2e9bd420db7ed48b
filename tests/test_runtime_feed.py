"""Laws of the feed: snapshots are newest-wins, messages complete and in order, memory bounded, closing wakes."""

import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from ecslam.messages import Ack, MeshReady, Notice, Pause, Snapshot, State
from ecslam.runtime import feed as module
from ecslam.runtime.feed import Feed, array_bytes
from ecslam.runtime.protocol import Subscription
from ecslam.types import Mesh

EMPTY = Snapshot(
    State.TRACKING,
    "s",
    "lite",
    0,
    9,
    np.zeros((0, 4, 4)),
    None,
    (),
    (),
    None,
    1.0,
    1.3,
    {},
    0,
    0,
    0,
    0,
    None,
    0,
    (),
    0,
    0,
)


def snapshot(frame: int) -> Snapshot:
    return replace(EMPTY, frame=frame)


def notice(number: int) -> Notice:
    return Notice("info", str(number), number)


def drain(subscription) -> list:
    return list(iter(lambda: subscription.get(0.0), None))


def test_a_slow_reader_sees_the_newest_snapshot_and_every_message_in_order():
    feed = Feed()
    slow = feed.subscribe()
    assert isinstance(slow, Subscription)
    for i in range(100):
        feed.publish(snapshot(i))
        feed.publish(notice(i))
    *messages, last = drain(slow)
    assert messages == [notice(i) for i in range(100)]
    assert isinstance(last, Snapshot)
    assert last.frame == 99
    assert feed.latest() is last


def test_each_subscription_is_complete_for_itself():
    feed = Feed()
    early = feed.subscribe()
    feed.publish(notice(0))
    late = feed.subscribe()
    feed.publish(Ack(1, Pause()))
    assert drain(early) == [notice(0), Ack(1, Pause())]
    assert drain(late) == [Ack(1, Pause())]


def test_a_late_reader_starts_with_the_newest_snapshot():
    feed = Feed()
    assert feed.latest() is None
    feed.publish(snapshot(7))
    assert [s.frame for s in drain(feed.subscribe())] == [7]


def test_get_waits_no_longer_than_asked():
    started = time.monotonic()
    assert Feed().subscribe().get(0.05) is None
    assert 0.04 < time.monotonic() - started < 1.0


def test_close_wakes_a_waiting_reader_and_ends_the_subscription():
    feed = Feed()
    subscription, got = feed.subscribe(), []
    reader = threading.Thread(target=lambda: got.append(subscription.get()))
    reader.start()
    subscription.close()
    subscription.close()
    reader.join(5)
    assert got == [None]
    assert not feed.watched
    feed.publish(notice(1))
    assert subscription.get(0.0) is None


@pytest.mark.parametrize("limit", [("MAX_BACKLOG", 10), ("MAX_BACKLOG_BYTES", 100_000)])
def test_a_reader_that_never_reads_is_ended_and_knows_it(monkeypatch, limit):
    monkeypatch.setattr(module, *limit)
    feed = Feed()
    asleep, awake = feed.subscribe(), feed.subscribe()
    for i in range(200):
        feed.publish(notice(i))
        assert awake.get(0.0) == notice(i)
    assert asleep.overrun
    assert asleep.get(0.0) is None
    assert not awake.overrun
    assert feed.watched


def test_messages_weigh_what_their_arrays_weigh():
    mesh = Mesh(np.zeros((1000, 3), np.float32), np.zeros((2000, 3), np.int32), np.zeros((1000, 3), np.uint8))
    assert 12_000 + 24_000 + 3_000 <= array_bytes(MeshReady(0, 0.1, mesh)) <= 45_000


def test_many_writers_and_readers_lose_nothing():
    feed = Feed()
    subscriptions = [feed.subscribe() for _ in range(3)]
    writers = [
        threading.Thread(target=lambda k=k: [feed.publish(notice(1000 * k + i)) for i in range(300)]) for k in range(4)
    ]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    for subscription in subscriptions:
        seen = [n.frame for n in drain(subscription)]
        assert sorted(seen) == sorted(1000 * k + i for k in range(4) for i in range(300))
        for k in range(4):
            mine = [f for f in seen if f // 1000 == k]
            assert mine == sorted(mine)
