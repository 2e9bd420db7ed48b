"""The command line as a person meets it: one small run through every command, and one clear line for a wrong input."""

import contextlib
import errno
import io
import json
import os
import re
import shutil
import socket
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import cv2
import numpy as np
import pytest
import torch

from ecslam import __version__, cli, commands, reports
from ecslam.bench import accuracy, speed
from ecslam.config_files import apply_settings, load_config, load_preset
from ecslam.datasets.addresses import ROOMS
from ecslam.datasets.meshes import load_mesh
from ecslam.evaluation import plots
from ecslam.reports import draw_picture
from ecslam.runtime.mesh_files import mesh_bytes
from ecslam.types import InputError, Mesh

ROOM = "synthetic/studio?size=160x120"
SETTINGS = {
    "field.levels": 8,
    "field.log2_table_size": 14,
    "mapping.first_iterations": 40,
    "mapping.iterations": 4,
    "mapping.rays": 500,
    "tracking.iterations": 4,
    "tracking.rays": 200,
}
SUMMARY_KEYS = {
    "sequence", "preset", "device", "kernels", "seed", "frames", "keyframes", "wall_s", "fps_wall", "fps_engine",
    "ate_rmse_cm", "ate_mean_cm", "ate_max_cm", "parameters", "parameters_mb", "peak_memory_mb", "skipped_frames",
    "lost_frames", "loop_closures", "ended", "error",
}  # fmt: skip
EMPTY = Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.uint8))
EVALUATED_KEYS = {"depth_l1_cm", "accuracy_cm", "completion_cm", "completion_ratio"}


@dataclass(frozen=True)
class Outcome:
    code: int
    out: str
    err: str


def ecslam(*words: object) -> Outcome:
    """What the command ``ecslam`` does with these words."""
    out, err, code = io.StringIO(), io.StringIO(), 0
    arguments = mock.patch.object(sys, "argv", ["ecslam", *map(str, words)])
    with arguments, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            cli.main()
        except SystemExit as end:
            code = int(end.code or 0)
    return Outcome(code, out.getvalue(), err.getvalue())


def run_words(sequence: Path, out: Path) -> list[object]:
    settings = [word for key, value in SETTINGS.items() for word in ("--set", f"{key}={value}")]
    return ["run", sequence, "--headless", "--preset", "lite", "--device", "cpu", "--seed", 3, *settings, "--out", out]


@pytest.fixture(scope="session")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight small frames of a built-in room, written by ``synth``."""
    folder = tmp_path_factory.mktemp("cli") / "room"
    done = ecslam("synth", ROOM, folder, "--frames", "0:8")
    assert done.code == 0, done.err
    return folder


@pytest.fixture(scope="session")
def finished(sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a small run."""
    folder = tmp_path_factory.mktemp("cli") / "run"
    done = ecslam(*run_words(sequence, folder))
    assert done.code == 0, done.err
    assert str(folder / "mesh.ply") in done.out
    return folder


def summary(folder: Path) -> dict:
    return json.loads((folder / "summary.json").read_text())


def assert_refused(outcome: Outcome, *parts: str) -> None:
    """One line that names what is wrong, and exit code 2."""
    assert outcome.code == 2, outcome.out
    assert outcome.err.count("\n") == 1
    assert outcome.err.startswith("error: ")
    for part in parts:
        assert part in outcome.err


# ---- a small run ----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_synth_says_how_to_open_a_room_with_a_rolling_shutter(tmp_path):
    done = ecslam("synth", f"{ROOM}&readout=0.03", tmp_path / "rolling", "--frames", "0:2")
    assert f"open it as {tmp_path / 'rolling'}?readout=0.03" in done.out


def test_synth_writes_what_check_accepts(sequence):
    assert {p.name for p in sequence.iterdir()} == {"results", "traj.txt", "cam_params.json", "mesh.ply"}
    report = ecslam("check", sequence)
    assert report.code == 0
    for part in ("replica", "160x120", "8 of 8", "path"):
        assert part in report.out


