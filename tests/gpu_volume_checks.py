"""The fused volume's GPU kernels against those on the CPU.

Not collected by itself: ``test_kernels_gpu.py`` runs it in a process of its own (see ``gpu_checks.py``). Images
are tiny and blocks larger than on a GPU, since the interpreter's time goes by programs.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from fake_graphs import FakeGraphs, Forbidding, launch_nothing
from kernel_cases import relative_rms
from on_gpu import DEVICE, INTERPRETED, moved
from planes import POSES, SWEEP, corner, look, look_row_by_row, noisy_corner, pose
from planes import TINY_CAMERA as CAMERA

from ecslam import volume_gpu
from ecslam.align import align, known_points, stages
from ecslam.config import AlignConfig, Config, FieldConfig, SamplingConfig, TrackingConfig
from ecslam.descent import RULES, descend
from ecslam.field import create_field
from ecslam.kernels import LOSS_NAMES, fusion_gpu, gpu, poses_gpu, reference, tracking_gpu
from ecslam.kernels._gpu_descent import COST, COUNT, DAMPING, DONE, EQUATIONS, ROW, SIZE, step_kernel
from ecslam.kernels.graphs import Recorder
from ecslam.observed import ObservedVoxels
from ecslam.observed_gpu import ObservedTable
from ecslam.pixels import Points, spread_pixels
from ecslam.pixels_gpu import DeviceFrame, grid_cells
from ecslam.pixels_gpu import straight_pixels as straight_on_device
from ecslam.rays import upload
from ecslam.shutter import STILL, straight_pixels
from ecslam.tracker import HostTracker
from ecslam.tracker_gpu import HEAD, TOLD, GpuTracker
from ecslam.volume import FusedVolume, create_volume
from ecslam.volume_gpu import GpuVolume

torch.set_num_threads(1)
LENGTHS = (0.04, 0.11)  # no voxel of the corner lies exactly a truncation away
CONFIG = Config(border_px=1, truncation_m=0.11, align=AlignConfig(gradient_range=(0.5, 1.5)))
TRUE, GUESS, FAR_GUESS = pose((2, 3, -1), (0.02, 0.01, -0.02)), pose((3, 2, 0), (0.05, -0.01, 0.01)), pose((3, -9, 6))


@pytest.fixture(autouse=True)
def large_blocks(monkeypatch):
    if INTERPRETED:
        monkeypatch.setattr(fusion_gpu, "BLOCK", 4096)
        monkeypatch.setattr(fusion_gpu, "POINTS", 512)
    monkeypatch.setattr(volume_gpu, "SLOTS", 1 << 9)
    monkeypatch.setattr(volume_gpu, "LEAST_POINTS", 64)


def both(frames, poses=POSES):
    """The volume on the CPU and that in the interpreter, after the same frames."""
    volumes = FusedVolume(*LENGTHS), GpuVolume(*LENGTHS, DEVICE)
    for volume in volumes:
        add(volume, frames, poses)
    return volumes


def add(volume, frames, poses=POSES, far_m=8.0):
    for seen, c2w in zip(frames, poses, strict=True):
        volume.integrate(seen, replace(CAMERA, width=seen.depth.shape[1]), c2w, 0.1, far_m)


def assert_alike(theirs, mine):
    """The same blocks, and voxels that differ by at most one unit."""
    (place, voxels), (my_place, my_voxels) = ordered(theirs), ordered(mine)
    np.testing.assert_array_equal(place, my_place)
    assert mine.used == theirs.used == len(place)
    assert (voxels[..., 2] > 0).sum() > 1000
    assert np.abs(voxels.astype(np.int64) - my_voxels).max() <= 1


def ordered(volume):
    state = volume.state()
    order = np.argsort(state["place"])
    return state["place"][order], state["voxels"][order]


def corners():
    return [look(c2w, corner(), CAMERA) for c2w in POSES]


def measured(count, guess=GUESS):
    """Points of the corner seen from TRUE, and their luminance; some are unknown."""
    pixels = spread_pixels(look(TRUE, corner(), CAMERA), CAMERA, 400, CONFIG, np.random.default_rng(2))
    points = known_points(FusedVolume(*LENGTHS), pixels, guess)
    local, light = points.local[:count], points.light[:count]
    return Points(local + 0.4 * (torch.arange(len(local)) % 7 == 3)[:, None], light)


@pytest.fixture(scope="module")
def pair():
    with pytest.MonkeyPatch.context() as patch:
        if INTERPRETED:
            patch.setattr(fusion_gpu, "BLOCK", 4096)
        patch.setattr(volume_gpu, "SLOTS", 1 << 9)
        return both(corners())


def test_frames_are_averaged_in_as_on_the_cpu(pair):
    assert_alike(*pair)


def test_replays_average_in_what_plain_calls_do(pair):
    graphs = FakeGraphs()
    mine = GpuVolume(*LENGTHS, DEVICE, Recorder(capture=graphs.capture))
    add(mine, corners())
    assert_alike(pair[0], mine)
    assert (graphs.recorded, graphs.replayed) == (1, 2)


@pytest.mark.parametrize("width", [48, 47])
def test_noise_holes_edges_and_colours(width):
    frames = [noisy_corner(c2w, replace(CAMERA, width=width)) for c2w in POSES]
    assert_alike(*both(frames))


@pytest.mark.parametrize("gain", [0.6, 1.5])
def test_luminance_is_that_of_the_first_exposure_as_on_the_cpu(gain):
    assert_alike(*both([replace(noisy_corner(c2w, CAMERA), gain=gain) for c2w in POSES]))


def test_a_rolling_shutter_is_averaged_in_as_on_the_cpu():
    volumes = FusedVolume(*LENGTHS), GpuVolume(*LENGTHS, DEVICE)
    for volume in volumes:
        for c2w in POSES:
            volume.integrate(look_row_by_row(c2w, SWEEP, corner(), CAMERA), CAMERA, c2w, 0.1, 8.0, SWEEP)
    assert_alike(*volumes)


def test_weights_have_a_limit(pair):
    state = pair[0].state()
    state["voxels"][..., 2] = np.where(state["voxels"][..., 2] > 0, 199, 0)
    theirs, mine = FusedVolume(*LENGTHS), GpuVolume(*LENGTHS, DEVICE)
    for volume in (theirs, mine):
        volume.load(state)
        add(volume, corners()[:1], POSES[:1])
    assert ordered(theirs)[1][..., 2].max() == 200
    assert_alike(theirs, mine)


def test_depth_out_of_range_adds_nothing():
    volume = GpuVolume(*LENGTHS, DEVICE)
    add(volume, corners()[:1], POSES[:1], far_m=0.3)
    assert volume.used == 0
    assert not volume.distances(np.zeros((3, 3)))[1].any()
    assert volume.state()["place"].shape == (0,)


@pytest.mark.parametrize("count", [0, 1, 511, 512, 513, 3000])
def test_distances(pair, count):
    points = np.random.default_rng(1).uniform((-0.9, -0.9, 1.5), (1, 0.8, 2.1), (count, 3))
    (theirs, known), (mine, mine_known) = (volume.distances(points) for volume in pair)
    assert (mine.dtype, mine_known.dtype) == (theirs.dtype, known.dtype)
    np.testing.assert_array_equal(mine_known, known)
    assert count < 3000 or 100 < known.sum() < 2900
    np.testing.assert_allclose(mine[known], theirs[known], atol=1e-5)


@pytest.mark.parametrize(
    ("count", "colour"), [(0, 0.1), (1, 0.1), (63, 0.0), (64, 0.1), (65, 0.1), (300, 0.1), (300, 0.0)]
)
def test_normal_equations(pair, count, colour):
    for stage in stages(CONFIG):
        settings = replace(stage, colour_weight=colour)
        theirs, mine = (volume.normal_equations(GUESS, measured(count), settings) for volume in pair)
        assert (mine.used, mine.inliers) == (theirs.used, theirs.inliers)
        assert count < 60 or theirs.used > 0.7 * count
        assert mine.cost == pytest.approx(theirs.cost, rel=1e-4)
        assert mine.jtj.dtype == mine.jtr.dtype == torch.float64
        assert relative_rms(mine.jtj, theirs.jtj) < 1e-4
        assert relative_rms(mine.jtr, theirs.jtr) < 1e-4


@pytest.mark.parametrize(("count", "guess"), [(c, GUESS) for c in (0, 1, 5, 63, 64, 65, 300)] + [(300, FAR_GUESS)])
def test_a_descent_ends_where_that_on_the_cpu_does(pair, count, guess):
    theirs, mine = (align(volume, measured(count), guess, CONFIG) for volume in pair)
    np.testing.assert_allclose(mine.c2w, theirs.c2w, atol=1e-5)
    assert mine.cost == pytest.approx(theirs.cost, rel=1e-4)


class Counting(FusedVolume):
    """Keeps the costs it was asked for."""

    def normal_equations(self, c2w, points, settings):
        found = super().normal_equations(c2w, points, settings)
        self.costs.append(found.cost)
        return found


@pytest.mark.parametrize("iterations", [1, 4, 10, 40])
def test_a_descent_that_refuses_steps(iterations):
    frames, theirs = [noisy_corner(c2w, CAMERA) for c2w in POSES], Counting(*LENGTHS)
    theirs.costs = []
    add(theirs, frames)
    mine = GpuVolume(*LENGTHS, DEVICE)
    mine.load(theirs.state())
    settings = stages(replace(CONFIG, align=replace(CONFIG.align, colour_weight_m=1.0)))[:1]
    points = measured(300)
    expected = descend(theirs, points, FAR_GUESS, settings, iterations)
    found = mine.descend(points, FAR_GUESS, settings, iterations)
    same_sums = descend(mine, points, FAR_GUESS, settings, iterations)
    np.testing.assert_allclose(found.c2w, same_sums.c2w, atol=1e-10)
    assert iterations < 10 or np.diff(theirs.costs).max() > 0
    np.testing.assert_allclose(found.c2w, expected.c2w, atol=1e-5)
    assert found.cost == pytest.approx(expected.cost, rel=1e-4)


GAIN, LOSS = 0.5, 2.0


@pytest.mark.parametrize(
    ("cost", "used", "damping", "size", "ended", "next_damping", "done"),
    [
        (GAIN, 100, 3e-4, 1.0, 0, 1e-4, False),
        (GAIN, 100, 1e-8, 1.0, 0, 1e-8, False),
        (GAIN, 100, 3e-4, 9e-6, 0, 1e-4, True),
        (1 - 9e-5, 100, 3e-4, 1.0, 0, 1e-4, True),
        (GAIN, 5, 3e-4, 1.0, 0, 1e-4, True),
        (LOSS, 100, 1e-4, 1.0, 0, 1e-3, False),
        (1.0, 100, 1e-4, 1.0, 0, 1e-3, False),
        (LOSS, 5, 1e-4, 2e-6, 0, 1e-3, False),
        (LOSS, 100, 1e-4, 9e-7, 0, 1e-3, True),
        (LOSS, 100, 2e3, 1.0, 0, 2e4, True),
        (GAIN, 100, 1e-4, 1.0, 1, None, True),
    ],
)
def test_the_rules_of_a_step(cost, used, damping, size, ended, next_damping, done):
    """``used`` is also how many points there are, so none adds to the cost."""
    before, after, sums = torch.zeros(3, ROW, dtype=torch.float64)
    sums[:36:9], sums[64], sums[65] = 7.0, cost, used
    before[:12], before[16:28], before[COUNT.value] = 1.0, 2.0, used
    before[COST.value], before[DAMPING.value], before[SIZE.value], before[DONE.value] = 1.0, damping, size, ended
    there = [t.to(DEVICE) for t in (before, sums, after)]
    step_kernel[(1,)](*there, (0.1,) * 7, 1, rules=RULES, first=False)
    after = there[2].cpu()
    gain = cost < 1 and not ended
    assert (after[:12] == (2 if gain else 1)).all()
    assert after[COST.value] == (cost if gain else 1)
    assert bool(after[DONE.value]) == done
    assert bool(after[EQUATIONS.value]) == gain
    assert next_damping is None or float(after[DAMPING.value]) == pytest.approx(next_damping)


def test_a_full_table_grows_and_loses_nothing_for_long(monkeypatch):
    monkeypatch.setattr(volume_gpu, "SLOTS", 16)
    theirs, mine, grown = FusedVolume(*LENGTHS), GpuVolume(*LENGTHS, DEVICE), []
    add(theirs, corners()[:1], POSES[:1])
    for _ in range(5):
        add(mine, corners()[:1], POSES[:1])
        grown.append((mine.used, mine.blocks.slots))
    assert grown == [(16, 16), (32, 32), (64, 64), (66, 128), (66, 256)]
    (place, voxels), (my_place, my_voxels) = ordered(theirs), ordered(mine)
    np.testing.assert_array_equal(my_place, place)
    np.testing.assert_array_equal(my_voxels[..., 2] > 0, voxels[..., 2] > 0)


def test_growing_changes_nothing(monkeypatch, pair):
    monkeypatch.setattr(volume_gpu, "COPIED", 16)
    mine = GpuVolume(*LENGTHS, DEVICE)
    mine.load(pair[1].state())
    rows = fusion_gpu.taken_slots(mine.blocks)
    mine._load(mine.blocks.keys[rows], mine.blocks.voxels, rows, 2 * mine.blocks.slots)
    for old, new in zip(ordered(pair[1]), ordered(mine), strict=True):
        np.testing.assert_array_equal(old, new)


def test_state_goes_round_through_both(pair):
    theirs, mine = FusedVolume(*LENGTHS), create_volume("gpu", *LENGTHS, DEVICE, Recorder())
    theirs.load(pair[1].state())
    mine.load(pair[0].state())
    add(theirs, corners()[:1], POSES[2:])
    add(mine, corners()[:1], POSES[2:])
    assert_alike(theirs, mine)


def test_nothing_waits_for_the_host(monkeypatch):
    """On the meta device no value can be read at all."""
    launch_nothing(monkeypatch, fusion_gpu)
    blocks, listed = fusion_gpu.allocate(64, *LENGTHS, torch.device("meta"))
    points, start = torch.zeros(64, 4, device="meta"), fusion_gpu.pack_start(torch.eye(4), 50).to("meta")
    depth, color = torch.zeros(36, 48, device="meta"), torch.zeros(36, 48, 3, dtype=torch.uint8, device="meta")
    with Forbidding():
        fusion_gpu.fuse(blocks, listed, depth, color, torch.zeros(26, device="meta"), 4, 3)
        row = fusion_gpu.descend(blocks, points, start, tuple(stages(CONFIG)), 10, 4, RULES)
    assert row.shape == start.shape


TINY = replace(
    CONFIG, feature_count=20, align=replace(CONFIG.align, points=300), tracking=TrackingConfig(iterations=0),
    field=FieldConfig(levels=4, log2_table_size=10, blob_bins=4), sampling=SamplingConfig(uniform=4, near_depth=3),
)  # fmt: skip


def trackers(pair):
    """The camera's follower on the host and that on the device, over the same surface, and a map that knows nothing."""
    observed, table = ObservedVoxels(), ObservedTable(DEVICE)
    for seen in (observed, table):
        seen.add(spread_pixels(corners()[0], CAMERA, 1500, CONFIG, np.random.default_rng(0)).points(), POSES[0])
    field = create_field(TINY.field, np.array([[-2.0, -2, 0], [2, 2, 3]]), 0, torch.device("cpu"))
    host = HostTracker(
        CAMERA, pair[0], observed, reference, np.random.default_rng(0), torch.Generator(), Recorder(plain=True)
    )
    device = GpuTracker(CAMERA, pair[1], table, gpu, torch.Generator(DEVICE), Recorder())
    return (host, field), (device, replace(field, params=moved(field.params, DEVICE)))


