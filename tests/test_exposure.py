"""A change of exposure is followed: luminance stays that of the first frame."""

from dataclasses import replace

import numpy as np
import pytest
from remembered import remembering

from ecslam.align import known_points
from ecslam.config_files import apply_settings, load_preset
from ecslam.datasets import open_sequence
from ecslam.earlier import BRIGHT, DARK, EarlierViews, light
from ecslam.evaluation.trajectory import absolute_error
from ecslam.exposure import as_at_first
from ecslam.pixels import spread_pixels
from ecslam.slam import Slam
from ecslam.types import Frame, Intrinsics
from ecslam.volume import FusedVolume

ROOM = open_sequence("synthetic/studio?size=320x240&frames=300")
LIVE = load_preset("live")


def lit(frame: Frame, *factors: float) -> Frame:
    """The frame as a camera would take it that exposes it for so much longer."""
    return replace(frame, color=np.rint(np.minimum(frame.color * np.array(factors), 255)).astype(np.uint8))


EARLIER, POSES = remembering([ROOM[i] for i in range(0, 30, 5)])


def gain_of(frame: Frame, c2w: np.ndarray, before: float = 1.0) -> float:
    """The gain of a frame that is expected at ``c2w``."""
    return as_at_first(frame, ROOM.intrinsics, c2w, EARLIER.asked, POSES, before).gain


def test_the_light_of_a_cell_is_its_mean_luminance():
    color = np.full((480, 640, 3), 100, np.uint8)
    color[100:110, 200:205] = 140
    color[200:210, 300:310] = BRIGHT + 5
    color[300:310, 400:410] = DARK - 5
    cells = light(color)
    assert cells.shape == (48, 64)
    assert np.exp(cells[10, 20]) == pytest.approx(120)
    assert cells[20, 30] == cells[30, 40] == 0
    assert np.count_nonzero(cells) == 48 * 64 - 2


@pytest.mark.parametrize("factors", [(0.5, 0.5, 0.5), (1.2, 1.2, 1.2), (0.75, 0.8, 0.85)])
def test_a_change_of_exposure_is_found(factors):
    assert gain_of(lit(ROOM[31], *factors), ROOM[29].c2w_gt) == pytest.approx(1 / factors[1], rel=0.015)


def test_what_hardly_changes_is_left_alone():
    assert gain_of(ROOM[31], ROOM[29].c2w_gt) == 1
    assert gain_of(ROOM[31], ROOM[29].c2w_gt, 1.003) == 1.003
    assert gain_of(ROOM[31], ROOM[29].c2w_gt, 1.1) == pytest.approx(1, abs=0.01)


def test_gains_stay_where_too_little_is_seen_again():
    elsewhere = np.array(ROOM[0].c2w_gt)
    elsewhere[:3, 3] += 20
    black = replace(ROOM[31], color=np.zeros_like(ROOM[31].color))
    for frame, c2w in ((ROOM[31], elsewhere), (black, ROOM[29].c2w_gt)):
        assert gain_of(frame, c2w, 1.25) == 1.25
    assert as_at_first(ROOM[31], ROOM.intrinsics, POSES[0], EarlierViews().asked, POSES, 1.25).gain == 1.25


