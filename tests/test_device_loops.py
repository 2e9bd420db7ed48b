"""Mapping and tracking as a GPU does them, on the CPU: rays drawn on the device, loops that a CUDA graph can record."""

from dataclasses import fields
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from fake_graphs import FakeGraphs, Forbidding
from torch.utils._python_dispatch import TorchDispatchMode

from ecslam import kernels as seam
from ecslam.config_files import apply_settings, load_preset
from ecslam.datasets import open_sequence
from ecslam.draws import Desk, DeviceDraw, DeviceViews, shares
from ecslam.field import create_field, grow_field
from ecslam.kernels import FieldParams, RayBatch, StepResult, reference
from ecslam.kernels.graphs import Recorder
from ecslam.keyframes import make_keyframe
from ecslam.mapper import Job, Mapper
from ecslam.pixel_bank import PixelBank
from ecslam.pixels import Pixels, choose_pixels
from ecslam.pose_adam import pose_rates
from ecslam.rays import upload
from ecslam.rigid import rotation_angle_deg
from ecslam.tracker import descend_rendered, track_adam

CPU = torch.device("cpu")
SETTINGS = ["mapping.rays=600", "mapping.iterations=6", "window.size=5", "field.log2_table_size=12"]
BOX = np.array([[-4.0, -4, -4], [4, 4, 4]])


@pytest.fixture(scope="module")
def room():
    return open_sequence("synthetic/studio?size=96x72&frames=120")


@pytest.fixture(scope="module")
def config():
    return apply_settings(load_preset("lite"), SETTINGS)


def keyframes(room, config, holes=0.0):
    """Pixels and true poses of three frames; a share of the depths missing."""
    rng, views, poses = np.random.default_rng(0), [], []
    for index in (0, 3, 6):
        frame = room[index]
        frame.depth[rng.random(frame.depth.shape) < holes] = 0
        views.append(make_keyframe(frame, room.intrinsics, config).pixels)
        poses.append(frame.c2w_gt)
    return views, np.stack(poses)


def mapper(room, config, recorder=None):
    _, kernels, _ = seam.select(CPU)
    return Mapper(create_field(config.field, room.bounds, 0, CPU), kernels, 0, recorder)


@pytest.mark.slow
@pytest.mark.parametrize("holes", [0.0, 0.3])
def test_a_map_drawn_on_the_device_is_as_good_as_one_drawn_by_numpy(room, config, holes):
    views, poses = keyframes(room, config, holes)
    fixed = np.ones(3, bool)
    host, device = mapper(room, config), mapper(room, config)
    expected = host.begin(views, poses, fixed, 60, config).result()
    job = Job(config, move=False, smooth=False, settle=False)
    _, losses, sound = device._on_device(job, views, poses, fixed, 60, lambda: None)
    assert losses.shape == (60, 5)
    assert sound.all()
    assert losses[0].sum() == pytest.approx(expected.loss_first, rel=0.15)
    assert losses[-5:].mean(0).sum() == pytest.approx(sum(expected.losses.values()), rel=0.25)
    assert losses[-1].sum() < 0.3 * losses[0].sum()


@pytest.mark.slow
def test_poses_move_on_the_device_as_they_do_on_the_host(room):
    config = apply_settings(load_preset("lite"), [*SETTINGS, "mapping.lr_rotation=1e-3", "mapping.lr_translation=1e-3"])
    views, poses = keyframes(room, config)
    off = poses.copy()
    off[2, :3, 3] += 0.01
    fixed = np.array([True, True, False])
    errors = []
    for on_device in (False, True):
        one = mapper(room, config)
        one.begin(views, poses, np.ones(3, bool), 150, config).result()
        job = Job(config, move=True, smooth=False, settle=False)
        if on_device:
            moved = one._on_device(job, views, off, fixed, 40, lambda: None)[0].numpy()
        else:
            moved = one.begin(views, off, fixed, 40, config).result().c2w
        assert moved.shape == (3, 4, 4)
        assert np.array_equal(moved[:2], poses[:2])
        errors.append(float(np.linalg.norm(moved[2, :3, 3] - poses[2, :3, 3])))
    assert max(errors) < 0.012
    assert errors[1] == pytest.approx(errors[0], abs=0.003)


