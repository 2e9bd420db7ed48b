"""A whole run: what it writes, what it counts, and what it does about bad frames, full disks and failures."""

import errno
import json
import os
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from fake_slam import QUICK, Behaviour, FakeSequence, circle, maker, open_fake
from runtime_watch import running

from ecslam.commands import progress_line
from ecslam.config_files import load_config, load_preset
from ecslam.evaluation.trajectory import absolute_error
from ecslam.evaluation.trajectory_io import format_tum
from ecslam.messages import Notice, Quit, State, Stop
from ecslam.runtime import engine as module
from ecslam.runtime.driven import estimate_mb
from ecslam.runtime.engine import Engine
from ecslam.runtime.files import read_lines
from ecslam.runtime.judge import judge_run
from ecslam.runtime.tally import Tally
from ecslam.types import InputError

SUMMARY_KEYS = """
    sequence preset ended error made_by device kernels seed frames keyframes wall_s setup_s fps_wall fps_engine
    ate_rmse_cm ate_mean_cm ate_max_cm parameters parameters_mb peak_memory_mb skipped_frames lost_frames loop_closures
    dropped_frames kernels_note unreadable_frames frames_without_ground_truth warnings export_s not_saved
"""


def engine(out: Path, sequence=None, behaviour: Behaviour | None = None, **options) -> Engine:
    options = {"make": maker(behaviour), "open_sequence": open_fake} | options
    return Engine(options.pop("config", QUICK), sequence or FakeSequence(), out, **options)


def run(out: Path, sequence=None, behaviour: Behaviour | None = None, **options) -> dict:
    return engine(out, sequence, behaviour, **options).run()


def test_the_run_folder_is_complete(tmp_path):
    config = replace(QUICK, seed=3)
    summary = run(tmp_path / "deep/run", config=config)
    out = tmp_path / "deep/run"
    assert sorted(summary) == sorted(SUMMARY_KEYS.split())
    assert json.loads((out / "summary.json").read_text()) == summary
    assert load_config(out / "config.yaml") == config
    metrics = list(read_lines(out / "metrics.jsonl"))
    assert [m["frame"] for m in metrics] == list(range(30))
    keys = "frame timestamp c2w tracked lost keyframe window window_c2w losses track_ms map_ms ate_cm"
    assert sorted(metrics[0]) == sorted(keys.split())
    assert np.array(metrics[4]["c2w"]).shape == (12,)
    trajectory = np.loadtxt(out / "trajectory.txt")
    assert np.array_equal(trajectory[:, 0], np.arange(30) / 30)
    assert np.allclose(trajectory[:, 1:4], [np.reshape(m["c2w"], (3, 4))[:, 3] for m in metrics], atol=1e-8)
    assert np.allclose(np.loadtxt(out / "groundtruth.txt")[:, 1:4], circle(30)[:, :3, 3], atol=1e-8)
    keyframes = list(read_lines(out / "keyframes.jsonl"))
    assert [k["frame"] for k in keyframes] == [0, 5, 10, 15, 20, 25]
    assert all((out / k["thumbnail"]).stat().st_size > 100 for k in keyframes)
    assert trimesh.load(out / "mesh.ply").bounds.max() == pytest.approx(1, abs=0.02)
    assert 2 <= len(list((out / "meshes").glob("*.ply"))) <= 9
    about = json.loads((out / "run.json").read_text())
    assert (about["sequence"], about["frames_total"], about["fx"]) == ("fake", 30, 60.0)


def test_the_figures_are_what_they_say(tmp_path):
    summary = run(tmp_path, behaviour=Behaviour(lost=(7, 8), loop_at=20))
    assert (summary["ended"], summary["error"]) == ("finished", "")
    assert (summary["frames"], summary["keyframes"], summary["loop_closures"], summary["lost_frames"]) == (30, 6, 1, 2)
    assert summary["fps_engine"] == pytest.approx(1e3 / 5)  # 2 + 3 ms a frame, the first one's 100 ms left out
    assert 30 / summary["fps_wall"] == pytest.approx(summary["wall_s"], abs=1e-3)  # rounded to milliseconds
    estimate = np.loadtxt(tmp_path / "trajectory.txt")[:, 1:4]
    poses = np.tile(np.eye(4), (30, 1, 1))
    poses[:, :3, 3] = estimate
    assert absolute_error(poses, circle(30)).cm.rmse == pytest.approx(summary["ate_rmse_cm"])
    assert summary["ate_mean_cm"] <= summary["ate_rmse_cm"] <= summary["ate_max_cm"]