@pytest.mark.slow
def test_gains_do_not_wander_through_what_they_made_themselves():
    earlier, gain, off = EarlierViews(), 1.0, []
    poses = np.stack([ROOM[i].c2w_gt for i in range(0, 150, 5)])
    for i in range(150):
        factor = 1 + 0.4 * np.sin(i / 8)
        frame = lit(ROOM[i], *[factor] * 3)
        frame = as_at_first(frame, ROOM.intrinsics, ROOM[max(i - 1, 0)].c2w_gt, earlier.asked, poses, gain)
        gain = frame.gain
        off.append(np.log(gain * factor))
        if i % 5 == 0:
            earlier.remember(frame, i // 5)
    assert np.abs(off).max() < 0.06


def test_points_and_volume_are_as_bright_as_at_first():
    dark, volume = replace(lit(ROOM[0], 0.5, 0.5, 0.5), gain=2.0), [FusedVolume(0.03, 0.08) for _ in range(2)]
    for each, frame in zip(volume, (ROOM[0], dark), strict=True):
        each.integrate(frame, ROOM.intrinsics, np.eye(4), 0.1, 8.0)
    plain, brightened = (each.state()["voxels"].astype(int) for each in volume)
    assert np.array_equal(plain[..., 2], brightened[..., 2])
    assert np.abs(plain - brightened)[..., 1].max() < 0.01 * 32000
    pixels = [spread_pixels(f, ROOM.intrinsics, 500, LIVE, np.random.default_rng(0)) for f in (ROOM[0], dark)]
    one, other = (known_points(volume[0], p, np.eye(4), g).light for p, g in zip(pixels, (1, 2), strict=True))
    assert other.numpy() == pytest.approx(one.numpy(), abs=0.01)
    assert known_points(volume[0], pixels[0], np.eye(4), 9.0).light.max() == 1


def test_the_brightness_of_a_room_can_swing():
    plain, swinging = (open_sequence(f"synthetic/studio?size=64x48&exposure={share}") for share in (0, 0.4))
    assert np.array_equal(plain[0].color, swinging[0].color)
    for i, factor in ((12, 1.4), (37, 0.6)):
        assert np.array_equal(plain[i].depth, swinging[i].depth)
        there = plain[i].color < 150
        assert np.abs(swinging[i].color - factor * plain[i].color)[there].max() < 2


WALL = Intrinsics(130.0, 130.0, 79.5, 59.5, 160, 120)


def before_a_wall(index: int, brightness: float) -> Frame:
    """What a camera sees that goes along a plain wall, two metres away; shapes do not tell how far it has come."""
    c2w = np.eye(4)
    c2w[:3, 3] = 0.01 * index, 0.03 * np.sin(index / 9), 0
    v, u = np.indices((WALL.height, WALL.width))
    x, y = 2 * (u - WALL.cx) / WALL.fx + c2w[0, 3], 2 * (v - WALL.cy) / WALL.fy + c2w[1, 3]
    pattern = 95 + 35 * np.sin(9 * x + 2 * y) + 30 * np.sin(5 * y - 3 * x) + 20 * np.cos(17 * x)
    color = np.repeat(np.rint(np.clip(brightness * pattern, 0, 255)).astype(np.uint8)[..., None], 3, 2)
    return Frame(index, index / 30, color, np.full(color.shape[:2], 2, np.float32), c2w)


def run(exposure: bool, frames: list[Frame]) -> tuple[float, Slam]:
    """ATE RMSE in centimetres of a run along the wall."""
    settings = ["mapping.first_iterations=30", "mapping.rays=300", f"exposure={str(exposure).lower()}"]
    engine = Slam(apply_settings(LIVE, settings), WALL, first_pose=frames[0].c2w_gt)
    for frame in frames:
        engine.step(frame)
    error = absolute_error(engine.trajectory.poses(), np.stack([f.c2w_gt for f in frames]), align=False)
    assert error is not None
    return error.cm.rmse, engine


@pytest.fixture(scope="module")
def fading() -> list[Frame]:
    """A walk along the wall with a camera that darkens."""
    return [before_a_wall(i, 1.2 - 0.012 * i) for i in range(60)]


@pytest.mark.slow
def test_luminance_tells_where_the_camera_is_whatever_its_exposure(fading):
    followed, left, steady = (
        run(exposure, frames)[0]
        for exposure, frames in ((True, fading), (False, fading), (True, [before_a_wall(i, 1.2) for i in range(60)]))
    )
    assert followed < 0.5 * left
    assert followed < steady + 0.3


def test_the_map_keeps_the_colours_that_the_camera_saw(fading):
    stored = run(True, fading)[1].keyframes[-1].pixels.color.mean()
    assert stored == pytest.approx(fading[55].color.mean(), rel=0.05)


def test_an_interrupted_run_goes_on_with_the_same_gains(fading):
    _, engine = run(True, fading[:30])
    other = Slam.restore(engine.config, WALL, engine.state())
    for frame in fading[30:36]:
        for each in (engine, other):
            each.step(frame)
    assert np.array_equal(engine.trajectory.poses(), other.trajectory.poses())
    assert engine.state()["gain"] > 1.1
