"""Recorded loops: what is run plainly, what is replayed, and what happens when recording is impossible."""

import gc
import weakref
from contextlib import contextmanager, nullcontext

import pytest
import torch
from fake_graphs import FakeGraphs

from ecslam.kernels.graphs import Recorder, capture_cuda


def sum_and_difference(a, b):
    return a + b, a - b


def halves(a, b):
    return a[:2].float(), b[:2].float()


def pair(x):
    return torch.tensor([x, 2 * x]), torch.tensor([1.0, x])


def test_the_second_call_is_recorded_and_later_ones_replay_with_their_own_inputs():
    graphs = FakeGraphs()
    recorder = Recorder(capture=graphs.capture)
    for call, x in enumerate((3.0, 5.0, 7.0)):
        total, difference = recorder(sum_and_difference, *pair(x), key=0)
        assert torch.equal(total, sum_and_difference(*pair(x))[0])
        assert torch.equal(difference, sum_and_difference(*pair(x))[1])
        assert (graphs.recorded, graphs.replayed) == (min(call, 1), call)


def test_results_are_the_callers_own():
    recorder = Recorder(capture=FakeGraphs().capture)
    recorder(sum_and_difference, *pair(1.0), key=0)
    first = recorder(sum_and_difference, *pair(2.0), key=0)[0]
    kept = first.clone()
    recorder(sum_and_difference, *pair(9.0), key=0)
    assert torch.equal(first, kept)


def test_every_call_takes_effect_once():
    state = torch.zeros(1)

    def add(x):
        state.add_(x)
        return (state.clone().expand(2), x.expand(2))

    recorder = Recorder(capture=FakeGraphs().capture)
    for _ in range(4):
        recorder(add, torch.ones(1), key=0, over=(state,))
    assert state == 4


@pytest.mark.parametrize("change", ["shape", "dtype", "key", "over"])
def test_another_size_key_or_object_is_another_graph(change):
    graphs, old, new = FakeGraphs(), torch.zeros(1), torch.zeros(1)
    recorder = Recorder(capture=graphs.capture)
    for _ in range(2):
        recorder(halves, *pair(1.0), key=1, over=(old,))
    assert graphs.recorded == 1
    a, b = pair(1.0)
    if change == "shape":
        a, b = torch.ones(3), torch.ones(3)
    if change == "dtype":
        a, b = a.double(), b.double()
    key, over = (2 if change == "key" else 1), ((new,) if change == "over" else (old,))
    recorder(halves, a, b, key=key, over=over)
    known = change == "over"  # then nothing is left to compile, and it is recorded at once
    assert graphs.replayed == 1 + known
    recorder(halves, a, b, key=key, over=over)
    assert (graphs.recorded, graphs.replayed) == (2, 2 + known)


def test_lent_results_are_those_of_the_graph_itself():
    graphs, kept = FakeGraphs(), []
    recorder = Recorder(capture=graphs.capture)
    for x in (1.0, 2.0, 3.0):
        kept.append(recorder(lambda a: (a + 1,), torch.full((1,), x), key=0, lent=True)[0])
        assert kept[-1] == x + 1
    assert graphs.replayed == 2


def test_what_is_given_nothing_runs_where_it_is_told():
    graphs, state = FakeGraphs(), torch.zeros(1)
    recorder = Recorder(capture=graphs.capture)
    for _ in range(3):
        recorder(lambda: (state.add_(1),), key=0, over=(state,), device=torch.device("cpu"))
    assert state == 3
    assert (graphs.recorded, graphs.replayed) == (1, 2)


def test_what_is_forgotten_is_recorded_again():
    graphs = FakeGraphs()
    recorder = Recorder(capture=graphs.capture)
    for _ in range(2):
        recorder(sum_and_difference, *pair(1.0), key=0)
    recorder.forget()
    for _ in range(2):
        recorder(sum_and_difference, *pair(1.0), key=0)
    assert (graphs.recorded, graphs.replayed) == (2, 2)


def test_the_least_recently_used_graph_is_forgotten():
    graphs = FakeGraphs()
    recorder = Recorder(keep=2, capture=graphs.capture)
    for key in ("a", "a", "b", "b", "a", "c", "c"):
        recorder(sum_and_difference, *pair(1.0), key=key)
    assert graphs.recorded == 3
    recorder(sum_and_difference, *pair(1.0), key="a")
    assert graphs.recorded == 3
    recorder(sum_and_difference, *pair(1.0), key="b")
    recorder(sum_and_difference, *pair(1.0), key="b")
    assert graphs.recorded == 4


def test_where_recording_fails_everything_runs_plainly():
    tried = []

    def refuse(function, device):
        tried.append(device)
        raise RuntimeError("operation not permitted when stream is capturing")

    recorder = Recorder(capture=refuse)
    for x in (1.0, 2.0, 3.0):
        assert torch.equal(recorder(sum_and_difference, *pair(x), key=0)[0], sum_and_difference(*pair(x))[0])
    assert len(tried) == 1
    assert "not permitted" in recorder.failure