def test_without_ground_truth_there_is_no_ate(tmp_path):
    summary = run(tmp_path, FakeSequence(12, truth=False))
    assert summary["ate_rmse_cm"] is summary["ate_mean_cm"] is summary["ate_max_cm"] is None
    assert not (tmp_path / "groundtruth.txt").exists()
    assert np.allclose(np.loadtxt(tmp_path / "trajectory.txt")[0, 1:4], 0, atol=0.03)


def test_the_same_run_twice_gives_the_same_bytes(tmp_path):
    run(tmp_path / "a")
    run(tmp_path / "b")
    assert (tmp_path / "a/trajectory.txt").read_bytes() == (tmp_path / "b/trajectory.txt").read_bytes()


def test_unreadable_frames_are_skipped_counted_and_named(tmp_path):
    summary = run(tmp_path, FakeSequence(30, bad=(0, 4, 21)))
    assert (summary["frames"], summary["skipped_frames"]) == (27, 3)
    assert summary["unreadable_frames"][1] == "/data/000004.png: truncated; copy it again"
    assert len((tmp_path / "trajectory.txt").read_text().splitlines()) == 27
    skipped = [e["frame"] for e in read_lines(tmp_path / "events.jsonl") if "skipped" in e["text"]]
    assert skipped == [0, 4, 21]


def test_over_a_fifth_of_unreadable_frames_ends_the_run_and_keeps_what_there_is(tmp_path):
    with pytest.raises(InputError, match=r"fake: at least 3 of 12 frames cannot be read.*000005.png.*ecslam check"):
        run(tmp_path, FakeSequence(12, bad=(5, 7, 8)))
    assert json.loads((tmp_path / "summary.json").read_text())["frames"] == 6
    assert len((tmp_path / "trajectory.txt").read_text().splitlines()) == 6


@pytest.mark.parametrize("bad", [(1, 3, 9), tuple(range(8))])
def test_up_to_a_fifth_of_unreadable_frames_is_no_matter_wherever_they_lie(tmp_path, bad):
    assert run(tmp_path, FakeSequence(40, bad=bad))["skipped_frames"] == len(bad)


def test_the_world_is_that_of_the_first_frame_the_engine_can_use(tmp_path):
    make = maker(Behaviour(empty=(0, 1)))
    summary = run(tmp_path, FakeSequence(12), make=make)
    assert (summary["frames"], summary["skipped_frames"], summary["unreadable_frames"]) == (10, 2, [])
    assert np.array_equal(make.made[-1].first_pose, circle(12)[2])


def test_many_skipped_frames_are_told_a_few_times(tmp_path):
    empty = tuple(range(1, 251))
    assert run(tmp_path, FakeSequence(300), Behaviour(empty=empty))["skipped_frames"] == 250
    told = [e["text"] for e in read_lines(tmp_path / "events.jsonl") if "skipped" in e["text"]]
    assert len(told) == 22
    assert told[19].startswith("skipped: frame 20")
    assert [text.split(",")[0] for text in told[20:]] == [f"skipped: {n} frames so far" for n in (100, 200)]


def test_a_sequence_without_a_usable_frame_is_an_error(tmp_path):
    with pytest.raises(InputError, match=r"fake: none of 4 frames could be used.*frame 0: no usable depth"):
        run(tmp_path, FakeSequence(4), Behaviour(empty=(0, 1, 2, 3)))


def test_a_long_sequence_without_a_usable_frame_is_given_up_early(tmp_path):
    with pytest.raises(InputError, match=r"none of 201 frames could be used.*frame 0: no usable depth"):
        run(tmp_path, FakeSequence(1000), Behaviour(empty=tuple(range(1000))))