def test_check_says_what_looks_odd(sequence, tmp_path):
    broken = shutil.copytree(sequence, tmp_path / "room")
    image = broken / "results" / "depth000002.png"
    image.write_bytes(image.read_bytes()[:200])
    report = ecslam("check", broken)
    assert report.code == 0
    assert "depth000002.png" in report.out


def test_check_fails_where_nothing_is_readable(sequence, tmp_path):
    broken = shutil.copytree(sequence, tmp_path / "room")
    for image in (broken / "results").glob("depth*.png"):
        image.write_bytes(image.read_bytes()[:200])
    report = ecslam("check", broken)
    assert "0 of 8 tried readable" in report.out
    assert_refused(report, str(broken), "none of the 8 frames")


def test_a_name_that_the_output_cannot_encode_is_spelt_out(sequence, tmp_path):
    room = shutil.copytree(sequence, tmp_path / "кухня")
    out = io.TextIOWrapper(io.BytesIO(), "latin-1")
    arguments = mock.patch.object(sys, "argv", ["ecslam", "check", str(room)])
    with arguments, contextlib.redirect_stdout(out), pytest.raises(SystemExit) as end:
        cli.main()
    assert not end.value.code
    out.flush()
    assert b"\\u043a\\u0443" in out.buffer.getvalue()


def test_check_judges_depth_by_what_a_run_with_this_layout_uses(tmp_path):
    for n in range(2):
        cv2.imwrite(str(tmp_path / f"frame-{n:06d}.color.png"), np.full((48, 64, 3), 99, np.uint8))
        cv2.imwrite(str(tmp_path / f"frame-{n:06d}.depth.png"), np.full((48, 64), 5000, np.uint16))
    (tmp_path / "camera-intrinsics.txt").write_text("60 0 32\n0 60 24\n0 0 1\n")
    report = ecslam("check", tmp_path).out
    assert "0.10 .. 3.00 m, 0% of the depth" in report
    assert "beyond depth_far_m = 3" in report


def test_summary_has_the_keys_that_others_rely_on(finished, sequence):
    found = summary(finished)
    assert found.keys() >= SUMMARY_KEYS
    assert (found["frames"], found["keyframes"], found["seed"], found["preset"]) == (8, 2, 3, "lite")
    assert (found["skipped_frames"], found["lost_frames"]) == (0, 0)
    assert found["ate_mean_cm"] <= found["ate_rmse_cm"] <= found["ate_max_cm"]
    assert found["made_by"]["ecslam"].startswith(__version__)
    assert found["parameters_mb"] == pytest.approx(4e-6 * found["parameters"], abs=1e-3)


def test_run_folder_is_complete(finished):
    names = {p.name for p in finished.iterdir()}
    assert names >= {"config.yaml", "trajectory.txt", "events.jsonl", "metrics.jsonl", "mesh.ply", "summary.json"}
    assert (finished / "picture.png").read_bytes().startswith(b"\x89PNG")
    assert len((finished / "metrics.jsonl").read_text().splitlines()) == 8
    assert np.loadtxt(finished / "trajectory.txt").shape == (8, 8)


def test_saved_configuration_is_the_one_that_ran(finished):
    saved = load_config(finished / "config.yaml")
    assert saved == apply_settings(load_preset("lite"), ["seed=3", *(f"{k}={v}" for k, v in SETTINGS.items())])
    assert saved != load_preset("lite")


def test_evo_finds_the_same_error(finished):
    metrics = pytest.importorskip("evo.core.metrics")
    from evo.core.sync import associate_trajectories
    from evo.tools.file_interface import read_tum_trajectory_file

    truth, ours = (read_tum_trajectory_file(str(finished / f"{n}.txt")) for n in ("groundtruth", "trajectory"))
    truth, ours = associate_trajectories(truth, ours)
    ours.align(truth)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((truth, ours))
    assert summary(finished)["ate_rmse_cm"] == pytest.approx(100 * ape.get_statistic(metrics.StatisticsType.rmse), 0.01)


@pytest.mark.slow
def test_same_seed_gives_the_same_bytes(finished, sequence, tmp_path):
    assert ecslam(*run_words(sequence, tmp_path / "again")).code == 0
    assert (tmp_path / "again" / "trajectory.txt").read_bytes() == (finished / "trajectory.txt").read_bytes()


