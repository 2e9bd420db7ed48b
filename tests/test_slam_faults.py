"""Faults of camera and world, in a small built-in room: darkness, a kidnapped camera, NaN, a box too small."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ecslam.config import Config
from ecslam.config_files import apply_settings, load_preset
from ecslam.datasets import open_sequence
from ecslam.messages import StepReport
from ecslam.slam import Slam
from ecslam.tracker import HostTracker
from ecslam.types import Frame, FrameError, InputError

ROOM = open_sequence("synthetic/studio?size=160x120")
QUICK = ["mapping.first_iterations=60", "mapping.rays=800", "keyframe_share=0.2"]
NOTICED_WITHIN = 5
FAR = len(ROOM) // 2


def live(*settings: str) -> Config:
    return apply_settings(load_preset("live"), [*QUICK, *settings])


def engine(config: Config | None = None) -> Slam:
    return Slam(config or live(), ROOM.intrinsics, first_pose=ROOM[0].c2w_gt, bounds=ROOM.bounds)


def walk(slam: Slam, places: list[int], change=lambda frame: frame) -> list[StepReport]:
    """Go on along frames of the room's path, whatever their order; each is ``change``d before."""
    reports = []
    for place in places:
        index = len(slam.trajectory)
        reports.append(slam.step(change(replace(ROOM[place], index=index, timestamp=index / 30))))
    return reports


def error_cm(slam: Slam, place: int) -> float:
    """How far the newest pose is from the true one of frame ``place``."""
    return 100 * float(np.linalg.norm(slam.trajectory[-1][:3, 3] - ROOM.poses_gt()[place, :3, 3]))


def dark(frame: Frame) -> Frame:
    return replace(frame, color=np.zeros_like(frame.color))


def blind(frame: Frame) -> Frame:
    return replace(frame, color=np.zeros_like(frame.color), depth=np.zeros_like(frame.depth))


@pytest.mark.slow
def test_lights_off_leaves_the_map_alone_and_on_again_it_goes_on():
    slam = engine()
    walk(slam, list(range(12)))
    before, known = slam.trajectory[-1], len(slam.keyframes)
    off = walk(slam, [11] * 10, blind)
    assert not any(r.tracked for r in off)
    assert [r.lost for r in off].index(True) < NOTICED_WITHIN
    assert not any(r.is_keyframe for r in off if not r.tracked)
    assert len(slam.keyframes) == known
    assert np.allclose(slam.trajectory[-1], before)
    on = walk(slam, list(range(11, 22)))
    assert on[0].note == "relocalised"
    assert all(r.tracked and not r.lost for r in on)
    assert any(r.is_keyframe for r in on)
    assert error_cm(slam, 21) < 3


@pytest.mark.slow
def test_motion_too_fast_for_the_alignment_is_noticed_and_held():
    slam = engine()
    reports = walk(slam, list(range(0, 60, 5)))
    assert all(r.tracked for r in reports)
    assert error_cm(slam, 55) < 3


@pytest.mark.slow
def test_darkness_with_depth_is_tracked_by_geometry():
    slam = engine()
    walk(slam, list(range(12)))
    reports = walk(slam, list(range(12, 22)), dark)
    assert all(r.tracked for r in reports)
    assert error_cm(slam, 21) < 3


@pytest.mark.slow
def test_a_kidnapped_camera_is_noticed_and_found_again():
    slam = engine()
    walk(slam, list(range(16)))
    known = len(slam.keyframes)
    away = walk(slam, list(range(FAR, FAR + 8)))
    assert [r.lost for r in away].index(True) < NOTICED_WITHIN
    assert not any(r.tracked for r in away)
    assert len(slam.keyframes) == known
    back = walk(slam, list(range(10, 22)))
    assert back[0].note == "relocalised"
    assert all(r.tracked and not r.lost for r in back)
    assert error_cm(slam, 21) < 3


@pytest.mark.slow
def test_nan_in_a_tracked_pose_is_not_taken(monkeypatch):
    slam = engine()
    walk(slam, list(range(12)))
    real, calls = HostTracker._track, []

    def track(self, *args):
        found = real(self, *args)
        calls.append(1)
        return replace(found, c2w=np.full((4, 4), np.nan)) if len(calls) == 2 else found

    monkeypatch.setattr(HostTracker, "_track", track)
    reports = walk(slam, list(range(12, 20)))
    assert np.isfinite(slam.trajectory.poses()).all()
    assert reports[1].note == "recovered"
    assert error_cm(slam, 19) < 3


@pytest.mark.slow
def test_the_box_grows_when_the_camera_leaves_it():
    """The box of the first frame is all that is known at the start; the camera then turns to the rest of the room."""
    slam = Slam(live("field.box_margin_m=0.05"), ROOM.intrinsics, first_pose=ROOM[0].c2w_gt)
    walk(slam, [0])
    assert slam.field is not None
    first = slam.field.layout.box.numpy()
    walk(slam, list(range(1, 61)))
    grown = slam.field.layout.box.numpy()
    assert (grown[0] <= first[0]).all()
    assert (grown[1] >= first[1]).all()
    assert np.prod(grown[1] - grown[0]) > 1.1 * np.prod(first[1] - first[0])
    points = slam.surface_points(100_000)()
    assert ((points >= grown[0]) & (points <= grown[1])).all(1).mean() > 0.98
    assert error_cm(slam, 60) < 5