class Slow(FakeSequence):
    """Its first frame waits for ``go``."""

    def __init__(self, count: int) -> None:
        super().__init__(count)
        self.go = threading.Event()

    def __getitem__(self, index: int):
        if index == 0:
            self.go.wait(10)
        return super().__getitem__(index)


@pytest.mark.parametrize("patience_s", [0.0, 60.0])
def test_a_first_frame_that_takes_long_is_explained_and_only_that(tmp_path, monkeypatch, patience_s):
    monkeypatch.setattr(module, "PATIENCE_S", patience_s)
    sequence, told = Slow(3), []

    def tell(notice: Notice) -> None:
        told.append(notice.text)
        sequence.go.set()

    if patience_s:
        sequence.go.set()
    engine(tmp_path, sequence).run(tell=tell)
    assert told == ([] if patience_s else [module.PREPARING])


def test_a_first_mapping_that_is_under_way_is_not_explained(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "PATIENCE_S", 0.2)
    told = []
    engine(tmp_path, FakeSequence(2), Behaviour(first_interrupts=10, pause_s=0.05)).run(tell=told.append)
    assert told == []


def test_repeated_and_backward_time_stamps_are_skipped(tmp_path):
    times = np.arange(20) / 10
    times[5], times[9], times[10] = times[4], 0.1, times[8]
    summary = run(tmp_path, FakeSequence(20, times=times))
    assert (summary["frames"], summary["skipped_frames"], summary["unreadable_frames"]) == (17, 3, [])
    written = np.loadtxt(tmp_path / "trajectory.txt")[:, 0]
    assert (np.diff(written) > 0).all()


def test_a_run_that_skipped_repeated_times_is_judged(tmp_path):
    times = np.arange(20) / 10
    times[5] = times[4]
    summary = run(tmp_path, FakeSequence(20, times=times))
    assert len(np.loadtxt(tmp_path / "groundtruth.txt")) == 19
    assert judge_run(tmp_path)["ate_rmse_cm"] == pytest.approx(summary["ate_rmse_cm"])


def test_a_run_stopped_early_is_judged_by_what_it_did(tmp_path):
    with running(tmp_path, paused_at=12) as (handle, watch, _):
        watch.go(Stop(), State.FINISHED)
    assert handle.summary["ended"] == "stopped"
    assert judge_run(tmp_path)["ate_rmse_cm"] == pytest.approx(handle.summary["ate_rmse_cm"])


def test_a_time_stamp_far_in_the_future_costs_that_frame_only(tmp_path):
    times = np.arange(20) / 10
    times[6] += 1e6
    summary = run(tmp_path, FakeSequence(20, times=times))
    assert (summary["frames"], summary["skipped_frames"]) == (19, 1)
    assert np.allclose(np.loadtxt(tmp_path / "trajectory.txt")[:, 0], np.delete(times, 6))


def test_snapshots_keep_a_row_for_each_frame_and_say_lost(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "UNWATCHED_PERIOD_S", 0.0)
    seen = []
    engine(tmp_path, FakeSequence(12, bad=(4,)), Behaviour(lost=(6, 7))).run(seen.append)
    last, states = seen[-1], {m.frame: m.state for m in seen[:-1]}
    assert last.trajectory.shape == (12, 4, 4)
    assert np.array_equal(last.trajectory[4], last.trajectory[3])
    assert (last.skipped, last.lost_frames, last.frames_total) == (1, 2, 12)
    assert states[6] is State.LOST
    assert states[7] is State.RELOCALISING
    assert states[8] is State.TRACKING
    assert states[10] is State.MAPPING
    assert last.state is State.FINISHED
    assert last.fov_y_rad == pytest.approx(2 * np.arctan(24 / 60))  # of 48 rows at 60 pixels
    assert last.aspect == pytest.approx(64 / 48)
    assert [k.frame for k in last.keyframes] == [0, 5, 10]
    assert np.array_equal(last.keyframes[1].c2w, last.trajectory[5])


def test_progress_sees_the_run(tmp_path):
    seen = []
    summary = engine(tmp_path).run(seen.append)
    assert seen[0].state is State.INITIALISING
    assert seen[-1].state is State.FINISHED
    assert seen[-1].ate_cm == summary["ate_rmse_cm"] > summary["ate_mean_cm"]


