"""Every command does what it says; all are acknowledged at once, also in the middle of a long mapping."""

import json
import re
import threading
import time
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from fake_slam import QUICK, TURN_DEG, Behaviour, FakeSequence
from runtime_watch import Watch, running

from ecslam import config_files
from ecslam.config import Config
from ecslam.meshing import MeshingStopped
from ecslam.messages import (
    Export,
    Exported,
    FramePictures,
    LoadPreset,
    LoopEvent,
    MeshReady,
    Notice,
    Pause,
    PauseOnLoop,
    Quit,
    RequestMesh,
    RequestPictures,
    Restart,
    Resume,
    RunTo,
    Snapshot,
    SpeedLimit,
    State,
    Step,
    Stop,
    Tune,
)
from ecslam.runtime import workshop
from ecslam.runtime.checkpoint import load_checkpoint
from ecslam.runtime.protocol import EngineHandle

LONG = Behaviour(first_interrupts=100_000, pause_s=0.001)


def test_step_and_run_to_process_exactly_the_frames_asked_for(tmp_path):
    with running(tmp_path, paused_at=0) as (engine, watch, _):
        assert isinstance(engine, EngineHandle)
        for done in (1, 2, 3):
            snapshot = watch.go(Step(), State.PAUSED)
            assert (snapshot.frame, len(snapshot.trajectory)) == (done - 1, done)
        assert len(watch.go(RunTo(9), State.PAUSED).trajectory) == 10
        assert watch.ask(RunTo(3)).error == "cannot run to frame 3; 10 .. 29 lie ahead"
        assert "lie ahead" in watch.ask(RunTo(30)).error
        assert len(watch.go(Resume(), State.FINISHED).trajectory) == 30
        for command in (Pause(), Resume(), Step(), RunTo(3)):
            assert watch.ask(command).error == "the run is over; restart it"


def test_pause_stops_the_frame_number(tmp_path):
    with running(tmp_path, FakeSequence(2000), Behaviour(pause_s=0.005)) as (engine, watch, _):
        watch.until(lambda m: isinstance(m, Snapshot) and m.frame > 3)
        frame = watch.go(Pause(), State.PAUSED).frame
        time.sleep(0.1)
        assert engine.latest().frame == frame < 1999


def test_stop_ends_the_run_as_if_the_sequence_ended(tmp_path):
    with running(tmp_path, paused_at=12) as (engine, watch, made):
        assert len(watch.go(Stop(), State.FINISHED).trajectory) == 12
        assert made[0].finished
        assert engine.summary["frames"] == 12
        assert (tmp_path / "mesh.ply").stat().st_size > 1000


def test_commands_are_acknowledged_within_200_ms_during_the_first_mapping(tmp_path):
    with running(tmp_path, behaviour=LONG) as (_, watch, __):
        watch.until(lambda m: isinstance(m, Snapshot))
        time.sleep(0.2)
        for command in (Pause(), Step(), SpeedLimit(5.0), RequestPictures(), Tune("window.size", 9), Stop(), Quit()):
            started = time.monotonic()
            assert watch.ask(command).error == ""
            assert time.monotonic() - started < 0.2


@pytest.mark.parametrize("command", [Quit(), Restart(), Stop()])
def test_leaving_abandons_a_long_mapping_within_two_seconds(tmp_path, command):
    behaviour = Behaviour(first_interrupts=100_000, pause_s=0.001)
    with running(tmp_path / "r", behaviour=behaviour) as (engine, watch, made):
        watch.until(lambda m: isinstance(m, Snapshot))
        time.sleep(0.2)
        started = time.monotonic()
        behaviour.first_interrupts = 1
        watch.ask(command)
        if isinstance(command, Quit):
            assert engine.join(3)
        else:
            watch.state(State.FINISHED)
        assert time.monotonic() - started < 5
        assert not made[0].finished
    first = json.loads((tmp_path / "r/summary.json").read_text())
    assert first["frames"] == 0