@pytest.mark.slow
def test_eval_finds_a_mesh_equal_to_itself(finished, sequence, tmp_path):
    room, folder = shutil.copytree(sequence, tmp_path / "room"), shutil.copytree(finished, tmp_path / "run")
    shutil.copy(folder / "mesh.ply", room / "mesh.ply")
    about = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps(about | {"sequence": str(room)}))
    before = summary(folder)
    done = ecslam("eval", folder)
    assert done.code == 0, done.err
    after = summary(folder)
    assert after.keys() >= SUMMARY_KEYS | EVALUATED_KEYS
    assert after["ate_rmse_cm"] == pytest.approx(before["ate_rmse_cm"])
    assert max(after["accuracy_cm"], after["completion_cm"]) < 0.6  # the distance between two samplings of one surface
    assert after["completion_ratio"] > 99.9
    assert "completion_ratio" in done.out


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("summary.json", ["summary.json: cannot be read", "ecslam resume"]),
        ("run.json", ["run.json: missing or damaged"]),
    ],
)
def test_eval_names_the_file_that_is_damaged(finished, tmp_path, name, says):
    folder = shutil.copytree(finished, tmp_path / "run")
    (folder / name).write_text((folder / name).read_text()[:40])
    assert_refused(ecslam("eval", folder), *says)


@pytest.mark.parametrize("lacking", ["surface", "mesh", "sequence"])
def test_eval_gives_the_trajectory_where_there_is_no_surface_to_compare(finished, tmp_path, lacking):
    folder = shutil.copytree(finished, tmp_path / "run")
    if lacking == "surface":
        (folder / "mesh.ply").write_bytes(mesh_bytes(EMPTY, "ply"))
    elif lacking == "mesh":
        (folder / "mesh.ply").unlink()
    else:
        about = json.loads((folder / "run.json").read_text())
        (folder / "run.json").write_text(json.dumps(about | {"sequence": "/nowhere"}))
    done = ecslam("eval", folder)
    assert done.code == 0, done.err
    assert "ate_rmse_cm" in done.out
    assert "depth_l1_cm" not in done.out
    assert "the trajectory's figures only" in done.out
    assert ("/nowhere: no such folder" if lacking == "sequence" else "the map has no surface") in done.out


def test_eval_says_at_once_that_a_mesh_is_damaged(finished, tmp_path, monkeypatch):
    folder = shutil.copytree(finished, tmp_path / "run")
    (folder / "mesh.ply").write_bytes((folder / "mesh.ply").read_bytes()[:-7])
    monkeypatch.setattr("ecslam.datasets.files.FileSequence.reference_mesh", pytest.fail)
    assert_refused(ecslam("eval", folder), "mesh.ply: not a readable mesh", f"make it with: ecslam mesh {folder}")


def test_eval_prints_its_figures_where_the_summary_cannot_be_written(finished, tmp_path, monkeypatch):
    folder = shutil.copytree(finished, tmp_path / "run")
    (folder / "mesh.ply").unlink()
    before = summary(folder)

    def refuse(*_):
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(os, "fsync", refuse)
    done = ecslam("eval", folder)
    assert done.code == 0, done.err
    assert "ate_rmse_cm" in done.out
    assert "could not be written into" in done.out
    assert "summary.json (Read-only file system)" in done.out
    assert summary(folder) == before


def test_mesh_is_made_again_at_another_size(finished, tmp_path):
    sizes = []
    for voxel in (0.04, 0.08):
        done = ecslam("mesh", finished, "--voxel", voxel, "--out", tmp_path / f"{voxel}.ply")
        assert done.code == 0, done.err
        sizes.append(len(load_mesh(tmp_path / f"{voxel}.ply").faces))
    assert sizes[0] > 2 * sizes[1] > 0


def test_a_full_disk_at_the_picture_is_a_warning(finished, tmp_path, capsys, monkeypatch):
    folder = shutil.copytree(finished, tmp_path / "run", ignore=shutil.ignore_patterns("picture.png"))

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    reports.finish_run(folder, summary(folder))
    said = capsys.readouterr().out
    assert "warning: picture.png was not made: [Errno 28] No space left on device" in said
    assert str(folder / "summary.json") in said
    assert not (folder / "picture.png").exists()