def test_the_progress_line_names_the_loss_of_mapping_and_the_residual_of_tracking_apart(tmp_path):
    seen = []
    engine(tmp_path, FakeSequence(8)).run(seen.append)
    assert (seen[0].map_loss, seen[-1].map_loss) == (None, 0.5 + 0.25 * QUICK.mapping.iterations)
    assert " loss " not in progress_line(seen[0], 0)
    tracked = replace(seen[-1], state=State.TRACKING, losses={"align_mm": 6.21}, map_loss=1.25, ate_cm=0.5)
    figures = ["tracking 8/8", "loss 1.250", "window 7", "ATE 0.50 cm", "residual 6.2 mm"]
    assert [part for part in progress_line(tracked, 7).split("  ") if "frames/s" not in part] == figures


def test_a_full_disk_does_not_end_the_run(tmp_path, monkeypatch):
    handle = engine(tmp_path)
    notices = handle.subscribe()
    real = os.fsync

    def fsync(descriptor: int) -> None:
        name = os.readlink(f"/proc/self/fd/{descriptor}")
        if name.endswith(".tmp") and "summary" not in name:
            raise OSError(errno.ENOSPC, "No space left on device")
        real(descriptor)

    monkeypatch.setattr(os, "fsync", fsync)
    summary = handle.run()
    assert summary["frames"] == 30
    assert {"mesh.ply", "trajectory.txt", "checkpoints"} <= set(summary["not_saved"])
    assert not list(tmp_path.rglob("*.tmp"))
    said = [m.text for m in iter(lambda: notices.get(0.0), None) if isinstance(m, Notice)]
    assert sum("mesh.ply could not be saved" in text for text in said) == 1
    assert sum("checkpoints could not be saved" in text for text in said) == 1


def test_an_unusable_folder_is_refused_before_the_run(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="holds other files and no run"):
        engine(tmp_path)


def test_a_failure_in_the_engine_proper_is_told_and_keeps_the_poses(tmp_path):
    with running(tmp_path, behaviour=Behaviour(fail_at=8)) as (handle, watch, _):
        assert watch.state(State.FAILED).reason == "the map exploded"
        assert isinstance(handle.error, RuntimeError)
    assert (handle.summary["ended"], handle.summary["error"]) == ("failed", "the map exploded")
    assert len((tmp_path / "trajectory.txt").read_text().splitlines()) == 8
    with pytest.raises(RuntimeError, match="exploded"):
        run(tmp_path, behaviour=Behaviour(fail_at=8))


