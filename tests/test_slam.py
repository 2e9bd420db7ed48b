"""The engine as a whole, on a few small frames of a built-in room."""

from dataclasses import replace

import numpy as np
import pytest

from ecslam import tracker
from ecslam.config_files import apply_settings, load_preset
from ecslam.datasets import open_sequence
from ecslam.slam import Slam
from ecslam.types import InputError

SMALL = ["mapping.first_iterations=20", "mapping.rays=500", "tracking.rays=300"]


def test_restored_engine_goes_on_bit_for_bit():
    room = open_sequence("synthetic/studio?size=160x120&frames=14")
    config = apply_settings(load_preset("lite"), SMALL)
    one = Slam(config, room.intrinsics, first_pose=room[0].c2w_gt, bounds=room.bounds)
    for i in range(11):
        one.step(room[i])
    two = Slam.restore(config, room.intrinsics, one.state())
    for i in range(11, 14):
        one.step(room[i])
        two.step(room[i])
    assert np.array_equal(one.trajectory.poses(), two.trajectory.poses())


@pytest.mark.parametrize("to", ["fused", "none"])
def test_a_rendered_pose_that_the_volume_contradicts_is_not_taken(monkeypatch, to):
    room = open_sequence("synthetic/studio?size=160x120&frames=600")
    config = apply_settings(load_preset("lite"), [*SMALL, f"align.to={to}"])
    engine = Slam(config, room.intrinsics, first_pose=room[0].c2w_gt, bounds=room.bounds)
    engine.step(room[0])
    wrong = np.array(room[1].c2w_gt)
    wrong[:3, 3] += 0.01
    monkeypatch.setattr(tracker, "track_adam", lambda *_: (wrong, {}))
    engine.step(room[1])
    off = np.linalg.norm(engine.trajectory[1][:3, 3] - room[1].c2w_gt[:3, 3])
    assert off < 0.005 if to == "fused" else off == pytest.approx(0.01 * 3**0.5)


@pytest.mark.parametrize(("share", "taken"), [(0.95, False), (0.85, True)])
def test_a_rendered_pose_must_fit_the_volume_clearly_better(monkeypatch, share, taken):
    room = open_sequence("synthetic/studio?size=160x120&frames=600")
    engine = Slam(apply_settings(load_preset("lite"), SMALL), room.intrinsics, first_pose=room[0].c2w_gt)
    engine.step(room[0])
    other = np.array(room[1].c2w_gt)
    other[:3, 3] += 0.001
    costs = iter([1.0, share])
    monkeypatch.setattr(tracker, "cost_at", lambda *_: next(costs))
    monkeypatch.setattr(tracker, "track_adam", lambda *_: (other, {}))
    engine.step(room[1])
    assert np.allclose(engine.trajectory[1], other) == taken


def test_something_must_track():
    room = open_sequence("synthetic/studio?size=160x120&frames=14")
    engine = Slam(apply_settings(load_preset("lite"), ["align.to=none"]), room.intrinsics)
    with pytest.raises(InputError, match="nothing tracks"):
        engine.configure(load_preset("live"))


def test_a_picture_needs_no_uniform_samples():
    room = open_sequence("synthetic/studio?size=160x120&frames=14")
    config = apply_settings(load_preset("live"), [*SMALL, "sampling.uniform=0"])
    engine = Slam(config, room.intrinsics, first_pose=room[0].c2w_gt, bounds=room.bounds)
    engine.step(room[0])
    holes = np.where(np.arange(120)[:, None] < 60, room[0].depth, np.float32(0))
    color, depth = engine.render(engine.trajectory[-1], holes)
    assert color.shape == (120, 160, 3)
    assert np.median(np.abs(depth - room[0].depth)[:60]) < 0.2


def test_a_mapping_beside_tracking_is_reported_where_it_is_applied():
    room = open_sequence("synthetic/studio?size=160x120&frames=300")
    engine = Slam(
        apply_settings(load_preset("live"), [*SMALL, "schedule=overlap"]), room.intrinsics, first_pose=room[0].c2w_gt
    )
    reports = [engine.step(room[i]) for i in range(11)]
    mapped = [r for r in reports if r.window]
    assert [r.window for r in mapped] == [(0,), (0, 5)]
    assert 5 < mapped[1].frame <= 10
    assert all("colour" in r.losses and r.map_ms > 0 for r in mapped)
    assert all(r.losses.keys() == {"align_mm"} for r in reports if not r.window)


@pytest.mark.parametrize(("every", "mapped"), [(1, [0, 5, 10, 15, 20]), (7, [0, 10, 15]), (10, [0, 10, 20])])
def test_a_mapping_begins_at_the_first_keyframe_when_it_is_due(every, mapped):
    room = open_sequence("synthetic/studio?size=160x120&frames=300")
    settings = [*SMALL, "mapping.iterations=1", f"mapping.every={every}"]
    engine = Slam(apply_settings(load_preset("live"), settings), room.intrinsics, first_pose=room[0].c2w_gt)
    reports = [engine.step(room[i]) for i in range(21)]
    assert [r.frame for r in reports if r.window] == mapped


def test_a_mapping_whose_keyframe_was_missed_begins_with_the_next():
    room = open_sequence("synthetic/studio?size=160x120&frames=300")
    settings = [*SMALL, "mapping.iterations=1", "mapping.every=10"]
    engine = Slam(apply_settings(load_preset("live"), settings), room.intrinsics, first_pose=room[0].c2w_gt)
    frames = [room[i] for i in range(21)]
    frames[10] = replace(frames[10], depth=np.zeros_like(frames[10].depth))
    reports = [engine.step(frame) for frame in frames]
    assert [r.frame for r in reports if r.is_keyframe] == [0, 5, 15, 20]
    assert [r.frame for r in reports if r.window] == [0, 15]


def off_surface(engine):
    """Median distance (metres) that the map gives at measured surface points."""
    points = engine.surface_points(5000)()
    return float(np.median(np.abs(engine.query()[0](points))) * engine.config.truncation_m)


@pytest.mark.slow
def test_the_last_iterations_bring_the_map_to_the_surface_and_move_no_pose():
    room = open_sequence("synthetic/studio?size=160x120&frames=11")
    found = {}
    for iterations in (0, 200):
        config = apply_settings(load_preset("live"), [*SMALL, f"mapping.final_iterations={iterations}"])
        engine = Slam(config, room.intrinsics, first_pose=room[0].c2w_gt, bounds=room.bounds)
        for frame in room:
            engine.step(frame)
        engine.finish()
        found[iterations] = engine
    assert np.array_equal(found[0].trajectory.poses(), found[200].trajectory.poses())
    assert off_surface(found[200]) < 0.8 * off_surface(found[0])


def test_leaving_early_loses_no_pose():
    room = open_sequence("synthetic/studio?size=160x120&frames=6")
    config = apply_settings(load_preset("live"), SMALL)
    engine = Slam(config, room.intrinsics, first_pose=room[0].c2w_gt, bounds=room.bounds)
    for frame in room:
        engine.step(frame)
    before = engine.trajectory.poses()

    def leave():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        engine.finish(leave)
    assert np.array_equal(before, engine.trajectory.poses())