def test_what_cannot_be_recorded_at_once_is_recorded_after_a_plain_call():
    """Over new objects something may be left to compile, or to upload."""
    graphs, tried = FakeGraphs(), []

    def capture(function, device):
        tried.append(device)
        if len(tried) == 2:
            raise RuntimeError("operation not permitted when stream is capturing")
        return graphs.capture(function, device)

    recorder, old, new = Recorder(capture=capture), torch.zeros(1), torch.zeros(1)
    for state in (old, old, new, new, new):
        assert recorder(halves, *pair(1.0), key=0, over=(state,))[0][0] == 1
    assert recorder.failure == ""
    assert (len(tried), graphs.recorded, graphs.replayed) == (3, 2, 3)


def test_after_a_recording_that_fails_the_thread_is_in_its_own_stream(monkeypatch):
    now = ["own"]

    @contextmanager
    def stream(entered):
        before, now[0] = now[0], entered
        try:
            yield
        finally:
            now[0] = before

    class Graph:
        """Like CUDA's: a recording in which something was not permitted cannot be ended."""

        def capture_begin(self, pool, capture_error_mode):
            assert (now, pool, capture_error_mode) == (["recording"], (0, 1), "thread_local")

        def capture_end(self):
            raise RuntimeError("operation failed due to a previous error during capture")

    monkeypatch.setattr(torch.cuda, "device", lambda device: nullcontext())
    monkeypatch.setattr(torch.cuda, "CUDAGraph", Graph)
    monkeypatch.setattr("ecslam.kernels.graphs._lane", lambda device: "recording")
    monkeypatch.setattr(torch.cuda, "stream", stream)

    def refuse():
        assert now == ["recording"]
        assert not gc.isenabled()
        raise RuntimeError("operation not permitted when stream is capturing")

    with pytest.raises(RuntimeError, match="previous error") as raised:
        capture_cuda(refuse, torch.device("cuda"), (0, 1))
    assert "not permitted" in str(raised.value.__context__)
    assert now == ["own"]
    assert gc.isenabled()


class Pools:
    """Memory of graphs as torch has it: a pool whose last graph has gone is not given again, nor before 2.13 is one in
    which a recording has failed."""

    def __init__(self, monkeypatch, fails=()):
        self.counts, self.stuck, self.fails, self.recorded = {}, set(), fails, 0
        monkeypatch.setattr("ecslam.kernels.graphs.capture_cuda", self.capture)
        monkeypatch.setattr(torch.cuda, "graph_pool_handle", lambda: (0, len(self.counts) + 1))

    def capture(self, function, device, pool):
        if self.counts.setdefault(pool, None) == 0:
            raise RuntimeError("use_count > 0 INTERNAL ASSERT FAILED")
        if pool in self.stuck:
            raise RuntimeError("beginAllocateToPool: already recording to mempool_id")
        self.recorded += 1
        if self.recorded in self.fails:
            self.stuck.add(pool)
            raise RuntimeError("operation failed due to a previous error during capture")
        self.counts[pool] = (self.counts[pool] or 0) + 1

        def replay():
            outputs[0].copy_(function()[0])

        def gone():
            self.counts[pool] -= 1

        outputs = function()
        weakref.finalize(replay, gone)
        return replay, outputs


def doubled(x):
    return (2 * x,)


def test_graphs_are_recorded_again_in_new_memory_once_all_are_forgotten(monkeypatch):
    pools = Pools(monkeypatch)
    recorder = Recorder()
    for time in range(3):
        for _ in range(3):
            assert recorder(doubled, torch.ones(1), key=0, device=torch.device("cuda")) == (2,)
        assert (recorder.failure, pools.recorded) == ("", time + 1)
        recorder.forget()


def test_graphs_are_recorded_again_in_new_memory_once_all_have_had_to_go(monkeypatch):
    pools = Pools(monkeypatch)
    recorder = Recorder(keep=1)
    for time in range(3):
        for _ in range(3):
            recorder(doubled, torch.ones(1), key=time, device=torch.device("cuda"))
        assert (recorder.failure, pools.recorded) == ("", time + 1)


def test_graphs_share_memory_as_long_as_one_of_them_is_there(monkeypatch):
    pools = Pools(monkeypatch)
    recorder = Recorder()
    for _ in range(2):
        for key in (0, 1):
            recorder(doubled, torch.ones(1), key=key, device=torch.device("cuda"))
    assert list(pools.counts.values()) == [2]


def test_a_recording_that_fails_leaves_others_memory_of_their_own(monkeypatch):
    pools = Pools(monkeypatch, fails=(2,))
    recorder, old, new = Recorder(), torch.zeros(1), torch.zeros(1)
    for state in (old, old, new, new, new):
        assert recorder(doubled, torch.ones(1), key=0, over=(state,), device=torch.device("cuda")) == (2,)
    assert (recorder.failure, pools.recorded) == ("", 3)


def test_a_mistake_of_the_function_itself_is_not_swallowed():
    def wrong(x):
        raise ValueError("wrong")

    recorder = Recorder(capture=FakeGraphs().capture)
    for _ in range(2):
        with pytest.raises(ValueError, match="wrong"):
            recorder(wrong, torch.zeros(1), key=0)


def test_without_cuda_every_call_is_plain():
    recorder = Recorder()
    for _ in range(3):
        assert torch.equal(recorder(sum_and_difference, *pair(4.0), key=0)[1], sum_and_difference(*pair(4.0))[1])
    assert recorder.failure == ""