def test_the_picture_numbers_frames_as_the_dashboard_does(finished, tmp_path, monkeypatch):
    folder, numbers = shutil.copytree(finished, tmp_path / "run"), []
    rows = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    skipped = [{**row, "frame": row["frame"] + (row["frame"] > 3)} for row in rows]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in skipped))
    monkeypatch.setattr(plots, "plot_run", lambda *given: numbers.append(given[-1]))
    draw_picture(folder)
    (folder / "metrics.jsonl").unlink()
    draw_picture(folder)
    assert numbers[0].tolist() == [0, 1, 2, 3, 5, 6, 7, 8]
    assert numbers[1] is None, "of a run whose rows could not be saved"


def test_a_run_without_a_surface_ends_without_a_picture(finished, tmp_path):
    folder = shutil.copytree(finished, tmp_path / "run", ignore=shutil.ignore_patterns("picture.png"))
    (folder / "mesh.ply").write_bytes(mesh_bytes(EMPTY, "ply"))
    assert draw_picture(folder) is None
    assert not (folder / "picture.png").exists()


# ---- wrong inputs ---------------------------------------------------------------------------------------------------


def test_an_empty_folder(tmp_path):
    assert_refused(ecslam("run", tmp_path, "--headless"), str(tmp_path), "empty folder")


def test_a_folder_of_no_known_layout(tmp_path):
    (tmp_path / "holiday.mp4").write_bytes(b"")
    outcome = ecslam("run", tmp_path, "--headless")
    assert_refused(outcome, str(tmp_path), "no known layout", "holiday.mp4", "TUM RGB-D", "7-Scenes")


def test_a_missing_depth_image(sequence, tmp_path):
    broken = shutil.copytree(sequence, tmp_path / "room")
    (broken / "results" / "depth000003.png").unlink()
    outcome = ecslam("run", broken, "--headless", "--out", tmp_path / "run")
    assert_refused(outcome, str(broken), "000003", "depth image")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        (["--set", "mapping.iteration=3"], ["mapping.iteration'", "did you mean 'mapping.iterations'"]),
        (["--set", "mapping.iterations"], ["key=value"]),
        (["--set", "mapping.iterations=many"], ["mapping.iterations", "whole number"]),
        (["--set", "mapping.rays=1"], ["mapping.rays", "out of range"]),
        (["--preset", "ful"], ["'ful'", "did you mean 'full'"]),
        (["--config", "nowhere.yaml"], ["nowhere.yaml", "cannot be read"]),
        (["--schedule", "loose"], ["error: --schedule", "strict", "overlap"]),
        (["--frames", "8"], ["--frames 8", "A:B"]),
        (["--frames", "90:99"], ["selects nothing", "0 .. 7"]),
        (["--frames", "5:0:-1"], ["--frames 5:0:-1", "STEP"]),
        (["--device", "tpu9"], ["--device tpu9", "cpu, cuda"]),
        (["--device", "meta"], ["--device meta", "cpu, cuda"]),
        (["--device", "mps"], ["--device mps", "cpu, cuda"]),
    ],
)
def test_a_wrong_option(sequence, tmp_path, words, parts):
    assert_refused(ecslam("run", sequence, "--headless", "--out", tmp_path / "run", *words), *parts)
    assert not (tmp_path / "run").exists()


def test_a_file_for_another_preset_than_the_one_asked_for(sequence, tmp_path):
    (tmp_path / "mine.yaml").write_text("preset: full")
    words = ["run", sequence, "--headless", "--out", tmp_path / "run", "--config", tmp_path / "mine.yaml"]
    assert_refused(ecslam(*words, "--preset", "lite"), "mine.yaml", "is for preset full, not lite")


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU here")
def test_a_gpu_that_is_not_there(sequence, tmp_path):
    outcome = ecslam("run", sequence, "--headless", "--device", "cuda", "--out", tmp_path / "run")
    assert_refused(outcome, "--device cuda", "--device cpu")