@pytest.mark.parametrize("command", [Quit(), Restart()])
def test_leaving_abandons_the_last_mapping_which_can_be_made_up_for(tmp_path, command):
    behaviour = Behaviour(final_interrupts=100_000, pause_s=0.001)
    with running(tmp_path / "r", FakeSequence(3), behaviour) as (engine, watch, made):
        watch.until(lambda m: isinstance(m, Snapshot) and m.frame == 2)
        time.sleep(0.2)
        behaviour.final_interrupts = 0
        started = time.monotonic()
        watch.ask(command)
        if isinstance(command, Quit):
            assert engine.join(3)
        else:
            watch.state(State.FINISHED)
        assert time.monotonic() - started < 5
        assert not made[0].finished
    assert json.loads((tmp_path / "r/summary.json").read_text())["frames"] == 3
    left = load_checkpoint(tmp_path / "r/checkpoints")
    assert not left.meta["finished"]
    assert not left.arrays["half_way"]


def test_the_last_mapping_says_how_far_it_is_and_a_second_stop_leaves_out_the_rest(tmp_path):
    behaviour = Behaviour(final_interrupts=100_000, pause_s=0.001)
    with running(tmp_path, FakeSequence(9), behaviour, paused_at=3) as (_, watch, made):
        assert watch.ask(Stop()).error == ""
        told = watch.until(lambda m: isinstance(m, Snapshot) and m.reason).reason
        total = QUICK.mapping.iterations + QUICK.mapping.final_iterations
        assert re.fullmatch(rf"Last mapping \d+/{total}; Stop leaves out the rest", told)
        last = watch.go(Stop(), State.FINISHED)
        assert (len(last.trajectory), last.reason) == (3, "")
        assert not made[0].finished
        assert (tmp_path / "mesh.ply").stat().st_size > 1000
        assert watch.ask(Stop()).error == "", "it has been done already"


def test_a_mesh_comes_within_five_seconds_even_during_the_first_mapping(tmp_path):
    started = time.monotonic()
    with running(tmp_path, behaviour=LONG) as (_, watch, __):
        ready = watch.event(MeshReady)
        assert time.monotonic() - started < 5
        assert len(ready.mesh.faces) > 100
        assert np.abs(ready.mesh.vertices[:, 2] - 2).max() < 1e-6, "what the camera measured"
        assert watch.until(lambda m: isinstance(m, Snapshot) and m.color is not None).state is State.INITIALISING
        assert watch.ask(RequestMesh(0.2)).error == ""
        learnt = watch.until(lambda m: isinstance(m, MeshReady) and m.voxel_m == 0.2)
        assert learnt.frame == 0
        assert np.abs(np.linalg.norm(learnt.mesh.vertices, axis=1) - 1).max() < 0.05


def test_a_mesh_of_the_run_before_is_not_shown_after_a_restart(tmp_path, monkeypatch):
    begun, go = threading.Event(), threading.Event()
    real = workshop.build_mesh

    def slow(frozen, voxel_m, *options):
        if voxel_m == 0.3:
            begun.set()
            go.wait(10)
        return real(frozen, voxel_m)

    monkeypatch.setattr(workshop, "build_mesh", slow)
    with running(tmp_path / "run", paused_at=6) as (engine, watch, _):
        watch.ask(RequestMesh(0.3))
        watch.ask(RequestMesh(0.4))
        assert begun.wait(10)
        watch.ask(Restart())
        watch.until(lambda m: engine.run_folder.name == "run-2" and isinstance(m, Snapshot) and m.frame >= 0)
        since = len(watch.seen)
        go.set()
        watch.state(State.FINISHED, since)
        assert not [m for m in watch.seen[since:] if isinstance(m, MeshReady) and m.voxel_m in (0.3, 0.4)]


def test_requested_meshes_keep_to_their_budget(tmp_path):
    with running(tmp_path, paused_at=6) as (_, watch, __):
        watch.ask(RequestMesh(0.05, 500))
        ready = watch.until(lambda m: isinstance(m, MeshReady) and len(m.mesh.faces) <= 500)
        assert ready.voxel_m > 0.05
        assert ready.frame == 5
        assert "must lie in" in watch.ask(RequestMesh(1e-5)).error


