"""Exposure and white balance are followed: colours stay those of the first frame."""

from dataclasses import replace

import numpy as np
import pytest

from ecslam.config_files import apply_settings, load_preset
from ecslam.datasets import open_sequence
from ecslam.datasets.synthetic.exposing import exposed as automatic
from ecslam.earlier import BRIGHT, DARK, EarlierViews, tint
from ecslam.evaluation.trajectory import absolute_error
from ecslam.exposure import AS_AT_FIRST, exposed, gains
from ecslam.keyframes import make_keyframe, prepared
from ecslam.slam import Slam
from ecslam.types import Frame, Intrinsics

ROOM = open_sequence("synthetic/studio?size=320x240&frames=300")
LIVE = load_preset("live")


def lit(frame: Frame, *factors: float) -> Frame:
    """The frame as a camera would take it that exposes it for so much longer."""
    return replace(frame, color=np.rint(np.minimum(frame.color * np.array(factors), 255)).astype(np.uint8))


def remembering(frames: list[Frame]) -> tuple[EarlierViews, np.ndarray]:
    """What is remembered of these frames as keyframes, and the poses of these."""
    earlier = EarlierViews()
    for number, frame in enumerate(frames):
        earlier.remember(frame, number)
    return earlier, np.stack([frame.c2w_gt for frame in frames])


EARLIER, POSES = remembering([ROOM[i] for i in range(0, 30, 5)])


def found_for(frame: Frame, c2w: np.ndarray, before: np.ndarray = AS_AT_FIRST) -> np.ndarray:
    """Gains of a frame that is expected at ``c2w``."""
    return gains(frame, ROOM.intrinsics, c2w, EARLIER.asked, POSES, before)


def test_a_tint_is_the_mean_colour_of_a_cell():
    color = np.full((480, 640, 3), 100, np.uint8)
    color[100:110, 200:205, 1] = 140
    color[200:210, 300:310] = BRIGHT + 5
    color[300:310, 400:410, 2] = DARK - 5
    cells = tint(color)
    assert cells.shape == (48, 64, 3)
    assert np.exp(cells[10, 20]) == pytest.approx([100, 120, 100])
    assert np.isnan(cells[20, 30]).all()
    assert np.isnan(cells[30, 40]).all()
    assert np.isfinite(cells).all(2).sum() == 48 * 64 - 2


@pytest.mark.parametrize("factors", [(0.5, 0.5, 0.5), (1.2, 1.2, 1.2), (0.7, 0.8, 1.1)])
def test_a_change_of_exposure_and_of_white_balance_is_found(factors):
    frame = lit(ROOM[31], *factors)
    assert found_for(frame, ROOM[29].c2w_gt) == pytest.approx(1 / np.array(factors), rel=0.015)


def test_what_does_not_change_is_left_as_it_is():
    assert found_for(ROOM[31], ROOM[29].c2w_gt) is AS_AT_FIRST
    frame = ROOM[31]
    assert exposed(frame, AS_AT_FIRST) is frame


def test_gains_stay_where_too_little_is_seen_again():
    before, elsewhere = np.full(3, 1.25, np.float32), np.array(ROOM[0].c2w_gt)
    elsewhere[:3, 3] += 20
    black = replace(ROOM[31], color=np.zeros_like(ROOM[31].color))
    for frame, c2w in ((ROOM[31], elsewhere), (black, ROOM[29].c2w_gt)):
        assert found_for(frame, c2w, before) is before
    assert gains(ROOM[31], ROOM.intrinsics, ROOM[29].c2w_gt, EarlierViews().asked, POSES, before) is before


def test_a_frame_and_the_keyframe_made_of_it_get_the_colours_of_the_first():
    frame = prepared(lit(ROOM[31], 0.6, 0.7, 0.8), ROOM.intrinsics, LIVE)
    found = exposed(frame, 1 / np.array([0.6, 0.7, 0.8], np.float32))
    there = ROOM[31].color < 200
    assert np.abs(found.color.astype(int) - ROOM[31].color)[there].max() <= 1
    assert np.nanmean(np.abs(found.tint - tint(found.color))) < 0.01
    anew = make_keyframe(replace(found, keyframe=None, corners=None), ROOM.intrinsics, LIVE)
    kept = make_keyframe(found, ROOM.intrinsics, LIVE)
    same = {tuple(d) for d in anew.pixels.direction} & {tuple(d) for d in kept.pixels.direction}
    assert len(same) > 0.9 * len(kept)
    old = make_keyframe(frame, ROOM.intrinsics, LIVE)
    assert np.array_equal(kept.pixels.depth, old.pixels.depth)
    assert np.array_equal(kept.landmarks.descriptors, old.landmarks.descriptors)
    assert kept.pixels.color.mean(0) == pytest.approx(old.pixels.color.mean(0) / (0.6, 0.7, 0.8), rel=0.02)


def test_gains_do_not_wander_through_what_they_made_themselves():
    earlier, found, off = EarlierViews(), AS_AT_FIRST, []
    poses = np.stack([ROOM[i].c2w_gt for i in range(0, 150, 5)])
    for i in range(150):
        factor = 1 + 0.4 * np.sin(i / 8)
        frame = lit(ROOM[i], *[factor] * 3)
        found = gains(frame, ROOM.intrinsics, ROOM[max(i - 1, 0)].c2w_gt, earlier.asked, poses, found)
        off.append(np.log(found * factor))
        if i % 5 == 0:
            earlier.remember(exposed(frame, found), i // 5)
    assert np.abs(off).max() < 0.06


def test_a_room_can_be_seen_by_a_camera_that_exposes_by_itself():
    plain, itself = (open_sequence(f"synthetic/apartment?size=64x48&exposure={on}") for on in (0, 1))
    for i in (0, 500, 900):
        assert np.array_equal(plain[i].depth, itself[i].depth)
        assert np.array_equal(automatic(plain[i].color), itself[i].color)
    means = np.array([[s[i].color.mean() for i in range(0, 1600, 100)] for s in (plain, itself)])
    assert means[1].std() < 0.5 * means[0].std()


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


def test_luminance_tells_where_the_camera_is_whatever_its_exposure(fading):
    followed, left, steady = (
        run(exposure, frames)[0]
        for exposure, frames in ((True, fading), (False, fading), (True, [before_a_wall(i, 1.2) for i in range(60)]))
    )
    assert followed < 0.5 * left
    assert followed < steady + 0.3


def test_keyframes_are_stored_with_the_colours_of_the_first(fading):
    _, engine = run(True, fading)
    stored = engine.keyframes[-1].pixels.color.mean()
    assert stored == pytest.approx(before_a_wall(55, 1.2).color.mean(), rel=0.05)


def test_an_interrupted_run_goes_on_with_the_same_gains(fading):
    _, engine = run(True, fading[:30])
    other = Slam.restore(engine.config, WALL, engine.state())
    for frame in fading[30:36]:
        for each in (engine, other):
            each.step(frame)
    assert np.array_equal(engine.trajectory.poses(), other.trajectory.poses())
    assert engine.state()["gains"].max() > 1.1