def test_a_frame_is_tracked_as_on_the_host(pair):
    seen = look(TRUE, corner(), CAMERA)
    for tracker, field in trackers(pair):
        for _ in range(2):  # the second one is recorded, where that can be
            found = tracker.begin(seen, GUESS, field, TINY).result()
            np.testing.assert_allclose(found.c2w, TRUE, atol=4e-3)
            assert found.fit > 0.95
            assert 0 < found.losses["align_mm"] < 5


@pytest.mark.parametrize("rays", [0, 60])
def test_a_rolling_shutter_is_straightened_as_on_the_host(pair, rays):
    seen = look_row_by_row(TRUE, SWEEP, corner(), CAMERA)
    tracking = TrackingConfig(iterations=min(rays, 2), rays=60, lr_rotation=1e-5, lr_translation=1e-5)
    off = []
    for tracker, field in trackers(pair):
        rolling = replace(tracker, camera=replace(CAMERA, readout_s=0.03))
        found = rolling.begin(seen, GUESS, field, replace(TINY, tracking=tracking), SWEEP).result()
        np.testing.assert_allclose(found.c2w, TRUE, atol=4e-3)
        skewed = rolling.begin(seen, GUESS, field, replace(TINY, tracking=tracking), STILL).result()
        off.append([np.abs(each.c2w - TRUE).max() for each in (found, skewed)])
    assert all(found < 0.5 * skewed for found, skewed in off)