def test_forty_requests_at_once_are_answered_or_refused_in_plain_words(tmp_path):
    with running(tmp_path, paused_at=6) as (_, watch, __):
        acks = [watch.ask(Export("mesh", "ply", 0.03)) for _ in range(40)]
        refused = [ack for ack in acks if ack.error]
        assert all("try again" in ack.error for ack in refused)
        started = time.monotonic()
        assert watch.ask(Stop()).error == ""
        assert time.monotonic() - started < 0.2
        wanted = {ack.command_id for ack in acks} - {ack.command_id for ack in refused}
        while wanted:
            wanted.discard(watch.until(lambda m: isinstance(m, Exported) and m.command_id in wanted).command_id)


def test_tune_and_load_preset_reach_the_engine(tmp_path):
    with running(tmp_path, paused_at=3) as (_, watch, made):
        assert watch.ask(Tune("mapping.iterations", 40)).error == ""
        assert watch.go(Step(), State.PAUSED).losses["colour"] == 10.0
        assert "did you mean" in watch.ask(Tune("mapping.iteration", 40)).error
        assert "out of range" in watch.ask(Tune("mapping.iterations", -1)).error
        assert "no effect" in watch.ask(Tune("field.levels", 8)).error
        assert watch.go(LoadPreset("full"), State.PAUSED).preset == "full", "the page learns of it at once"
        watch.go(Step(), State.PAUSED)
        assert made[0].config.mapping.rays == 4000
        assert "no such preset" in watch.ask(LoadPreset("../secret")).error
        assert watch.ask(Export("config")).error == ""
        exported = yaml.safe_load(Path(watch.event(Exported).path).read_text())
        assert exported["tracking"]["rays"] == 2000
    log = (tmp_path / "events.jsonl").read_text()
    assert "mapping.iterations = 40 from frame 3 on" in log
    assert "preset full from frame 4 on" in log
    assert config_files.load_config(tmp_path / "config.yaml") == made[0].config


@pytest.mark.parametrize("command", [LoadPreset("live"), Tune("tracking.iterations", 0)])
def test_what_would_leave_nothing_that_tracks_is_refused_and_the_run_goes_on(tmp_path, command):
    config = config_files.apply_settings(config_files.load_preset("lite"), ["align.to=none"])
    with running(tmp_path, config=config, paused_at=3) as (_, watch, made):
        assert "nothing tracks" in watch.ask(command).error
        watch.go(Step(), State.PAUSED)
        assert made[0].config == config


def test_a_request_that_fails_is_told_and_the_run_goes_on(tmp_path, monkeypatch):
    monkeypatch.setattr("ecslam.runtime.exports.six_pictures", lambda *_: 1 / 0)
    with running(tmp_path, paused_at=3) as (_, watch, __):
        watch.ask(RequestPictures())
        assert "division by zero" in watch.event(Notice).text
        watch.go(Resume(), State.FINISHED)


def test_restart_begins_again_beside_the_first_run(tmp_path):
    out = tmp_path / "run"
    with running(out, paused_at=8, sequences=("fake:12", "other")) as (engine, watch, made):
        watch.go(Restart(preset="full", seed=7), State.FINISHED)
        assert (engine.summary["preset"], engine.summary["seed"], engine.summary["frames"]) == ("full", 7, 30)
        assert engine.run_folder == tmp_path / "run-2"
        watch.go(Restart(sequence="fake:12"), State.FINISHED)
        assert engine.summary["frames"] == 12
        assert engine.summary["preset"] == "full"
        assert "is not on offer" in watch.ask(Restart(sequence="/etc")).error
        assert "is not on offer" in watch.ask(Restart(preset="none")).error
        assert "schedule must be one of" in watch.ask(Restart(schedule="fast")).error
        failed = watch.go(Restart(sequence="other"), State.FAILED)
        assert "the run before: other: no such folder" in failed.reason
        assert (failed.sequence, failed.frame) == ("fake", 11)
        assert watch.until(lambda m: isinstance(m, Notice) and m.level == "error").text == failed.reason
        watch.go(Restart(sequence="fake:12"), State.FINISHED)
        assert len(made) == 4
    first = json.loads((out / "summary.json").read_text())
    assert first["frames"] == 8