def test_resume_goes_on_where_the_checkpoint_was(tmp_path):
    whole = run(tmp_path / "whole", behaviour=Behaviour(lost=(3,)))
    with running(tmp_path / "cut", FakeSequence(30), Behaviour(lost=(3,), loop_at=11), paused_at=18) as (_, watch, __):
        (loop,) = watch.state(State.PAUSED).loops
    made, seen = maker(), []
    resumed = Engine.resume(tmp_path / "cut", sequence=FakeSequence(30), make=made).run(seen.append)
    assert np.array_equal(seen[0].loops[0].trajectory_before, loop.trajectory_before)
    assert seen[0].loops[0].error_after_cm == loop.error_after_cm
    assert made.made[0].trajectory.timestamps[17] == pytest.approx(17 / 30)
    same = ("frames", "keyframes", "lost_frames", "ate_rmse_cm", "seed")
    assert {k: resumed[k] for k in same} == {k: whole[k] for k in same}
    for name in ("trajectory.txt", "groundtruth.txt"):
        assert (tmp_path / "cut" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    for name in ("metrics.jsonl", "keyframes.jsonl"):
        frames = [[m["frame"] for m in read_lines(tmp_path / run / name)] for run in ("cut", "whole")]
        assert frames[0] == frames[1]
    with pytest.raises(InputError, match="is finished"):
        Engine.resume(tmp_path / "cut", sequence=FakeSequence(30))
    with pytest.raises(InputError, match="none: no such folder"):
        Engine.resume(tmp_path / "none")


def test_the_row_of_a_skipped_frame_is_the_one_before():
    tally = Tally(position=7, rows=[1, 2, 5], skipped=4)
    assert tally.row_of_each_frame().tolist() == [0, 0, 1, 1, 1, 2, 2]


def test_the_frame_at_work_has_no_pose_to_show():
    tally = Tally(position=4, rows=[0, 2], skipped=1)
    assert tally.row_of_each_frame().tolist() == [0, 0, 1]


def test_what_is_odd_about_a_sequence_is_told_and_kept(tmp_path):
    sequence = FakeSequence(12, times=np.arange(12) / 10 + 5.0 * (np.arange(12) > 7))
    sequence.notes = ("2 images have no partner",)
    sequence.depth_m = 30.0
    told = []
    summary = engine(tmp_path, sequence).run(tell=told.append)
    assert summary["warnings"][:2] == ["2 images have no partner", "1 gaps of more than 1 s between frames"]
    assert summary["warnings"][2] == (
        "frame 0: the median depth is 30 m: probably a wrong depth scale; a tenth of that would be a room's, so export "
        "it in the layout's unit"
    )
    assert len(summary["warnings"]) == 3
    assert next(n.text for n in told if n.level == "warning") == "2 images have no partner"
    logged = [e["text"] for e in read_lines(tmp_path / "events.jsonl")]
    assert "1 gaps of more than 1 s between frames" in logged


def test_depth_that_is_left_out_is_told(tmp_path):
    sequence = FakeSequence(2)
    sequence.depth_m = 5.0
    assert run(tmp_path / "all", sequence)["warnings"] == []
    (warning,) = run(tmp_path / "none", sequence, config=replace(QUICK, depth_far_m=3.0))["warnings"]
    assert warning.startswith("frame 0: 100% of the depth is beyond depth_far_m = 3 ")


def test_being_lost_is_said_once_and_marks_the_poses(tmp_path):
    summary = run(tmp_path, behaviour=Behaviour(lost=tuple(range(6, 16))))
    assert summary["lost_frames"] == 10
    assert summary["warnings"] == ["frame 6: lost"]
    metrics = list(read_lines(tmp_path / "metrics.jsonl"))
    assert [m["frame"] for m in metrics if m["lost"]] == list(range(6, 16))
    assert [m["tracked"] for m in metrics] == [not m["lost"] for m in metrics]


class Blinded(FakeSequence):
    """Frame 6 has no depth."""

    def __getitem__(self, index: int):
        frame = super().__getitem__(index)
        return replace(frame, depth=np.zeros_like(frame.depth)) if index == 6 else frame


def test_a_frame_that_is_missed_for_want_of_depth_says_so(tmp_path):
    summary = run(tmp_path, Blinded(12), Behaviour(lost=(6, 9)))
    assert summary["warnings"] == ["frame 6: lost (0.0% of the image has usable depth)", "frame 9: lost"]


def test_why_no_frame_could_be_used(tmp_path):
    with pytest.raises(
        InputError, match=r"none of 4 frames could be used, the first because: frame 0: no usable depth"
    ):
        run(tmp_path, FakeSequence(4), Behaviour(empty=(0, 1, 2, 3)))


def test_without_a_true_pose_of_the_first_frame_the_surface_is_not_judged(tmp_path):
    sequence = FakeSequence(12, truth=False)
    sequence.poses_gt = lambda: np.where(np.arange(12)[:, None, None] == 0, np.nan, circle(12))
    run(tmp_path, sequence)
    told = []
    assert "ate_rmse_cm" in judge_run(tmp_path, tell=told.append)
    assert "the first frame has no true pose" in told[0]


def late_run(folder, extent_m: float) -> None:
    """A run whose path is 30 ms behind its ground truth."""
    run(folder, FakeSequence(40))
    times, poses = np.arange(90) / 30, np.tile(np.eye(4), (90, 1, 1))
    for name, late_s in (("groundtruth", 0.0), ("trajectory", 0.03)):
        at = times - late_s
        poses[:, :3, 3] = extent_m * np.stack([np.sin(at), np.cos(3 * at), at], 1)
        (folder / f"{name}.txt").write_text(format_tum(times, poses))


def test_a_lag_that_costs_hardly_any_accuracy_is_not_told(tmp_path):
    late_run(tmp_path, 0.02)
    told = []
    assert 0.05 < judge_run(tmp_path, tell=told.append, surface=False)["ate_rmse_cm"] < 0.2
    assert told == []


def test_a_path_behind_the_truth_is_told(tmp_path):
    late_run(tmp_path, 1.0)
    told = []
    figures = judge_run(tmp_path, tell=told.append, surface=False)
    assert figures["ate_rmse_cm"] > 1
    assert "the path is 30 ms behind the ground truth, and without that ate_rmse_cm would be 0.0" in told[0]


@pytest.mark.parametrize("skipped", [(), (0,)])
def test_the_truth_counts_in_the_map_only_with_the_first_true_pose(tmp_path, skipped):
    sequence, snapshots = FakeSequence(12, truth=False), []
    sequence.poses_gt = lambda: np.where(np.arange(12)[:, None, None] == 0, np.nan, circle(12))
    one = engine(tmp_path, sequence, Behaviour(loop_at=7, empty=skipped))
    summary = one.run(snapshots.append)
    (loop,) = snapshots[-1].loops
    assert summary["ate_rmse_cm"] > 0
    assert (snapshots[-1].trajectory_gt is None) == (loop.error_after_cm is None) == (not skipped)
    assert all(s.trajectory_gt is None for s in snapshots if s.frame == 0)


def test_frames_without_a_true_pose_are_left_out_of_the_error_and_counted(tmp_path):
    sequence = FakeSequence(12)
    sequence.poses[[2, 7]] = np.nan
    summary = run(tmp_path / "some", sequence)
    assert summary["frames_without_ground_truth"] == 2
    assert summary["ate_rmse_cm"] < 5
    assert len(np.loadtxt(tmp_path / "some/groundtruth.txt")) == 10
    sequence.poses[:] = np.inf
    summary = run(tmp_path / "none", sequence)
    assert summary["ate_rmse_cm"] is summary["frames_without_ground_truth"] is None
    assert not (tmp_path / "none/groundtruth.txt").exists()


def interrupted(out: Path) -> None:
    with running(out, FakeSequence(30), paused_at=12):
        pass


def test_resume_notes_where_the_sequence_has_moved(tmp_path):
    interrupted(tmp_path)
    moved = FakeSequence(30)
    moved.name = "moved"
    Engine.resume(tmp_path, sequence=moved, make=maker()).run()
    assert json.loads((tmp_path / "run.json").read_text())["sequence"] == "moved"
    assert json.loads((tmp_path / "summary.json").read_text())["frames"] == 30


def test_resume_writes_again_what_has_been_lost(tmp_path):
    interrupted(tmp_path)
    names = ("groundtruth.txt", "config.yaml")
    before = [(tmp_path / name).read_bytes() for name in names]
    (tmp_path / "groundtruth.txt").unlink()
    (tmp_path / "config.yaml").write_text("")
    Engine.resume(tmp_path, sequence=FakeSequence(30), make=maker()).run()
    assert [(tmp_path / name).read_bytes() for name in names] == before


def test_resume_knows_the_error_so_far(tmp_path):
    interrupted(tmp_path)
    seen = []
    Engine.resume(tmp_path, sequence=FakeSequence(30), make=maker()).run(seen.append)
    assert seen[0].ate_cm > 0
    assert all(line["ate_cm"] for line in read_lines(tmp_path / "metrics.jsonl") if line["frame"] >= 12)


def test_resume_drops_the_mesh_and_the_picture_of_the_frames_before(tmp_path):
    interrupted(tmp_path)
    for name in ("mesh.ply", "picture.png"):
        (tmp_path / name).write_text("of 12 frames")
    resumed = Engine.resume(tmp_path, sequence=FakeSequence(30), make=maker())
    resumed.submit(Quit())
    assert resumed.run()["ended"] == "interrupted"
    assert not any((tmp_path / name).exists() for name in ("mesh.ply", "picture.png"))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda s: setattr(s, "intrinsics", replace(s.intrinsics, width=32)), "width was 64 and is 32"),
        (lambda s: setattr(s, "times", s.times + 0.5), "no longer those that this run has done"),
        (lambda s: setattr(s, "times", s.times[:8]), "12 of them; there are 8 now"),
    ],
)
def test_resume_refuses_a_sequence_that_has_changed(tmp_path, change, says):
    interrupted(tmp_path)
    other = FakeSequence(30)
    other.name = "moved"
    change(other)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.*") if path.is_file()}
    with pytest.raises(InputError, match=says) as caught:
        Engine.resume(tmp_path, sequence=other, make=maker())
    assert "\n" not in str(caught.value)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.*") if path.is_file()} == before


