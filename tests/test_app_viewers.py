"""Many viewers, and viewers that stop reading: what they may cost the engine's process."""

from __future__ import annotations

import os
import socket
import time
from pathlib import Path
from statistics import median

import msgspec
import numpy as np
import pytest
import zstandard
from ecslam_app import broadcast, front, server
from ecslam_app.readers import crowd, greeting
from viser._messages import SceneNodeUpdateMessage

from tests.fake_engine import FakeEngine
from tests.test_app_security import until

MB = 1024 * 1024


@pytest.fixture
def page(tmp_path):
    engine = FakeEngine(tmp_path / "run", frames=100_000, period=0.02).start()
    dashboard = server.start(engine, port=0)
    yield dashboard
    dashboard.close()
    engine.stop()


def memory():
    """Bytes that this process holds."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


needs_proc = pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads the memory's size from /proc")


def unpack(data):
    """The messages and arrays of one batch, read independently of how they were written."""
    squeezed = int.from_bytes(data[8:16], "little")
    body = msgspec.msgpack.decode(zstandard.decompress(data[16 : 16 + squeezed]))
    at, arrays = 16 + squeezed, []
    for length in body["binaryBufferLengths"]:
        at += -at % 8
        arrays.append(data[at : at + length])
        at += length
    assert at == len(data)
    assert int.from_bytes(data[:8], "little") == len(msgspec.msgpack.encode(body))
    return body["messages"], arrays


def batch(*values):
    return [SceneNodeUpdateMessage(f"/node{k}", {"points": value}) for k, value in enumerate(values)]


def test_a_batch_can_be_read_back():
    points, odd = np.arange(12, dtype=np.float32), np.arange(5, dtype=np.uint8)
    messages, arrays = unpack(broadcast.pack(batch(points, odd, points)))
    assert [message["name"] for message in messages] == ["/node0", "/node1", "/node2"]
    assert arrays == [points.tobytes(), odd.tobytes(), points.tobytes()]
    assert unpack(broadcast.pack(batch()))[1] == []


def test_viewers_in_step_get_the_same_bytes_and_others_their_own():
    packer, first, second = broadcast.Packer(), batch(np.zeros(3)), batch(np.ones(3))
    assert packer.shared(list(first)) is packer.shared(list(first))
    assert unpack(packer.shared(second))[1] != unpack(packer.shared(first))[1]
    for _ in range(50):  # a short-lived batch may leave its address to the next one
        value = np.random.default_rng().random(3)
        assert unpack(packer.shared(batch(value)))[1] == [value.tobytes()]


@pytest.mark.slow
def test_twenty_viewers_cost_one_packing(tmp_path, monkeypatch):
    """All are served, from about one packing a batch. The engine's rate with and without them is printed, not asserted.

    The viewers are one process that reads and drops bytes: their own decoding is not the engine's machine's business.
    """
    made, sent = [], []
    pack, shared = broadcast.pack, broadcast.Packer.shared
    monkeypatch.setattr(broadcast, "pack", lambda batch: made.append(1) or pack(batch))
    monkeypatch.setattr(broadcast.Packer, "shared", lambda self, batch: sent.append(1) or shared(self, batch))
    engine = FakeEngine(tmp_path / "run", frames=100_000, period=0.01).start()
    page = server.start(engine, port=0)

    def rate(seconds=1.5):
        first, began = engine.latest().frame, time.monotonic()
        time.sleep(seconds)
        return (engine.latest().frame - first) / (time.monotonic() - began)

    alone, watched = [], []
    try:
        assert until(lambda: engine.latest() is not None)
        for _ in range(3):
            alone.append(rate())
            with crowd(page, 20):
                time.sleep(0.5)
                made.clear()
                sent.clear()
                watched.append(rate())
                assert len(list(page.hub.viewers())) == 20
                assert len(sent) > 20
                assert len(made) < 0.4 * len(sent)
    finally:
        page.close()
        engine.stop()
    ratios = " ".join(f"{b / a:.2f}" for a, b in zip(alone, watched, strict=True))
    print(f"frames/s with 20 viewers over without: {ratios}, median {median(watched) / median(alone):.2f}")


@pytest.fixture
def deaf(page):
    """A viewer that says hello and then never reads."""
    states = page.hub.server._websock_server._client_state_from_id
    with socket.socket() as client:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        client.connect(("127.0.0.1", page.port))
        client.sendall(greeting(page.port))
        assert until(lambda: len(states) == 1)
        yield states


def flood(page, count):
    """Push ``count`` updates of 4 MB each."""
    for _ in range(count):
        page.hub.server.scene.add_glb("/flood", os.urandom(4 * MB))
        time.sleep(0.02)


@needs_proc
@pytest.mark.slow
def test_a_viewer_that_reads_nothing_does_not_grow_the_memory(page, deaf):
    flood(page, 5)
    before = memory()
    flood(page, 120)
    assert len(deaf) == 1, "it is still connected"
    assert memory() - before < 160 * MB, "480 MB were pushed"


def test_a_viewer_that_reads_nothing_is_dropped(page, deaf, monkeypatch):
    monkeypatch.setattr(front, "STALL_S", 0.5)

    def flooded():
        flood(page, 3)
        return len(deaf) == 0

    assert until(flooded, 30)


@needs_proc
def test_a_viewer_that_reads_nothing_cannot_pile_up_downloads(page, deaf, tmp_path):
    path = Path(tmp_path / "large.bin")
    path.write_bytes(os.urandom(30 * MB))
    assert until(lambda: list(page.hub.viewers()))
    client = next(iter(page.hub.viewers()))
    flood(page, 2)
    page.hub.deliver(client, path)
    before = memory()
    for _ in range(20):
        page.hub.deliver(client, path)
    assert memory() - before < 200 * MB, "600 MB were asked for"