def test_what_waits_for_the_run_before_a_restart_is_not_done_to_the_new_one(tmp_path):
    behaviour = Behaviour()
    with running(tmp_path / "run", paused_at=8, behaviour=behaviour) as (_, watch, made):
        behaviour.pause_s, asked = 1.0, len(watch.seen)
        watch.ask(Step())
        time.sleep(0.2)
        behaviour.pause_s = 0.0
        watch.ask(Tune("mapping.iterations", 33))
        number = watch.ask(Export("trajectory")).command_id
        watch.ask(Restart())
        watch.state(State.FINISHED, asked)
        assert made[1].config.mapping.iterations != 33
        exported = watch.until(lambda m: isinstance(m, Exported) and m.command_id == number)
        assert Path(exported.path).parent == tmp_path / "run/exports"
        assert not [m for m in watch.seen[asked:] if isinstance(m, Notice) and "mapping.iterations" in m.text]


def test_a_restart_and_a_preset_keep_what_the_layout_asks_for(tmp_path, monkeypatch):
    (tmp_path / "layouts").mkdir()
    (tmp_path / "layouts" / "fake.yaml").write_text("depth_far_m: 2.5\ntracking:\n  rays: 123\n")
    monkeypatch.setattr(config_files, "config_folder", lambda: tmp_path)
    monkeypatch.setattr(config_files, "load_preset", lambda name: replace(Config(), preset=name))
    monkeypatch.setattr(config_files, "preset_names", lambda: ["lite", "full"])
    with running(tmp_path / "run", paused_at=2) as (_, watch, made):
        assert watch.ask(LoadPreset("full")).error == ""
        watch.go(Step(), State.PAUSED)
        assert made[0].config.tracking.rays == 123
        watch.go(Restart(preset="full"), State.FINISHED)
        assert made[1].config.depth_far_m == 2.5
        assert made[1].config.tracking.rays == 123


def test_the_speed_limit_holds_and_lifting_it_takes_effect_at_once(tmp_path):
    with running(tmp_path, FakeSequence(60), paused_at=0) as (_, watch, __):
        watch.ask(SpeedLimit(20.0))
        started = time.monotonic()
        watch.go(RunTo(9), State.PAUSED)
        assert 0.4 < time.monotonic() - started < 3
        watch.ask(SpeedLimit(0.01))
        watch.ask(Resume())
        watch.ask(SpeedLimit(0.0))
        watch.state(State.FINISHED)
        assert "positive number" in watch.ask(SpeedLimit(float("nan"))).error


def test_pause_on_loop_and_the_loop_event_carries_errors_against_ground_truth(tmp_path):
    with running(tmp_path, behaviour=Behaviour(loop_at=7), paused_at=0) as (_, watch, __):
        watch.ask(PauseOnLoop(True))
        snapshot = watch.go(Resume(), State.PAUSED)
        assert snapshot.frame == 7
        loop = watch.event(LoopEvent)
        assert snapshot.loops == (loop,)
        assert loop.error_before_cm == pytest.approx(2 * loop.error_after_cm)
        assert loop.rotation_error_before_deg == pytest.approx(TURN_DEG)
        assert loop.rotation_error_after_deg == pytest.approx(0, abs=1e-5)
    logged = [json.loads(line) for line in (tmp_path / "events.jsonl").read_text().splitlines()]
    assert [e["frame"] for e in logged if e["type"] == "loop"] == [7]


def test_pictures_of_the_newest_and_of_an_earlier_frame(tmp_path):
    with running(tmp_path, paused_at=9) as (_, watch, __):
        watch.ask(RequestPictures())
        pictures = watch.event(FramePictures)
        assert pictures.frame == 8
        shapes = {getattr(pictures, name).shape for name in vars(pictures) if name not in ("frame", "took_s")}
        assert shapes == {(48, 64, 3)}
        assert 0 < pictures.took_s < 5
        assert (pictures.color == 8).all()
        assert (pictures.color_difference == 8).all()
        watch.ask(RequestPictures(5))
        assert watch.until(lambda m: isinstance(m, FramePictures) and m.frame == 5).color[0, 0, 0] == 5
        watch.ask(RequestPictures(20))
        assert "has not been processed" in watch.event(Notice).text


