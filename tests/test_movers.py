"""What moves by itself is told from the room, and left out."""

from dataclasses import replace

import numpy as np
import pytest
from remembered import remembering

from ecslam.config_files import apply_settings, load_preset
from ecslam.datasets import open_sequence
from ecslam.earlier import EVERY, KEPT, EarlierViews, around, cell_px, relief
from ecslam.evaluation.trajectory import absolute_error
from ecslam.messages import MOVING
from ecslam.movers import compare, grown, large, without_movers
from ecslam.slam import Slam
from ecslam.types import Frame

ROOM = open_sequence("synthetic/studio?size=160x120&frames=300")
LENS = np.array([50.0, 50.0, 31.5, 23.5], np.float32)
HERE = np.eye(4)
WALL = np.full((48, 64), 3, np.float32)


def walked_through(frame: Frame, left: int, width: int = 40, depth_m: float = 0.8) -> Frame:
    """The frame with somebody in front of the room, ``width`` pixels wide, from column ``left`` on."""
    there = np.zeros(frame.depth.shape, bool)
    there[20:, max(left, 0) : max(left + width, 0)] = True
    there &= frame.depth > depth_m
    stripes = 60 + 90 * (np.arange(frame.depth.shape[1])[None, :, None] // 3 % 2)
    return replace(
        frame,
        depth=np.where(there, np.float32(depth_m), frame.depth),
        color=np.where(there[..., None], stripes, frame.color).astype(np.uint8),
    )


def left_of(frame: Frame, c2w: np.ndarray, earlier: EarlierViews, poses: np.ndarray) -> Frame:
    """The frame, seen from about c2w, without what has come."""
    return without_movers(frame, ROOM.intrinsics, c2w, earlier.asked, poses)


def test_a_cell_has_the_nearest_depth_and_none_where_hardly_any_is_measured():
    depth = np.full((480, 640), 2, np.float32)
    assert cell_px(640) == 10
    depth[105, 205], depth[200:210, 300:307], depth[300:310, 400:404] = 1, 0, 0
    cells = relief(depth)
    assert cells.shape == (48, 64)
    assert cells.dtype == np.float32
    assert cells[20, 30] == 0
    assert cells[30, 40] == 2
    assert np.count_nonzero(cells == 2) >= 48 * 64 - 2


def test_depth_that_is_not_finite_is_none():
    depth = np.full((480, 640), 2, np.float32)
    depth[:240], depth[300:310, 400:410] = np.inf, np.nan
    cells = relief(depth)
    assert (cells[:24] == 0).all()
    assert cells[30, 40] == 0
    assert np.isfinite(cells).all()


def test_a_nearer_pixel_that_is_looked_at_counts():
    depth = np.full((480, 640), 2, np.float32)
    depth[100:110, 200:205] = 1
    assert relief(depth)[10, 20] == 1


@pytest.mark.parametrize(
    ("near_m", "came", "settled"), [(2.0, True, False), (2.85, False, True), (3.1, False, True), (4.0, False, False)]
)
def test_what_is_in_front_has_come_and_what_is_where_a_surface_was_is_settled(near_m, came, settled):
    found = compare(np.full_like(WALL, near_m), LENS, HERE, around(WALL)[None], HERE[None])
    assert [mask.any() for mask in found] == [came, settled]
    assert [mask.all() for mask in found] == [came, settled]


def test_a_view_from_elsewhere_is_asked_where_it_saw_the_point():
    aside = np.array(HERE)
    aside[0, 3] = 0.6  # ten columns at three metres
    seen = np.array(WALL)
    seen[:, :20] = 0
    came, settled = compare(WALL, LENS, HERE, around(seen)[None], aside[None])
    assert not came.any()
    assert not settled[:, :30].any()
    assert settled[:, 30:].all()


def test_an_edge_that_moves_by_a_cell_has_not_come():
    pole, moved = np.array(WALL), np.array(WALL)
    pole[:, 30:33], moved[:, 31:34] = 1, 1
    assert not compare(moved, LENS, HERE, around(pole)[None], HERE[None])[0].any()


def test_nothing_is_known_where_nothing_was_measured():
    for near, seen in ((WALL, np.zeros_like(WALL)), (np.zeros_like(WALL), WALL)):
        assert not any(mask.any() for mask in compare(near, LENS, HERE, around(seen)[None], HERE[None]))


def test_small_regions_are_noise():
    mask = np.zeros((48, 64), bool)
    mask[5:8, 5:8] = mask[20:30, 20:30] = True
    assert large(mask).sum() == 100


def test_a_region_grows_as_far_as_its_surface_and_what_is_unknown():
    near, free = np.array(WALL), np.ones((48, 64), bool)
    near[10:40, 10:40] = 1.5
    free[:, 35:] = False
    seeds = np.zeros_like(free)
    seeds[15, 12] = True
    expected = np.zeros_like(free)
    expected[10:40, 10:35] = True
    assert np.array_equal(grown(seeds, near, free), expected)


def test_a_room_at_rest_is_left_as_it_is():
    earlier, poses = remembering([ROOM[i] for i in range(0, 60, 5)])
    for i in range(60, 75, 5):
        frame = ROOM[i]
        assert left_of(frame, ROOM[i - 1].c2w_gt, earlier, poses) is frame


def test_who_walks_through_is_left_out_and_the_rest_is_kept():
    earlier, poses = remembering([ROOM[i] for i in range(0, 30, 5)])
    frame = walked_through(ROOM[30], 50)
    there = frame.depth != ROOM[30].depth
    found = left_of(frame, ROOM[29].c2w_gt, earlier, poses)
    gone = (found.depth == 0) & (frame.depth > 0)
    assert gone[there].mean() > 0.97
    assert gone[~there].mean() < 0.06
    assert np.array_equal(found.depth[~gone], frame.depth[~gone])
    assert np.array_equal(found.color, frame.color)


def test_a_keyframe_made_with_what_moves_is_not_taken():
    earlier, poses = remembering([ROOM[i] for i in range(0, 30, 5)])
    frame = replace(walked_through(ROOM[30], 50), keyframe="made before")
    assert left_of(frame, ROOM[29].c2w_gt, earlier, poses).keyframe is None


def test_a_picture_that_has_changed_all_over_is_seen_from_elsewhere():
    earlier, poses = remembering([ROOM[0]])
    frame = replace(ROOM[1], depth=np.full_like(ROOM[1].depth, 0.5))
    assert left_of(frame, ROOM[1].c2w_gt, earlier, poses) is frame


def test_what_stays_belongs_to_the_room_in_the_end():
    before, with_it = ROOM[0], walked_through(ROOM[0], 50)
    earlier, poses = EarlierViews(), np.tile(before.c2w_gt, (1 + 2 * KEPT, 1, 1))
    earlier.remember(before, 0)
    left_out = []
    for number in range(1, 2 * KEPT):
        found = left_of(with_it, before.c2w_gt, earlier, poses)
        left_out.append(found is not with_it)
        earlier.remember(found, number)
    assert left_out[0]
    assert not any(left_out[KEPT:])
    assert sum(left_out) >= KEPT // EVERY


def test_a_restored_one_goes_on_the_same():
    earlier, poses = remembering([ROOM[i] for i in range(0, 30, 5)])
    other, frame = EarlierViews(), walked_through(ROOM[30], 50)
    other.load(earlier.state())
    one, two = (left_of(frame, ROOM[29].c2w_gt, e, poses).depth for e in (earlier, other))
    assert np.array_equal(one, two)


@pytest.fixture(scope="module")
def runs():
    """Errors in centimetres and notes of runs in which somebody walks through, by whether that is left in."""
    found = {}
    for movers in (False, True):
        settings = ["mapping.first_iterations=50", "mapping.rays=500", f"movers={str(movers).lower()}"]
        engine = Slam(apply_settings(load_preset("live"), settings), ROOM.intrinsics, first_pose=ROOM[0].c2w_gt)
        frames = [walked_through(ROOM[i], 6 * (i - 15) - 40) for i in range(50)]
        reports = [engine.step(frame) for frame in frames]
        error = absolute_error(engine.trajectory.poses(), np.stack([f.c2w_gt for f in frames]), align=False)
        assert error is not None
        found[movers] = error.cm.rmse, [(r.frame, r.note) for r in reports if r.note]
    return found


@pytest.mark.slow
def test_who_walks_through_does_not_take_the_camera_along(runs):
    assert runs[False][0] < 0.5 * runs[True][0]


@pytest.mark.slow
def test_it_is_said_once_that_something_moves(runs):
    frames = [frame for frame, note in runs[False][1] if note == MOVING]
    assert len(frames) in (1, 2)
    assert 9 <= frames[0] <= 18
    assert all(note != MOVING for _, note in runs[True][1])
