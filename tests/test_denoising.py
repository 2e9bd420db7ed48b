"""Depth is smoothed by as much as it is noisy: once a frame, within surfaces, whoever does it."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from planes import look, pose

from ecslam import denoising
from ecslam.config_files import apply_settings, load_preset
from ecslam.datasets import open_sequence
from ecslam.denoising import MOST, QUIET, denoised, inverse_noise, smoothed
from ecslam.kernels.denoise import OFFSETS, RADIUS
from ecslam.runtime.ahead import preparation
from ecslam.slam import Slam
from ecslam.types import Intrinsics

CAMERA = Intrinsics(320.0, 320.0, 159.5, 119.5, 320, 240)
STEP, SIGMA = 1 / 8 / 43.5, 0.06 / 43.5  # of a Kinect's inverse depth, 1/m
ROOM = open_sequence("synthetic/studio?size=160x120&frames=300&noise=1")
CORRIDOR = open_sequence("synthetic/corridor?size=320x240&frames=640&noise=1")
CAMERAS = {(120, 160): ROOM.intrinsics, (240, 320): CORRIDOR.intrinsics}
SMALL = ["mapping.first_iterations=20", "mapping.rays=500"]


def wall(slant_deg):
    """The exact depth of a wall 2 m away, turned about the vertical."""
    across = np.array([np.sin(np.radians(slant_deg)), 0, np.cos(np.radians(slant_deg))])
    return look(pose(), [(across, 2 * across[2])], CAMERA).depth


def stepped(depth, seed=0):
    """What a Kinect makes of it: noise, and steps of disparity."""
    noise = np.random.default_rng(seed).normal(0, SIGMA, depth.shape)
    return (1 / (STEP * np.rint((1 / depth + noise) / STEP))).astype(np.float32)


def off(depth, truth):
    """Root mean square of the error of inverse depth."""
    return float(np.sqrt(np.mean((1 / depth - 1 / truth) ** 2)))


@pytest.mark.parametrize("slant_deg", [0, 30, -50])
def test_steps_on_a_plane_become_the_plane_again(slant_deg):
    truth = wall(slant_deg)
    noisy = stepped(truth)
    assert off(smoothed(noisy), truth) < off(noisy, truth) / 4


@pytest.mark.parametrize("room", ["studio", "apartment", "corridor"])
def test_exact_depth_keeps_its_bits(room):
    for frame in (0, 100, 200):
        depth = open_sequence(f"synthetic/{room}?frames=300")[frame].depth
        assert smoothed(depth) is depth


@pytest.mark.parametrize("room", ["studio", "apartment", "corridor"])
def test_exact_depth_as_replica_rounds_it_keeps_its_bits(room):
    exact = open_sequence(f"synthetic/{room}?frames=300&size=1200x680")[100].depth
    rounded = np.rint(6553.5 * exact).astype(np.float32) / np.float32(6553.5)
    assert smoothed(rounded) is rounded


@pytest.mark.parametrize("room", ["studio", "apartment", "corridor"])
def test_depth_in_millimetres_changes_by_about_its_rounding(room):
    exact = open_sequence(f"synthetic/{room}?frames=300")[100].depth
    rounded = np.rint(1000 * exact).astype(np.float32) / np.float32(1000)
    found = smoothed(rounded)
    assert np.quantile(np.abs(found - rounded), 0.99) < 2e-3
    assert np.median(np.abs(found - exact)) < np.median(np.abs(rounded - exact)) / 3


@pytest.mark.parametrize("near_m", [0.6, 1.0, 2.0, 4.0])
def test_noise_is_found_whatever_the_distance(near_m):
    depth = stepped(near_m / 2 * wall(40))
    assert 3.5 * inverse_noise(depth) == pytest.approx(MOST, rel=0.4)
    assert inverse_noise((near_m / 2 * wall(40)).astype(np.float32)) < QUIET


def test_an_edge_stays_where_it_is():
    truth = np.where(np.arange(CAMERA.width) < 150, np.float32(2), np.float32(2.5)) * np.ones((CAMERA.height, 1))
    noisy = stepped(truth)
    found = smoothed(noisy)
    assert off(found, truth) < off(noisy, truth) / 3
    assert np.abs(1 / found - 1 / truth).max() < MOST  # of the 0.1 between both


def test_pixels_without_depth_stay_so_and_take_no_part():
    truth = wall(30)
    holes = np.random.default_rng(1).random(truth.shape) < 0.3
    noisy = np.where(holes, np.float32(0), stepped(truth))
    found = smoothed(noisy)
    assert ((found == 0) == holes).all()
    assert off(found[~holes], truth[~holes]) < off(noisy[~holes], truth[~holes]) / 3


def test_a_hole_is_not_taken_for_something_infinitely_far():
    """Half of an inverse depth opposite a hole has it for its mean; rows of a single pixel have no other pairs."""
    depth = stepped(np.full((64, 64), 3.0))
    depth[20:40] = 0
    depth[30, 20:23] = 0, 3, 1.5
    assert (smoothed(depth)[30, 20:23] == depth[30, 20:23]).all()


@pytest.mark.parametrize("shape", [(1, 1), (1, 50), (2, 9), (5, 5), (7, 3), (40, 50)])
@pytest.mark.parametrize("holes", [0.0, 0.5, 1.0])
def test_whatever_the_image_no_pixel_becomes_nonsense(shape, holes):
    rng = np.random.default_rng(2)
    depth = rng.choice(np.array([0.01, 0.5, 0.501, 3, 80], np.float32), shape)
    depth[rng.random(shape) < holes] = 0
    found = smoothed(depth)
    assert np.isfinite(found).all()
    assert ((found > 0) == (depth > 0)).all()


def test_it_is_the_mean_over_the_pairs_that_agree():
    depth = ROOM[0].depth
    height, width = depth.shape
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1 / depth
        room = np.pad(inverse, RADIUS, constant_values=np.inf)
        bends, count = np.zeros_like(depth), np.ones_like(depth)
        for v, u in OFFSETS:
            sides = (room[RADIUS + y :, RADIUS + x :][:height, :width] for y, x in ((v, u), (-v, -u)))
            bend = sum(sides) - 2 * inverse
            agrees = np.abs(bend) < np.float32(min(3.5 * inverse_noise(depth), MOST))
            bends, count = bends + np.where(agrees, bend, 0), count + 2 * agrees
    np.testing.assert_allclose(smoothed(depth), depth / (1 + depth * (bends / count)), rtol=1e-6)


def test_threads_and_the_way_an_image_lies_in_memory_change_nothing():
    frames = [ROOM[i].depth for i in range(8)]
    alone = [smoothed(depth) for depth in frames]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(smoothed, frames))
    turned = [smoothed(np.asfortranarray(depth)) for depth in frames]
    for one, other, third in zip(alone, together, turned, strict=True):
        assert np.array_equal(one, other)
        assert np.array_equal(one, third)


def test_a_frame_is_smoothed_once_and_the_setting_takes_it_back(monkeypatch):
    config, frame = load_preset("live"), ROOM[0]
    once = denoised(frame, config)
    assert np.array_equal(once.depth, smoothed(frame.depth))
    assert not np.array_equal(once.depth, frame.depth)
    monkeypatch.setattr(denoising, "smoothed", lambda _: pytest.fail("smoothed again"))
    assert denoised(once, config) is once
    without = apply_settings(config, ["denoise=false"])
    assert denoised(frame, without) is frame
    back = denoised(once, without)
    assert back.depth is frame.depth
    assert back.measured is None


def run(frames, settings=(), prepare=False, later=()):
    """Poses [n, 4, 4] of an engine that is given ``frames``, prepared by ``settings``, the second half with ``later``
    beside these."""
    camera = CAMERAS[frames[0].depth.shape]
    config = apply_settings(load_preset("live"), [*SMALL, *settings])
    ready = preparation(lambda: config, camera, "cpu") if prepare else (lambda frame: frame)
    engine = Slam(config, camera, first_pose=frames[0].c2w_gt)
    for i, frame in enumerate(frames):
        if i == len(frames) // 2:
            engine.configure(apply_settings(config, list(later)))
        engine.step(ready(frame))
    return engine.trajectory.poses()


@pytest.fixture(scope="module")
def few():
    return [ROOM[i] for i in range(12)]


@pytest.fixture(scope="module")
def expected(few):
    return run(few)


def test_frames_give_the_same_poses_whoever_smoothed_them(few, expected):
    assert np.array_equal(run(few, prepare=True), expected)


def test_a_setting_changed_on_the_way_counts_for_frames_that_were_read_before(few, expected):
    prepared, unprepared = (run(few, prepare=prepare, later=["denoise=false"]) for prepare in (True, False))
    assert np.array_equal(prepared, unprepared)
    assert not np.array_equal(prepared, expected)


def test_all_that_the_engine_does_sees_smoothed_depth(few, expected):
    by_hand = [replace(frame, depth=smoothed(frame.depth)) for frame in few]
    assert np.array_equal(run(by_hand, ["denoise=false"]), expected)
    assert not np.array_equal(run(few, ["denoise=false"]), expected)


def test_a_noisy_sequence_is_tracked_several_times_better():
    frames = [CORRIDOR[i] for i in range(16)]
    truth = np.stack([frame.c2w_gt[:3, 3] for frame in frames])
    with_it, without = (
        np.linalg.norm(run(frames, [f"denoise={said}"])[:, :3, 3] - truth, axis=1).mean() for said in ("true", "false")
    )
    assert with_it < without / 3