def test_pixels_are_straightened_as_on_the_host():
    seen = look_row_by_row(TRUE, SWEEP, corner(), CAMERA)
    pixels = spread_pixels(seen, CAMERA, 300, CONFIG, np.random.default_rng(0))
    pixels.depth[::4] = 0
    mine = straight_on_device(upload(pixels, DEVICE), CAMERA, torch.tensor(SWEEP, dtype=torch.float32, device=DEVICE))
    theirs = straight_pixels(pixels, CAMERA, SWEEP)
    np.testing.assert_allclose(mine.direction[:, :2].cpu(), theirs.direction, atol=1e-5)
    np.testing.assert_allclose(mine.depth.cpu(), theirs.depth, atol=1e-5)
    assert (mine.direction[:, 2] == 1).all()


def test_a_replay_sees_the_newest_frame(pair):
    graphs, found = FakeGraphs(), []
    for recorder in (Recorder(plain=True), Recorder(capture=graphs.capture)):
        _, (tracker, field) = trackers(pair)
        tracker.recorder = recorder
        for c2w in (TRUE, TRUE, pose((1, 4, -2), (0.03, 0.02, -0.01))):
            track = tracker.begin(look(c2w, corner(), CAMERA), GUESS, field, TINY).result()
            found.append(track.c2w)
    np.testing.assert_allclose(found[3:], found[:3], atol=1e-4)
    assert np.abs(found[2] - found[1]).max() > 0.01
    assert (graphs.recorded, graphs.replayed) == (1, 2)