@pytest.mark.parametrize("holes", [0.0, 0.3])
def test_replayed_loops_do_what_plain_ones_do(room, config, holes):
    """A replay repeats what was recorded, so nothing that changes from call to call may come from anywhere else than
    the inputs: other views, fewer of them, other poses, the course of the learning rates."""
    views, poses = keyframes(room, config, holes)
    graphs = FakeGraphs()
    found = []
    for recorder in (Recorder(plain=True), Recorder(capture=graphs.capture)):
        one, results = mapper(room, config, recorder), []
        for settle, count in ((False, 3), (False, 3), (False, 2), (False, 3), (True, 3)):
            fixed = np.arange(count) < (count if settle else 1)
            job = Job(config, move=not settle, smooth=False, settle=settle)
            results += one._on_device(job, views[:count], poses[:count], fixed, 30 if settle else 6, lambda: None)
        results += [one.field.params.table, one.field.params.beta]
        found.append(results)
    for plain, replayed in zip(*found, strict=True):
        assert torch.equal(plain, replayed)
    assert (graphs.recorded, graphs.replayed) == (2, 3 + 2)


@pytest.mark.parametrize("compiled", [True, False])
def test_a_loop_that_follows_growth_is_recorded_again(room, config, compiled):
    """At once where its kernels are compiled: Triton does that for sizes that are multiples of 16, and for others."""
    views, poses = keyframes(room, config)
    graphs = FakeGraphs()
    one = mapper(room, config, Recorder(capture=graphs.capture))
    job, box = Job(config, move=True, smooth=False, settle=False), one.field.layout.box.numpy()

    def map_once():
        one._on_device(job, views, poses, np.ones(3, bool), 4, lambda: None)
        return graphs.recorded

    def aligned(field):
        return field.params.table.numel() % 16 == 0

    assert [map_once(), map_once()] == [0, 1]
    boxes = (box * scale for scale in np.arange(1.1, 3, 0.05))
    one.grow(next(box for box in boxes if (aligned(grow_field(one.field, box)) == aligned(one.field)) == compiled))
    assert [map_once(), map_once()] == [2 if compiled else 1, 2]


@pytest.mark.slow
def test_tracking_is_the_same_recorded_and_plain(room, config):
    views, poses = keyframes(room, config)
    one = mapper(room, config)
    one.begin(views, poses, np.ones(3, bool), 100, config).result()
    graphs, found = FakeGraphs(), []
    for recorder in (Recorder(plain=True), Recorder(capture=graphs.capture)):
        generator = torch.Generator().manual_seed(0)
        for index in (1, 2, 4):
            frame = room[index]
            pixels = choose_pixels(frame, room.intrinsics, 300, config, np.random.default_rng(index))
            c2w, terms = track_adam(one.field, one.kernels, pixels, frame.c2w_gt, config, generator, recorder)
            found.append((c2w, *terms.values()))
    for plain, replayed in zip(found[:3], found[3:], strict=True):
        assert np.array_equal(plain[0], replayed[0])
        assert plain[1:] == replayed[1:]
    assert (graphs.recorded, graphs.replayed) == (1, 2)


@pytest.mark.slow
def test_steps_are_longer_where_no_alignment_came_before(room, config):
    views, poses = keyframes(room, config)
    one = mapper(room, config)
    one.begin(views, poses, np.ones(3, bool), 100, config).result()
    pixels = choose_pixels(room[1], room.intrinsics, 300, config, np.random.default_rng(0))
    guess = np.array(room[1].c2w_gt)
    guess[:3, 3] += 0.03
    turned = []
    for to in ("fused", "none"):
        chosen = apply_settings(config, [f"align.to={to}", "tracking.iterations=2"])
        generator = torch.Generator().manual_seed(0)
        found, _ = track_adam(one.field, one.kernels, pixels, guess, chosen, generator, Recorder(plain=True))
        turned.append(np.radians(rotation_angle_deg(guess, found)))
    rate = config.tracking.lr_rotation * 3**0.5  # Adam's first step is the rate in each number
    assert turned == pytest.approx([rate, config.tracking.unaligned_rate * rate], rel=1e-3)


