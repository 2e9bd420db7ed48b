"""Finished runs: reading folders, scrubbing, exporting, comparing, and the formats that leave the dashboard."""

from __future__ import annotations

import io
import json
import os
import shutil
import struct
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from ecslam_app import server, theme
from ecslam_app.geometry import best_side, frustum_lines, overview, rotation_difference_deg, rotation_to, up_direction
from ecslam_app.glb import simplify, to_glb
from ecslam_app.history import History, discrepancy, history_of
from ecslam_app.panels.compare import figures_table
from ecslam_app.past import Past
from ecslam_app.record import html_replay
from ecslam_app.replay import ReplayEngine
from ecslam_app.runs import load_run

from ecslam import messages as m
from ecslam.runtime import engine as live
from ecslam.runtime.exports import zip_run
from ecslam.runtime.protocol import EngineHandle
from ecslam.runtime.runfolder import frame_rows
from ecslam.types import InputError, Mesh
from tests.fake_engine import FakeEngine, room_mesh, walk, write_run
from tests.fake_slam import QUICK, Behaviour, FakeSequence, maker
from tests.test_app_security import until

FRAMES = 40


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_run(tmp_path_factory.mktemp("runs") / "lite", FRAMES)


@pytest.fixture
def replay(folder):
    engine = ReplayEngine(load_run(folder))
    yield engine
    engine.close()


def events(engine, kind, command):
    feed = engine.subscribe()
    number = engine.submit(command)
    found, answered = None, None
    while answered is None:
        thing = feed.get(5)
        assert thing is not None, f"no answer to {command}"
        found = thing if isinstance(thing, kind) else found
        answered = thing if isinstance(thing, m.Ack) and thing.command_id == number else None
    feed.close()
    return found, answered


def test_replay_is_an_engine(replay, tmp_path):
    assert isinstance(replay, EngineHandle)
    assert isinstance(FakeEngine(tmp_path), EngineHandle)


def test_run_is_read_whole(folder):
    run = load_run(folder)
    assert len(run.rows) == len(run.trajectory) == FRAMES
    assert np.allclose(run.trajectory_gt, walk(FRAMES), atol=1e-6)
    assert [e.frame for e in run.loops] == [int(0.9 * FRAMES)]
    assert [k.frame for k in run.keyframes] == list(range(0, FRAMES, 5))


@pytest.mark.parametrize("frame", [0, 7, FRAMES - 1, 10_000, -3])
def test_scrubbing_shows_what_was_there_at_that_frame(replay, frame):
    _, ack = events(replay, m.Snapshot, m.RunTo(frame))
    s, at = replay.latest(), min(max(frame, 0), FRAMES - 1)
    assert ack.error == ""
    assert (s.frame, len(s.trajectory)) == (at, at + 1)
    assert all(k.frame <= at for k in s.keyframes)
    assert all(e.frame <= at for e in s.loops)
    assert set(s.window) <= {k.frame for k in s.keyframes}


def test_the_error_at_the_end_is_the_one_of_the_summary(replay):
    assert replay.latest().ate_cm == replay.run.summary["ate_rmse_cm"]
    events(replay, m.Snapshot, m.RunTo(FRAMES - 2))
    assert replay.latest().ate_cm == replay.run.rows[FRAMES - 2]["ate_cm"]