def test_a_run_killed_while_the_last_mesh_was_made_is_finished_without_mapping_again(tmp_path):
    whole = run(tmp_path)
    before = (tmp_path / "trajectory.txt").read_bytes()
    (tmp_path / "summary.json").unlink()
    (tmp_path / "mesh.ply").unlink()
    make = maker()
    again = Engine.resume(tmp_path, sequence=FakeSequence(30), make=make).run()
    assert not make.made[0].finished
    assert (tmp_path / "trajectory.txt").read_bytes() == before
    assert (again["frames"], again["ate_rmse_cm"]) == (whole["frames"], whole["ate_rmse_cm"])
    assert (tmp_path / "mesh.ply").stat().st_size > 1000


def test_a_mesh_that_cannot_be_made_is_said(tmp_path, monkeypatch):
    def fail(*args, **options):
        raise MemoryError("too little")

    monkeypatch.setattr("ecslam.runtime.workshop.build_mesh", fail)
    summary = run(tmp_path)
    assert summary["frames"] == 30
    assert f"mesh.ply was not made; make it with: ecslam mesh {tmp_path}" in summary["warnings"]


class OutOfMemoryError(RuntimeError):
    """As torch names it."""


def raising(method: str):
    """A factory of engines proper whose ``method`` finds no memory."""

    def fail(*_):
        raise OutOfMemoryError("CUDA out of memory.\nTried to allocate 20 GiB")

    def make(*args, **options):
        slam = maker()(*args, **options)
        setattr(slam, method, fail)
        return slam

    return make