def test_a_gpu_beyond_those_that_are_there(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert [commands.pick_device(name) for name in ("cuda", "cuda:1", "cpu:3")] == ["cuda", "cuda:1", "cpu"]
    with pytest.raises(InputError, match=r"--device cuda:9: no such GPU; the last one .* is cuda:1"):
        commands.pick_device("cuda:9")


@pytest.mark.parametrize(
    ("free", "device", "says"),
    [
        (lambda: (8e9, 9e9), "cuda", ""),
        (lambda: (2e8, 9e9), "cpu", "200 MB free on the GPU"),
        (mock.Mock(side_effect=RuntimeError("CUDA driver is too old\nmore")), "cpu", "CUDA driver is too old"),
    ],
)
def test_an_automatic_choice_falls_back_to_the_cpu(monkeypatch, capsys, free, device, says):
    monkeypatch.setattr(commands, "_may_have_cuda", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "mem_get_info", free)
    assert commands.pick_device("auto", load_preset("lite")) == device
    out = capsys.readouterr().out
    assert says in out
    assert bool(out) == bool(says)


@pytest.mark.parametrize("command", ["eval", "mesh", "resume"])
def test_a_folder_that_holds_no_run(command, tmp_path):
    assert_refused(ecslam(command, tmp_path), str(tmp_path))


@pytest.mark.parametrize("command", ["mesh", "resume"])
def test_a_folder_that_is_not_there(command, tmp_path):
    assert_refused(ecslam(command, tmp_path / "nowhere"), str(tmp_path / "nowhere"), "no such folder")


def test_mesh_of_a_run_without_its_description(finished, tmp_path):
    folder = shutil.copytree(finished, tmp_path / "run", ignore=shutil.ignore_patterns("run.json"))
    assert_refused(ecslam("mesh", folder), "run.json: missing or damaged")


def test_a_folder_with_other_things_in_it_is_not_written_to(sequence, tmp_path):
    (tmp_path / "thesis.tex").write_text("precious")
    assert_refused(ecslam("run", sequence, "--headless", "--out", tmp_path), str(tmp_path), "--out")
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_busy_port_is_found_before_a_run_is_replaced(sequence, finished, tmp_path):
    kept = shutil.copytree(finished, tmp_path / "run")
    before = sorted(p.name for p in kept.rglob("*"))
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        for words in (("run", sequence, "--out", kept), ("resume", kept)):
            assert_refused(ecslam(*words, "--no-browser", "--port", port), f"--port {port}", "cannot listen there")
    assert sorted(p.name for p in kept.rglob("*")) == before


def test_unknown_rooms_and_mesh_formats(finished, tmp_path):
    assert_refused(ecslam("check", "synthetic/studo"), "did you mean synthetic/studio")
    assert_refused(ecslam("synth", "studio", tmp_path / "x"), "synthetic/studio")
    assert_refused(ecslam("mesh", finished, "--out", tmp_path / "mesh.stl"), "mesh.stl", ".ply")
    assert_refused(ecslam("mesh", finished, "--out", tmp_path / "no" / "mesh.ply"), "there is no folder", "no")


@pytest.mark.parametrize(
    "words",
    [["kernels", "--json"], ["speed", "--json"], ["speed", "--plot"], ["viewers", "--json"], ["accuracy", "--json"]],
)
def test_where_results_cannot_go_is_found_before_a_benchmark_runs(tmp_path, words):
    assert_refused(ecslam("bench", *words, tmp_path / "none/x"), f"{words[1]} {tmp_path / 'none/x'}", "no folder")
    assert_refused(ecslam("bench", *words, tmp_path), f"{words[1]} {tmp_path}: a folder", "name of a file")


@pytest.mark.parametrize(
    ("words", "named"), [(["speed", "--repeats", 2], "live, lite"), (["accuracy", "--seeds", 2], "lite")]
)
def test_a_benchmark_without_a_run_that_works_is_an_error(tmp_path, monkeypatch, words, named):
    for module in (accuracy, speed):
        monkeypatch.setattr(module, "in_own_process", lambda *_: {"error": "the map exploded"})
    done = ecslam("bench", *words, "--device", "cpu", "--json", tmp_path / "figures.json")
    assert done.code == 2
    assert "error: every run failed" in done.err
    assert done.out.splitlines() == [
        f"{name}: 2 of 2 runs failed, the first because: the map exploded" for name in named.split(", ")
    ]
    assert "the map exploded" in (tmp_path / "figures.json").read_text()


def test_a_mesh_for_a_folder_that_takes_no_files_is_refused_before_it_is_made(finished, tmp_path, monkeypatch):
    real = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: not mode & os.W_OK and real(path, mode))
    monkeypatch.setattr(commands, "build_mesh", pytest.fail)
    assert_refused(ecslam("mesh", finished), f"--out {finished / 'mesh.ply'}", f"cannot write in {finished}")
    monkeypatch.undo()

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    outcome = ecslam("mesh", finished, "--voxel", 0.2, "--out", tmp_path / "m.ply")
    assert_refused(outcome, "m.ply: cannot be written (No space left on device)")