def test_a_rendered_pose_is_taken_only_where_the_surface_agrees(pair):
    seen = look(TRUE, corner(), CAMERA)
    rendered = replace(TINY, tracking=TrackingConfig(iterations=2, rays=60, lr_rotation=1e-5, lr_translation=1e-5))
    astray = replace(rendered, tracking=replace(rendered.tracking, iterations=5, lr_translation=0.1))
    for tracker, field in trackers(pair):
        for config in (rendered, astray):
            found = tracker.begin(seen, GUESS, field, config).result()
            assert list(found.losses) == list(LOSS_NAMES)
            assert np.isfinite(list(found.losses.values())).all()
            np.testing.assert_allclose(found.c2w, TRUE, atol=4e-3)


def test_a_frame_without_depth_is_not_tracked(pair):
    seen = look(TRUE, corner(), CAMERA)
    blind = replace(seen, depth=np.zeros_like(seen.depth))
    for tracker, field in trackers(pair):
        found = tracker.begin(blind, GUESS, field, TINY).result()
        assert (found.fit, found.losses) == (0.0, {})
        np.testing.assert_array_equal(found.c2w, GUESS)


@pytest.mark.parametrize("fus", [True, False])
def test_tracking_waits_for_nothing(monkeypatch, pair, fus):
    """On the meta device no value can be read at all."""
    for module in (fusion_gpu, gpu, poses_gpu, tracking_gpu):
        launch_nothing(monkeypatch, module)
    meta = torch.device("meta")
    config = replace(TINY, fus=fus, tracking=TrackingConfig(iterations=2, rays=60))
    _, (tracker, field) = trackers(pair)
    tracker = replace(tracker, observed=ObservedTable(meta))
    field = replace(field, params=moved(field.params, meta))
    blocks, _ = fusion_gpu.allocate(64, *LENGTHS, meta)
    shown = DeviceFrame(torch.zeros(36, 48, 3, dtype=torch.uint8, device=meta), torch.zeros(36, 48, device=meta))
    cells, order = grid_cells(shown, config.align.points, config), grid_cells(shown, config.tracking.rays, config)
    rows, order = (
        torch.zeros(16, 2 * cells + 60 * (3 + 7), device=meta),
        torch.zeros(order, dtype=torch.int64, device=meta),
    )
    letter, rates = (
        torch.zeros(*shape, dtype=torch.float64, device=meta) for shape in ((HEAD + (20 if fus else 0),), (1, 6))
    )
    given = field, blocks, config, shown, order, rates, letter, rows
    tracker._whole(*given)  # uploads the layout, once
    with Forbidding():
        (found,) = tracker._whole(*given)
    assert found.shape == (TOLD + len(LOSS_NAMES),)