@pytest.mark.parametrize(("method", "frames"), [("step", 0), ("finish", 30)])
def test_a_gpu_without_memory_is_one_clear_line_and_keeps_what_there_is(tmp_path, method, frames):
    with pytest.raises(
        InputError, match=r"cuda: out of memory; preset lite needs about \d{3,4} MB.*--device cpu"
    ) as told:
        run(tmp_path, make=raising(method), device="cuda")
    assert "\n" not in str(told.value)
    assert json.loads((tmp_path / "summary.json").read_text())["frames"] == frames
    assert len((tmp_path / "trajectory.txt").read_text().splitlines()) == frames
    logged = [e["text"] for e in read_lines(tmp_path / "events.jsonl") if e["level"] == "error"]
    assert logged == [str(told.value)]


def test_a_run_whose_last_mapping_failed_is_resumed(tmp_path):
    with pytest.raises(InputError, match="out of memory"):
        run(tmp_path, make=raising("finish"))
    make = maker()
    assert Engine.resume(tmp_path, sequence=FakeSequence(30), make=make).run()["frames"] == 30
    assert make.made[0].finished


def test_a_map_that_cannot_be_copied_costs_the_mesh_and_no_more(tmp_path, monkeypatch):
    monkeypatch.setattr("ecslam.runtime.workshop.Workshop.keep", lambda *_: None)
    summary = run(tmp_path, make=raising("query"))
    assert summary["frames"] == 30
    assert summary["warnings"] == [f"mesh.ply was not made (CUDA out of memory.); make it with: ecslam mesh {tmp_path}"]


def test_the_estimate_of_memory_grows_with_the_preset():
    live, lite, scannet = (estimate_mb(load_preset(name)) for name in ("live", "lite", "scannet"))
    assert 500 < live < lite < scannet < 5000