def test_a_run_with_skipped_frames_is_shown_by_frame_number(folder, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(folder, run)
    lines = (folder / "metrics.jsonl").read_text().splitlines(keepends=True)
    (run / "metrics.jsonl").write_text("".join(lines[:11] + lines[14:]))  # without the frames 11, 12 and 13
    whole, engine = load_run(folder), ReplayEngine(load_run(run))
    try:
        assert engine.latest().frame == FRAMES - 1
        assert engine.latest().frames_total == FRAMES
        for frame, seen in ((12, 10), (14, 14), (36, 36)):
            events(engine, m.Snapshot, m.RunTo(frame))
            s = engine.latest()
            assert (s.frame, len(s.trajectory)) == (frame, frame + 1)
            assert np.allclose(s.trajectory[-1], whole.trajectory[seen])
            assert np.allclose(s.trajectory_gt[frame], whole.trajectory_gt[seen])
            assert [k.frame for k in s.keyframes] == list(range(0, frame + 1, 5))
            assert len(s.loops) == (frame >= 36)
    finally:
        engine.close()


def test_past_poses_are_those_of_the_frame(folder):
    """Every keyframe is moved by a known amount at row 6; what hangs on it moves along, and only from then on."""
    rows = [dict(row, window=(), window_c2w=()) for row in load_run(folder).rows[:8]]
    shift = np.eye(4)
    shift[:3, 3] = 0.1, 0.2, 0.3
    seen = np.tile(np.eye(4), (8, 1, 1))
    seen[:, :3] = np.array([row["c2w"] for row in rows]).reshape(-1, 3, 4)
    rows[6] |= {"window": [0, 5], "window_c2w": [(shift @ seen[k])[:3].ravel() for k in (0, 5)]}
    final = seen + 1
    past = Past(rows, final)
    assert np.allclose(past.trajectory(5), seen[:6])
    after = past.trajectory(6)
    assert np.allclose(after[:6], shift @ seen[:6])
    assert np.allclose(after[6], seen[6])
    assert past.trajectory(7) is final


def test_scrubbing_brings_the_mesh_of_that_time(folder, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(folder, run)
    (run / "meshes").mkdir()
    early = room_mesh(0.5)
    trimesh.Trimesh(early.vertices, early.faces, vertex_colors=early.colors, process=False).export(
        run / "meshes" / "000010.ply"
    )
    engine = ReplayEngine(load_run(run))
    feed = engine.subscribe()

    def faces_at(frame):
        engine.submit(m.RunTo(frame))
        while not isinstance(thing := feed.get(5), m.MeshReady):
            assert thing is not None
        return len(thing.mesh.faces)

    try:
        assert faces_at(20) == len(early.faces)
        assert faces_at(FRAMES - 1) > len(early.faces)
        assert faces_at(12) == len(early.faces)
    finally:
        engine.close()


def test_play_runs_to_the_end_and_step_moves_by_one(replay):
    events(replay, m.Snapshot, m.SpeedLimit(60.0))
    events(replay, m.Snapshot, m.RunTo(FRAMES - 6))
    events(replay, m.Snapshot, m.Step())
    assert replay.latest().frame == FRAMES - 5
    assert replay.latest().state is m.State.PAUSED
    events(replay, m.Snapshot, m.Resume())
    assert until(lambda: replay.latest().state is m.State.FINISHED)
    assert replay.latest().frame == FRAMES - 1
    assert events(replay, m.Snapshot, m.Step())[1].error == f"frame {FRAMES - 1} is the last one; Play begins again"


@pytest.mark.parametrize("command", [m.Restart(), m.Tune("mapping.rays", 3), m.Export("mesh", "exe"), m.Export("soul")])
def test_what_a_replay_cannot_do_is_refused_in_one_line(replay, command):
    _, ack = events(replay, m.Exported, command)
    assert ack.error
    assert "\n" not in ack.error


def test_exports(replay, folder):
    mesh = trimesh.load_mesh(events(replay, m.Exported, m.Export("mesh", "ply"))[0].path, process=False)
    assert len(np.unique(mesh.visual.vertex_colors, axis=0)) > 10
    tum = np.loadtxt(events(replay, m.Exported, m.Export("trajectory", "tum"))[0].path)
    assert np.array_equal(tum[:, 1:4], load_run(folder).trajectory[:, :3, 3]), "not a digit is lost"
    kitti = np.loadtxt(events(replay, m.Exported, m.Export("trajectory", "kitti"))[0].path)
    assert np.array_equal(kitti.reshape(-1, 3, 4), load_run(folder).trajectory[:, :3])
    keyframes = np.loadtxt(events(replay, m.Exported, m.Export("keyframes"))[0].path)
    assert np.array_equal(keyframes, tum[::5])
    (folder / "checkpoints").mkdir()
    (folder / "checkpoints" / "000039.safetensors").write_bytes(b"large")
    with zipfile.ZipFile(events(replay, m.Exported, m.Export("run", "zip"))[0].path) as archive:
        assert {f"lite/{name}" for name in ("metrics.jsonl", "mesh.ply", "summary.json")} <= set(archive.namelist())
        assert not any(name.startswith(("lite/exports", "lite/checkpoints")) for name in archive.namelist())
    events(replay, m.Exported, m.Export("config"))
    some = ("config-000039.yaml", "keyframes-000039-tum.txt", "mesh-000039.ply", "run-000039.zip")
    names = {path.name for path in (folder / "exports").iterdir()}
    assert names == {*some, "trajectory-000039-tum.txt", "trajectory-000039-kitti.txt"}, "as a live run names them"


def test_a_comparison_says_which_path_is_whose(folder):
    run = load_run(folder)
    html = figures_table(run, run, ("First", "Second"))
    for name, color in (("First", theme.ESTIMATE), ("Second", theme.OTHER)):
        assert f'<i style="--c:{theme.css(color)}"></i>path of {name}' in html


def test_killed_run_with_a_cut_line_opens(folder, tmp_path):
    (tmp_path / "metrics.jsonl").write_bytes((folder / "metrics.jsonl").read_bytes()[:-40])
    run = load_run(tmp_path)
    assert len(run.rows) == FRAMES - 1
    assert (run.trajectory_gt, run.loops, run.meshes) == (None, (), {})


@pytest.mark.parametrize(
    ("summary", "state", "says"),
    [
        ({"ended": "finished"}, m.State.FINISHED, ""),
        ({"frames": FRAMES}, m.State.FINISHED, ""),
        ({"ended": "stopped"}, m.State.FINISHED, f"Stopped after {FRAMES} of 90 frames"),
        ({"ended": "failed", "error": "no memory"}, m.State.FAILED, f"Failed after {FRAMES} of 90 frames: no memory"),
        ({"ended": "interrupted"}, m.State.FINISHED, f"Not finished: {FRAMES} of 90 frames are done; ecslam resume"),
        ({}, m.State.FINISHED, f"Not finished: {FRAMES} of 90 frames are done; ecslam resume"),
    ],
)
def test_a_replay_says_how_its_run_ended(folder, tmp_path, summary, state, says):
    shutil.copytree(folder, tmp_path / "run")
    (tmp_path / "run/summary.json").write_text(json.dumps(summary))
    (tmp_path / "run/run.json").write_text(json.dumps({"frames_total": 90}))
    replay = ReplayEngine(load_run(tmp_path / "run"))
    try:
        assert replay.latest().state is state
        assert replay.latest().reason.startswith(says)
        assert bool(replay.latest().reason) == bool(says)
    finally:
        replay.close()


def test_lines_and_values_of_wrong_types_are_left_out(folder, tmp_path):
    whole, copy = load_run(folder), tmp_path / "copy"
    shutil.copytree(folder, copy)
    (copy / "run.json").write_text(json.dumps({"width": "abc", "height": 480, "fy": 0}))
    for name, line in (
        ("events.jsonl", '{"type":"loop"}'),
        ("keyframes.jsonl", '{"frame":"x"}'),
        ("metrics.jsonl", '{"frame":"x","c2w":[]}'),
    ):
        with (copy / name).open("a") as file:
            file.write(line + "\n")
    read = load_run(copy)
    assert (len(read.rows), len(read.keyframes), len(read.loops)) == (
        len(whole.rows),
        len(whole.keyframes),
        len(whole.loops),
    )
    assert 0 < read.fov_y_rad < 3


def test_without_the_first_true_pose_the_truth_is_not_drawn(folder, tmp_path):
    shutil.copytree(folder, tmp_path / "run")
    truth = tmp_path / "run/groundtruth.txt"
    lines = truth.read_text().splitlines(keepends=True)
    truth.write_text("".join(lines[:3] + lines[5:]))
    assert np.isnan(load_run(tmp_path / "run").trajectory_gt).any()
    truth.write_text("".join(lines[5:]))
    assert load_run(tmp_path / "run").trajectory_gt is None


@pytest.mark.parametrize("content", [None, "", "not json\n"])
def test_what_is_no_run_is_a_clear_error(tmp_path, content):
    if content is not None:
        (tmp_path / "metrics.jsonl").write_text(content)
    with pytest.raises(InputError, match="run"):
        load_run(tmp_path)


def test_thumbnail_outside_the_run_is_not_read(folder, tmp_path):
    for name in ("metrics.jsonl", "summary.json"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    (tmp_path / "keyframes.jsonl").write_text(json.dumps({"frame": 0, "thumbnail": "../../../../etc/hostname"}) + "\n")
    assert not load_run(tmp_path).keyframes[0].picture


def test_runs_on_different_sequences_are_not_compared(folder, tmp_path):
    other = write_run(tmp_path / "other", 20)
    (other / "summary.json").write_text(json.dumps({"sequence": "synthetic/corridor"}))
    with pytest.raises(InputError, match="different sequences"):
        server.view([folder, other], port=0)


def test_runs_of_different_length_are_compared_unless_their_cameras_really_were_elsewhere(folder, tmp_path):
    """A built-in room of 300 frames and one of 2,000 bear the same name."""
    shorter = write_run(tmp_path / "shorter", FRAMES // 2)
    lines = (folder / "groundtruth.txt").read_text().splitlines(keepends=True)
    (shorter / "groundtruth.txt").write_text("".join(lines[: FRAMES // 2]))
    server.view([folder, shorter], port=0).close()
    moved = [f"{t} {float(x) + 0.02} {rest}" for t, x, rest in (line.split(" ", 2) for line in lines)]
    (shorter / "groundtruth.txt").write_text("".join(moved))
    with pytest.raises(InputError, match=r"2\.0 cm apart"):
        server.view([folder, shorter], port=0)


def test_a_killed_run_is_compared_by_what_was_written_when_it_began(folder, tmp_path):
    killed = write_run(tmp_path / "killed", FRAMES)
    (killed / "summary.json").unlink()
    (killed / "run.json").write_text(json.dumps({"name": "synthetic/studio"}))
    page = server.view([killed, folder], port=0)
    page.close()
    assert page.engine.sequences == ("synthetic/studio",)
    (killed / "run.json").write_text(json.dumps({"name": "synthetic/corridor"}))
    with pytest.raises(InputError, match="different sequences"):
        server.view([folder, killed], port=0)


def test_an_export_that_fails_is_answered_and_the_replay_goes_on(replay, monkeypatch):
    monkeypatch.setattr("ecslam_app.replay.export", lambda run, command: 1 / 0)
    assert events(replay, m.Exported, m.Export("config"))[1].error == "division by zero"
    events(replay, m.Snapshot, m.RunTo(3))
    assert replay.latest().frame == 3


def test_files_older_than_zip_knows_are_exported_too(folder, tmp_path):
    run = shutil.copytree(folder, tmp_path / "run")
    os.utime(run / "config.yaml", (0, 0))
    with zipfile.ZipFile(zip_run(run, "exports/run.zip")) as archive:
        assert "run/config.yaml" in archive.namelist()


def test_html_replay_is_one_file_without_addresses_of_others(replay, tmp_path):
    page = html_replay(replay.latest(), room_mesh(0.3), replay.history, dark=False)
    assert "__VISER_EMBED_DATA__" in page
    assert "http://localhost" not in page


# ---- what is drawn ------------------------------------------------------------------------------------------------


def test_a_frustum_is_as_wide_and_high_as_its_camera_sees():
    c2w = np.eye(4)
    c2w[:3, 3] = 5, 6, 7
    lines = frustum_lines(c2w[None], 2 * np.arctan(0.5), 4 / 3, 2.0)
    assert lines.shape == (8, 2, 3)
    corners = np.unique(lines.reshape(-1, 3).round(4), axis=0) - c2w[:3, 3]
    wanted = [[0, 0, 0], *([x, y, 2] for x in (-4 / 3, 4 / 3) for y in (-1, 1))]
    assert np.allclose(sorted(corners.tolist()), sorted(wanted), atol=1e-4)


def test_the_loop_timeline_credits_an_error_to_its_frame_however_many_there_are(replay):
    truth = np.tile(np.eye(4), (1000, 1, 1))
    angle = np.radians(0.01 * np.arange(1000))
    turned = truth.copy()
    turned[:, 0, 0] = turned[:, 2, 2] = np.cos(angle)
    turned[:, 0, 2], turned[:, 2, 0] = np.sin(angle), -np.sin(angle)
    truth[:, :3, :3] = truth[:, :3, :3] @ turned[::-1, :3, :3]
    snapshot = replace(replay.latest(), trajectory=truth @ turned, trajectory_gt=truth)
    title, frames, degrees = discrepancy(snapshot, 100)
    assert "°" in title
    assert len(frames) == 100
    assert (frames[0], frames[-1]) == (0, 999)
    assert np.allclose(degrees, 0.01 * frames, atol=1e-5)


def test_glb_is_read_back_by_trimesh():
    mesh = room_mesh(0.3)
    scene = trimesh.load(io.BytesIO(to_glb(mesh, mesh.colors)), file_type="glb", process=False)
    back = next(iter(scene.geometry.values()))
    assert np.allclose(back.vertices, mesh.vertices, atol=1e-6)
    assert np.array_equal(back.faces, mesh.faces)
    edges = trimesh.load(io.BytesIO(to_glb(mesh, mesh.colors, wireframe=True)), file_type="glb", process=False)
    assert len(edges.geometry) == 1


def test_glb_colours_are_linear_light_and_opaque():
    """128 of sRGB is 21.6 % of the light (IEC 61966-2-1), 10 is 0.3 %."""
    colors = np.array([[255, 128, 0], [10, 10, 10], [0, 0, 0]], np.uint8)
    mesh = Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32), colors)
    data = to_glb(mesh, colors)
    (length,) = struct.unpack_from("<I", data, 12)
    view = json.loads(data[20 : 20 + length])["bufferViews"][1]
    stored = np.frombuffer(data, np.uint16, view["byteLength"] // 2, 28 + length + view["byteOffset"]).reshape(-1, 4)
    light = stored / 65535
    assert np.allclose(light[:, :3], [[1, 0.21586, 0], [0.00304] * 3, [0, 0, 0]], atol=2e-5)
    assert (stored[:, 3] == 65535).all()


@pytest.mark.parametrize("triangles", [500, 5000, 10**6])
def test_simplified_mesh_keeps_shape_within_budget(triangles):
    mesh = room_mesh(0.1)
    small = simplify(mesh, triangles)
    assert 0 < len(small.faces) <= triangles
    assert np.allclose(small.vertices.min(0), mesh.vertices.min(0), atol=0.3)
    assert small.faces.max() < len(small.vertices)
    area = [trimesh.Trimesh(x.vertices, x.faces, process=False).area for x in (mesh, small)]
    assert area[1] == pytest.approx(area[0], rel=0.3)


def test_a_rough_floor_that_was_simplified_is_seen_from_above_alone():
    y, x = (n.ravel() for n in np.mgrid[0:120, 0:120])
    rng = np.random.default_rng(0)
    vertices = np.stack([x, y, rng.normal(0, 0.2, x.size)], 1) + rng.uniform(-0.3, 0.3, (x.size, 3)) * (1, 1, 0)
    low = np.arange(x.size).reshape(120, 120)[:-1, :-1].ravel()
    faces = np.concatenate([np.stack([low, low + 1, low + 121], 1), np.stack([low, low + 121, low + 120], 1)])
    small = simplify(Mesh(vertices.astype(np.float32), faces.astype(np.int32)), 5000)
    a, b, c = (small.vertices[corner] for corner in small.faces.T)
    upwards = np.cross(b - a, c - a)[:, 2]
    assert (upwards >= 0).all()
    assert 0.98 * 119**2 < upwards.sum() / 2 < 1.1 * 119**2, "and it has no holes"


def test_up_is_found():
    assert np.allclose(up_direction(walk(50)), [0, 0, 1])


@pytest.mark.parametrize("aspect", [0.5, 1.0, 1.7])
@pytest.mark.parametrize("side", [[1, 0, 0], [-0.6, 0.8, 0]])
def test_overview_fills_the_picture_from_above(aspect, side):
    corners = np.array(np.meshgrid([-3.0, 3], [-2.0, 2], [0.0, 2.5])).reshape(3, -1).T
    up, fov = np.array([0.0, 0, 1]), 0.9
    position, look_at = overview(corners, up, np.array(side, float), aspect, fov)
    assert (position - look_at) @ side > 0
    assert position[2] > 2.5
    forward = (look_at - position) / np.linalg.norm(look_at - position)
    right = np.cross(forward, up) / np.linalg.norm(np.cross(forward, up))
    local = (corners - position) @ np.stack([right, np.cross(right, forward), forward]).T
    screen = local[:, :2] / local[:, 2:] / (np.tan(fov / 2) * np.array([aspect, 1]))
    lowest = 0.0 if aspect < 0.8 else -0.97
    assert screen.min(0)[0] > -0.97
    assert screen.max(0)[0] < 0.97
    assert screen.min(0)[1] > lowest - 0.02
    assert screen.max(0)[1] < 0.97
    assert max(np.ptp(screen[:, 0]) / 1.88, np.ptp(screen[:, 1]) / (0.78 if aspect < 0.8 else 1.88)) > 0.9


def test_a_wall_is_looked_at_from_its_front_and_the_choice_lasts():
    wall = Mesh(
        np.array([[0, -1, 0], [0, 1, 0], [0, 1, 1], [0, -1, 1]], np.float32), np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    )
    up = np.array([0.0, 0, 1])
    side = best_side(wall, up)
    assert side[0] > 0.7
    turned = best_side(Mesh(wall.vertices, wall.faces[:, ::-1]), up)
    assert turned[0] < -0.7
    assert np.array_equal(best_side(room_mesh(0.3), up, side), side)
    for degrees, stays in ((20, True), (35, True), (60, False), (180, False)):
        before = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees)), 0])
        assert np.array_equal(best_side(wall, up, before), before) == stays


@pytest.mark.parametrize("up", [[0, 0, 1], [0, 0, -1], [0, -1, 0], [0.6, 0, 0.8]])
def test_grid_is_turned_to_up(up):
    import viser.transforms as vt

    assert np.allclose(vt.SO3(rotation_to(np.array(up, float))).apply(np.array([0, 0, 1.0])), up, atol=1e-9)


def test_rotation_difference():
    poses = np.tile(np.eye(4), (3, 1, 1))
    turned = poses.copy()
    angle = np.radians(30)
    turned[1, :2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    turned[2] = np.nan
    assert np.allclose(rotation_difference_deg(poses, turned), [0, 30, np.nan], equal_nan=True)


def test_history_thins_and_fills_gaps():
    history = History()
    for frame in range(1000):
        history.add(frame, {"ate_cm": float(frame)} if frame % 2 else {}, {}, (frame,) if frame % 10 == 0 else ())
    frames, ate = history.series(["ate_cm"], most=100)
    assert len(frames) <= 101
    assert np.isnan(ate[frames % 2 == 0]).all()
    assert history.window_at(57) == (50,)


def test_a_frame_seen_at_work_is_credited_with_its_own_figures(tmp_path, monkeypatch):
    monkeypatch.setattr(live, "LONG_STEP_S", 0.0)
    monkeypatch.setattr(live, "UNWATCHED_PERIOD_S", 0.0)
    seen, history = [], History()

    def show(s):
        seen.append((s.frame, s.reported))
        history.add_snapshot(s)

    make = maker(Behaviour(interrupts=2, pause_s=0.001))
    live.Engine(QUICK, FakeSequence(8, bad=(6,)), tmp_path / "run", make=make).run(show)
    assert {(0, None), (5, 4), (5, 5), (6, 5)} <= set(seen)
    known = history_of(frame_rows(tmp_path / "run"))
    assert history.windows == known.windows
    names = ["track_ms", "map_ms", *known.names()]
    assert np.array_equal(history.series(names), known.series(names))