@pytest.mark.slow
def test_a_map_that_began_small_stays_within_its_table():
    """A camera that first sees a metre of the room gets small cells, too many to be dense in the whole of it."""
    middle = ROOM.bounds.mean(0)
    slam = Slam(live(), ROOM.intrinsics, first_pose=ROOM[0].c2w_gt, bounds=np.stack([middle - 0.55, middle + 0.55]))
    reports = walk(slam, list(range(16)))
    assert slam.field is not None
    assert (slam.field.layout.size <= 2**16).all()
    assert all(r.tracked for r in reports)
    assert error_cm(slam, 15) < 3
    sdf, _ = slam.query()
    assert np.median(np.abs(sdf(slam.surface_points(5000)()))) < 0.3


@pytest.mark.slow
@pytest.mark.parametrize("broken", ["table", "w_sdf"])
def test_nan_in_the_map_is_rolled_back(broken, monkeypatch):
    slam = engine()
    walk(slam, list(range(7)))
    assert slam.mapper is not None
    real, calls = slam.mapper.kernels.step, []

    def step(layout, params, *given):
        result = real(layout, params, *given)
        calls.append(1)
        if len(calls) == 3:
            getattr(params, broken).view(-1)[0] = float("nan")
        return result

    monkeypatch.setattr(slam.mapper.kernels, "step", step)
    reports = walk(slam, list(range(7, 16)))
    assert len(calls) > 3
    assert all(np.isfinite(value).all() for value in slam.state().values() if value.dtype.kind == "f")
    assert sum("undone" in r.note for r in reports) == 1
    assert all(r.tracked for r in reports)
    assert error_cm(slam, 15) < 3


@pytest.mark.slow
def test_after_a_gap_of_over_a_second_the_search_is_wider():
    slam = engine()
    walk(slam, list(range(20)))
    report = slam.step(replace(ROOM[23], index=20, timestamp=19 / 30 + 1.2))
    assert report.tracked
    assert error_cm(slam, 23) < 3


@pytest.mark.slow
def test_a_camera_that_comes_back_elsewhere_than_it_was_lost_is_found():
    slam = engine()
    walk(slam, list(range(16)))
    walk(slam, [15] * 5, blind)
    (back,) = walk(slam, [30])  # 29 cm and 18 degrees from the last frame seen
    assert back.note == "relocalised"
    assert error_cm(slam, 30) < 3


@pytest.mark.slow
def test_a_camera_that_comes_back_where_half_of_what_it_sees_is_new_is_recognised():
    slam = engine(live("mapping.iterations=2"))
    walk(slam, list(range(30)))
    walk(slam, [29] * 3, blind)
    (back,) = walk(slam, [64])  # 75 cm from the nearest frame seen
    assert back.note == "relocalised"
    assert error_cm(slam, 64) < 3
    (away,) = walk(slam, [FAR])
    assert not away.tracked


def test_a_fixed_box_that_is_too_small_is_said_with_the_share_of_rays_outside():
    slam = engine(live("mapping.first_iterations=1", "field.box=[2, 0, 0, 4, 6, 3]"))
    reports = walk(slam, list(range(11)))
    notes = [r.note for r in reports if r.note]
    assert len(notes) == 1
    share = float(notes[0].partition("%")[0])
    assert "outside field.box" in notes[0]
    assert 2 < share < 100
    assert slam.field is not None
    assert slam.field.layout.box.numpy().tolist() == [[2, 0, 0], [4, 6, 3]]


@pytest.mark.parametrize("preset", ["live", "lite"])
def test_a_first_frame_with_hardly_any_depth_is_skipped(preset):
    slam = Slam(apply_settings(load_preset(preset), QUICK), ROOM.intrinsics)
    depth = ROOM[0].depth.copy()
    depth[:, 8:] = 0
    with pytest.raises(FrameError, match=r"frame 0: 5.\d% of it has usable depth"):
        slam.step(replace(ROOM[0], depth=depth))
    assert slam.field is None


@pytest.mark.filterwarnings("ignore:invalid value")
def test_depth_that_is_not_finite_or_out_of_range_is_none():
    def spoil(frame: Frame) -> Frame:
        depth = frame.depth.copy()
        for row, value in zip((0, 20, 40, 50, 60), (np.nan, np.inf, 65.535, 0.0, -1.0), strict=True):
            depth[row : row + 10] = value
        return replace(frame, depth=depth)

    slam = engine(live("mapping.first_iterations=5"))
    reports = walk(slam, list(range(7)), spoil)
    assert all(r.tracked for r in reports)
    assert error_cm(slam, 6) < 3
    assert all(np.isfinite(value).all() for value in slam.state().values() if value.dtype.kind == "f")
    points = slam.surface_points(100_000)()
    assert (np.linalg.norm(points - slam.trajectory[-1][:3, 3], axis=1) < 9).all()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda f: replace(f, color=f.color[::2, ::2], depth=f.depth[::2, ::2]), r"color is uint8 \[60, 80, 3\]"),
        (lambda f: replace(f, depth=f.depth[::2, ::2]), r"depth is float32 \[60, 80\]"),
        (lambda f: replace(f, depth=(1000 * f.depth).astype(np.uint16)), r"makes float32 \[120, 160\]"),
        (lambda f: replace(f, color=f.color[..., 0]), r"color is uint8 \[120, 160\], but its camera makes"),
    ],
)
def test_a_frame_of_another_camera_is_refused(change, says):
    with pytest.raises(FrameError, match=says):
        engine().step(change(ROOM[0]))


@pytest.mark.parametrize("pose", [np.full((4, 4), np.nan), 2 * np.eye(4), np.eye(3), np.diag([1.0, 1, -1, 1])])
def test_a_first_pose_that_is_no_rigid_motion_is_refused(pose):
    with pytest.raises(InputError, match="first_pose"):
        Slam(live(), ROOM.intrinsics, first_pose=pose)