class NoKernels:
    """Back end of the right sizes that computes nothing."""

    @staticmethod
    def step(layout, params, c2w, rays, weights, into, want_poses, adam=None):
        assert rays.z.device.type == c2w.device.type == "meta"
        return StepResult(rays.z.new_zeros(5), c2w.new_zeros(len(c2w), 3, 4) if want_poses else None)

    @staticmethod
    def render(layout, params, c2w, rays):
        return rays.color, rays.depth, torch.zeros_like(rays.z)

    sample_depths = staticmethod(reference.sample_depths)
    importance_depths = staticmethod(reference.importance_depths)

    @staticmethod
    def pose_step(c2w, d_c2w, moments, rates, count):
        return c2w + 0 * rates.sum()

    @staticmethod
    def map_step(parameters, gradients, adam):
        pass


@pytest.fixture
def gpu(monkeypatch):
    """A device whose tensors have sizes and no values, so that none can be waited for."""
    return torch.device("meta")


def empty_mapper(device):
    """With a map of the right sizes that holds no numbers."""
    shapes = ((50, 2), (80, 64), (32, 1), (32, 3), (1,))
    params = FieldParams(*(torch.empty(shape, device=device) for shape in shapes))
    layout = SimpleNamespace(box=torch.from_numpy(BOX).float())
    return Mapper(SimpleNamespace(device=device, layout=layout, params=params), NoKernels, 0)


@pytest.mark.parametrize("missing", [False, True])
@pytest.mark.parametrize("settle", [False, True])
def test_no_iteration_of_a_mapping_waits_for_the_gpu(gpu, config, missing, settle):
    one, on_gpu = empty_mapper(gpu), partial(torch.empty, device=gpu)
    s, m, poses = config.sampling, config.mapping, 5
    job = Job(config, move=not settle, smooth=False, settle=settle)
    draws = on_gpu(4, m.rays, 1 + s.uniform + (2 if missing else 1) * s.near_depth)
    with Forbidding():
        views = DeviceViews(
            one._bank.columns, on_gpu(24 * poses, dtype=torch.float64), on_gpu(m.rays, dtype=torch.int64),
            on_gpu(2, 3), missing,
        )  # fmt: skip
        c2w, losses, sound = one._loop(job, views, draws, on_gpu(4))
    assert (c2w.device.type, c2w.shape, losses.shape, sound.shape) == ("meta", (5, 4, 4), (4, 5), (1,))