def test_the_default_folder_is_a_new_one(tmp_path):
    assert commands.unused(tmp_path / "room-live") == tmp_path / "room-live"
    (tmp_path / "room-live").mkdir()
    assert commands.unused(tmp_path / "room-live") == tmp_path / "room-live-2"


def test_a_demo_keeps_the_one_before(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("runs/demo").mkdir(parents=True)
    with mock.patch.object(cli, "run") as run:
        assert ecslam("demo", "--headless").code == 0
        assert ecslam("demo", "--headless", "--out", "here").code == 0
    assert [call.kwargs["out"] for call in run.call_args_list] == [Path("runs/demo-2"), Path("here")]


def test_the_installed_command_refuses_without_a_traceback(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "ecslam", "check", str(tmp_path)], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert_refused(Outcome(done.returncode, done.stdout, done.stderr), "empty folder")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full here")
def test_an_output_that_takes_nothing_is_an_error_in_a_line():
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "ecslam", "check", f"{ROOM}&frames=2"]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr == "note: the output takes no more (No space left on device); nothing more is printed\n"


def test_help_names_every_command():
    text = ecslam("--help").out
    for command in ("run", "demo", "resume", "view", "eval", "mesh", "synth", "check", "bench"):
        assert f" {command} " in text


@pytest.mark.parametrize("command", ["run", "synth"])
def test_help_names_every_room(command):
    text = re.sub(r"\W+", " ", ecslam(command, "--help").out)
    assert all(f"synthetic {room}" in text for room in ROOMS)


@pytest.mark.parametrize("words", [["run"], ["eval"], ["bench", "speed", "--frames"]])
def test_what_is_missing_is_named(words):
    outcome = ecslam(*words)
    assert outcome.code == 2
    assert re.search("missing argument|requires an argument", outcome.err, re.I), outcome.err


@pytest.mark.slow
def test_a_run_whose_sequence_has_moved_goes_on_where_it_is_now(sequence, tmp_path):
    words = run_words(shutil.copytree(sequence, tmp_path / "room"), tmp_path / "run")
    assert ecslam(*words, "--frames", "0:3").code == 0
    (tmp_path / "run" / "summary.json").unlink()
    (tmp_path / "room").rename(tmp_path / "elsewhere")
    assert_refused(ecslam("resume", tmp_path / "run", "--headless"), str(tmp_path / "room"), "--sequence")
    done = ecslam("resume", tmp_path / "run", "--headless", "--sequence", tmp_path / "elsewhere")
    assert done.code == 0, done.err
    assert summary(tmp_path / "run")["frames"] == 3
    assert json.loads((tmp_path / "run" / "run.json").read_text())["sequence"] == str(tmp_path / "elsewhere")


@pytest.mark.slow
def test_a_run_can_be_judged_from_another_folder(sequence, tmp_path, monkeypatch):
    monkeypatch.chdir(sequence.parent)
    assert ecslam(*run_words(Path(sequence.name), tmp_path / "run"), "--frames", "0:2").code == 0
    assert json.loads((tmp_path / "run" / "run.json").read_text())["sequence"] == str(sequence)