def test_pictures_of_a_frame_that_was_left_out_are_those_of_the_one_before(tmp_path):
    with running(tmp_path, FakeSequence(30, bad=(4, 5)), paused_at=9) as (_, watch, __):
        watch.ask(RequestPictures(5))
        assert watch.event(FramePictures).frame == 3


def test_what_pictures_took_leaves_out_the_frame_that_they_wait_for(tmp_path):
    behaviour = Behaviour()
    with running(tmp_path, paused_at=3, behaviour=behaviour) as (_, watch, __):
        behaviour.pause_s = 0.6
        watch.ask(Step())
        watch.ask(RequestPictures())
        assert watch.event(FramePictures).took_s < 0.5


def test_exports_are_files_that_other_programs_read(tmp_path):
    with running(tmp_path / "run", FakeSequence(30, bad=(4,)), paused_at=21) as (_, watch, __):

        def export(*args) -> Path:
            number = watch.ask(Export(*args)).command_id
            return Path(watch.until(lambda m: isinstance(m, Exported) and m.command_id == number).path)

        for form in ("ply", "glb", "obj"):
            mesh = trimesh.load(export("mesh", form, 0.1), force="mesh")
            assert mesh.visual.vertex_colors[:, :3].max() == 128
            assert mesh.bounds.max() == pytest.approx(1, abs=0.05)
        assert np.loadtxt(export("trajectory", "tum")).shape == (20, 8)
        assert np.loadtxt(export("trajectory", "kitti")).shape == (20, 12)
        assert np.loadtxt(export("keyframes")).shape == (5, 8)
        with zipfile.ZipFile(export("run")) as archive:
            names = archive.namelist()
            assert {"run/config.yaml", "run/trajectory.txt", "run/metrics.jsonl"} <= set(names)
            assert not [n for n in names if "checkpoints" in n or "exports" in n]
        assert "there are: mesh (ply, glb, obj)" in watch.ask(Export("mesh", "../x")).error
        assert "cannot export" in watch.ask(Export("passwords")).error


def test_an_export_that_fails_says_so_to_who_asked_for_it(tmp_path):
    with running(tmp_path, paused_at=0) as (_, watch, __):

        def failure(*args) -> str:
            number = watch.ask(Export(*args)).command_id
            told = watch.until(lambda m: isinstance(m, Exported) and m.command_id == number)
            assert told.path == ""
            return told.error

        assert "no map yet" in failure("mesh", "ply")
        (tmp_path / "exports").write_text("in the way")
        assert "exists" in failure("trajectory", "tum")
        assert "exists" in failure("run", "zip")


def test_a_finished_run_still_exports_and_quits(tmp_path):
    with running(tmp_path) as (engine, watch, _):
        watch.state(State.FINISHED)
        watch.ask(Export("mesh", "ply", 0.1))
        assert watch.event(Exported).path.endswith("exports/mesh-000029-100mm.ply")
        watch.ask(Quit())
        assert engine.join(5)
        assert Watch(engine).ask(Pause()).error == "the engine has ended; start it again"


def test_quitting_while_the_last_mesh_is_made_keeps_everything_else(tmp_path, monkeypatch):
    begun = threading.Event()

    def endless(frozen, voxel_m, max_triangles=0, should_stop=None):
        while not should_stop():
            if made[0].finished:
                begun.set()
            time.sleep(0.005)
        raise MeshingStopped

    with running(tmp_path, FakeSequence(3), paused_at=2) as (engine, watch, made):
        monkeypatch.setattr("ecslam.runtime.workshop.build_mesh", endless)
        watch.ask(Resume())
        assert begun.wait(10)
        started = time.monotonic()
        watch.ask(Quit())
        assert engine.join(10)
        assert time.monotonic() - started < 5
    found = json.loads((tmp_path / "summary.json").read_text())
    assert found["frames"] == 3
    assert any("mesh.ply was not made" in text for text in found["warnings"])
    assert len((tmp_path / "trajectory.txt").read_text().splitlines()) == 3
    assert load_checkpoint(tmp_path / "checkpoints").frame == 3