class Sending(TorchDispatchMode):
    """Raises when something is sent to a device that the host would wait for."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        sent = func.overloadpacket.__name__ == "_to_copy" and kwargs.get("device", CPU) != CPU
        assert kwargs.get("non_blocking") or not sent, f"{func} waits for the device"
        return func(*args, **kwargs)


def test_what_a_mapping_needs_is_sent_without_waiting(gpu, config, room, monkeypatch):
    monkeypatch.setattr("ecslam.mapper.seeded", lambda rng, device: None)
    one, (views, poses) = empty_mapper(gpu), keyframes(room, config)
    job = Job(config, move=True, smooth=False, settle=False)
    with Sending():
        c2w, losses, _ = one._on_device(job, views, poses, np.arange(3) == 0, 4, lambda: None)
    assert (c2w.device.type, c2w.shape, losses.shape) == ("meta", (3, 4, 4), (4, 5))


def test_no_iteration_of_tracking_waits_for_the_gpu(gpu):
    c2w, rates = (torch.empty(1, *shape, dtype=torch.float64, device=gpu) for shape in ((4, 4), (6,)))
    shapes = ((30, 3), (30, 7), (30,), (30, 3))
    rays = [torch.empty(shape, device=gpu) for shape in shapes]
    rays += [torch.empty(30, dtype=dtype, device=gpu) for dtype in (torch.bool, torch.int64)]
    field = SimpleNamespace(layout=None, params=None)
    with Forbidding():
        best, terms = descend_rendered(field, NoKernels, None, 3, 0.5, c2w, rates, *rays)
    assert (best.shape, terms.shape) == ((1, 4, 4), (5,))


@pytest.mark.parametrize(
    "act", [lambda x: x.sum().item(), lambda x: x[x > 0], lambda x: x.cpu(), lambda x: torch.nonzero(x), bool]
)
def test_what_would_wait_is_noticed(gpu, act):
    with pytest.raises(Exception, match=r"waits|moves|meta"), Forbidding():
        act(torch.ones(1, device=gpu))


def flat(count, value):
    """So many pixels of which everything says which view they are of."""
    color = np.full((count, 3), value, np.uint8)
    return Pixels(
        np.full((count, 2), value, np.float32), np.full(count, value, np.float32), color, np.zeros(count, bool)
    )


def test_a_bank_holds_every_view_once_and_grows(monkeypatch):
    monkeypatch.setattr("ecslam.pixel_bank.LEAST_ROOM", 8)
    bank, views = PixelBank(CPU), [flat(count, count) for count in (5, 3, 20)]
    first = bank.columns
    assert [place.first for place in bank.places(views[:2])] == [0, 5]
    assert bank.columns is first
    assert [place.first for place in bank.places([views[2], views[0]])] == [8, 0]
    assert bank.columns is not first
    assert [place.missing for place in bank.places([*views, flat(4, 0)])] == [False, False, False, True]
    for place, view in zip(bank.places(views), views, strict=True):
        held = bank.columns.take(torch.arange(place.first, place.first + len(view)))
        expected = upload(view, CPU)
        assert torch.equal(held.direction, expected.direction)
        assert torch.equal(held.color, expected.color)
        assert torch.equal(held.depth, expected.depth)


def test_rays_come_from_their_own_view_in_the_shares_asked_for(config):
    views = [flat(count, value) for count, value in ((5, 1), (1, 2), (40, 3))]
    bank, generator = PixelBank(CPU), torch.Generator().manual_seed(0)
    box, still = torch.from_numpy(BOX).float(), np.zeros((3, 6))
    desk = Desk(5, config.mapping.rays, CPU)
    chosen = desk.lay_out(bank, views, np.tile(np.eye(4), (3, 1, 1)), still, config.mapping.newest_share, box)
    jitter = desk.jitter(2, chosen.jitter(config), generator)
    rays = DeviceDraw(chosen, jitter, torch.eye(4).expand(5, 4, 4), config, None, reference)(1, None)
    assert len(rays.depth) == config.mapping.rays
    assert (rays.pose.diff() >= 0).all()
    assert torch.equal(rays.depth, rays.pose.float() + 1)
    counts = np.array(shares(3, config.mapping.rays, config.mapping.newest_share))
    assert np.abs(np.bincount(rays.pose.numpy()) - counts).max() <= 3


@pytest.mark.parametrize("holes", [0.0, 0.3])
def test_rays_drawn_at_once_are_those_that_each_iteration_would_draw(room, config, holes):
    views, poses = keyframes(room, config, holes)
    one = mapper(room, config)
    c2w, box = torch.from_numpy(poses), one.field.layout.box
    desk, rates = Desk(len(views), config.mapping.rays, CPU), np.zeros((len(views), 6))
    chosen = desk.lay_out(one._bank, views, poses, rates, config.mapping.newest_share, box)
    jitter = desk.jitter(3, chosen.jitter(config), torch.Generator().manual_seed(0))
    assert chosen.missing == (holes > 0)
    together = DeviceDraw(chosen, jitter, c2w, config, one.field, one.kernels)
    for i in range(3):
        rays = together(i, c2w.float())
        alone = DeviceDraw(chosen, jitter[i : i + 1], c2w, config, one.field, one.kernels)(0, c2w.float())
        for f in fields(RayBatch):
            found = getattr(rays, f.name)
            assert found.is_contiguous()
            assert torch.equal(found, getattr(alone, f.name))


def test_rates_of_fixed_poses_are_zero():
    rates = pose_rates(torch.tensor([True, False]), 2.0, 1.0)
    assert rates.tolist() == [[0.0] * 6, [1.0] * 3 + [2.0] * 3]
