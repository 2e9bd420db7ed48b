"""Files: atomic replacement, whole lines, run folders, meshes and trajectories that other programs read."""

import errno
import json
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
import trimesh

from ecslam.atomic import write_atomic
from ecslam.datasets.meshes import NoSurface, load_mesh
from ecslam.messages import Notice
from ecslam.runtime import files
from ecslam.runtime.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from ecslam.runtime.files import LineLog, keep_lines, read_lines, require_space, to_json
from ecslam.runtime.mesh_files import mesh_bytes
from ecslam.runtime.runfolder import CAMERA, RunFolder, read_about
from ecslam.types import InputError, Mesh

ABOUT = {"sequence": "room", "frames": "", "frames_total": 3, **dict.fromkeys(CAMERA, 9)}
FULL = OSError(errno.ENOSPC, "No space left on device")


def full(*_):
    raise FULL


def test_write_atomic_keeps_the_old_file_when_the_disk_is_full(tmp_path, monkeypatch):
    path = tmp_path / "a"
    write_atomic(path, b"old")
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        write_atomic(path, b"new")
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["a"]


def test_a_line_is_written_whole_or_not_at_all(tmp_path, monkeypatch):
    log = LineLog(tmp_path / "log")
    log.append({"frame": 0})
    real = os.write
    monkeypatch.setattr(os, "write", lambda fd, data: real(fd, data[:5]))
    with pytest.raises(OSError, match="No space"):
        log.append({"frame": 1})
    monkeypatch.setattr(os, "write", real)
    log.append({"frame": 2})
    log.close()
    assert (tmp_path / "log").read_text() == '{"frame":0}\n{"frame":2}\n'


def test_a_torn_last_line_is_left_out(tmp_path):
    path = tmp_path / "log"
    path.write_text('{"frame":0}\n{"frame":1}\n{"fra')
    assert [line["frame"] for line in read_lines(path)] == [0, 1]
    keep_lines(path, lambda line: line["frame"] < 1)
    assert path.read_text() == '{"frame":0}\n'
    assert list(read_lines(tmp_path / "none")) == []


def test_json_is_strict_and_takes_numpy():
    value = {"a": np.float32(0.5), "b": np.arange(2), "c": [float("nan"), np.inf], 3: (True, None)}
    assert json.loads(to_json(value), parse_constant=pytest.fail) == {
        "a": 0.5, "b": [0, 1], "c": [None, None], "3": [True, None]
    }  # fmt: skip


def test_an_unwritable_folder_and_a_full_disk_are_one_clear_line(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match=r"cannot write there.*--out"):
        require_space(tmp_path / "file" / "run", 1)
    monkeypatch.setattr(files.shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10, 9, 2_000_000))
    with pytest.raises(InputError, match="2 MB free, but a run may need 500 MB"):
        require_space(tmp_path / "run", 500)


def test_to_go_on_takes_less_room_than_to_begin(tmp_path, monkeypatch):
    monkeypatch.setattr(files.shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(900, 423, 477_000_000))
    with pytest.raises(InputError, match="477 MB free, but a run may need 500 MB"):
        RunFolder.create(tmp_path, print)
    RunFolder.reopen(tmp_path, print).close()
    monkeypatch.setattr(files.shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(900, 850, 50_000_000))
    with pytest.raises(InputError, match="50 MB free, but a run may need 100 MB"):
        RunFolder.reopen(tmp_path, print)


def test_a_folder_with_other_peoples_files_is_refused(tmp_path):
    (tmp_path / "thesis.tex").write_text("x")
    with pytest.raises(InputError, match="holds other files and no run"):
        RunFolder.create(tmp_path, print)
    assert (tmp_path / "thesis.tex").exists()


def test_a_recording_is_not_taken_for_a_run(tmp_path):
    """It may hold files of the same names."""
    for name in ("groundtruth.txt", "mesh.ply", "rgb.txt"):
        (tmp_path / name).write_text("theirs")
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes/mine.ply").write_text("theirs")
    with pytest.raises(InputError, match="holds other files and no run"):
        RunFolder.create(tmp_path, print)
    assert [p.read_text() for p in sorted(tmp_path.rglob("*.*"))] == ["theirs"] * 4


def test_a_run_that_ended_before_it_began_is_replaced(tmp_path):
    RunFolder.create(tmp_path, print).close()
    RunFolder.create(tmp_path, print).close()


HOLD = """
import sys
from pathlib import Path
from ecslam.runtime.runfolder import CAMERA, RunFolder
folder = RunFolder.create(Path(sys.argv[1]), print)
folder.write("run.json", {"sequence": "room", "frames": "", "frames_total": 3, **dict.fromkeys(CAMERA, 9)})
print("held", flush=True)
sys.stdin.read()
"""


def test_one_process_at_a_time_writes_a_folder(tmp_path):
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout.readline() == "held\n"
        for begin in (lambda: RunFolder.create(tmp_path, print), lambda: RunFolder.reopen(tmp_path, print)):
            with pytest.raises(InputError, match=rf"at work there \(process {other.pid}\); .* ecslam run --out"):
                begin()
        assert (tmp_path / "run.json").exists()
        other.kill()
    RunFolder.reopen(tmp_path, print).close()


@pytest.mark.parametrize(
    "content",
    [
        *(None, "{", "[1]", '{"sequence": "room", "frames_total": 3}'),
        *(to_json(ABOUT | wrong) for wrong in ({"frames": 7}, {"width": "9"}, {"fx": None})),
    ],
)
def test_a_run_whose_description_is_damaged_is_one_clear_line(tmp_path, content):
    if content is not None:
        (tmp_path / "run.json").write_text(content)
    with pytest.raises(InputError, match=r"run.json: missing or damaged; start again with ecslam run"):
        read_about(tmp_path)


def test_a_new_run_replaces_the_old_one_and_nothing_else(tmp_path):
    folder = RunFolder.create(tmp_path / "r", print)
    folder.write("run.json", ABOUT)
    folder.write("summary.json", {"frames": 1})
    folder.write("picture.png", b"old")
    folder.write("exports/mesh.ply", b"kept")
    folder.event(Notice("info", "old"))
    folder.close()
    RunFolder.create(tmp_path / "r", print).close()
    assert not (tmp_path / "r/summary.json").exists()
    assert not (tmp_path / "r/picture.png").exists()
    assert (tmp_path / "r/events.jsonl").read_text() == ""
    assert (tmp_path / "r/exports/mesh.ply").read_bytes() == b"kept"


def test_a_new_run_empties_a_linked_folder_and_stays_in_it(tmp_path):
    for name in ("r", "large"):
        (tmp_path / name).mkdir()
    (tmp_path / "r/run.json").write_text(to_json(ABOUT))
    (tmp_path / "r/checkpoints").symlink_to(tmp_path / "large")
    save_checkpoint(tmp_path / "r/checkpoints", Checkpoint(30, {}))
    RunFolder.create(tmp_path / "r", print).close()
    save_checkpoint(tmp_path / "r/checkpoints", Checkpoint(12, {}))
    assert load_checkpoint(tmp_path / "r/checkpoints").frame == 12
    assert (tmp_path / "large/000012.json").is_file()


@pytest.mark.parametrize("name", ["picture.png", "checkpoints/000030.json", "meshes/000001.ply"])
def test_a_run_that_cannot_be_removed_is_not_mixed_with_a_new_one(tmp_path, name):
    (tmp_path / "run.json").write_text(to_json(ABOUT))
    (tmp_path / name).mkdir(parents=True)
    with pytest.raises(InputError, match=rf"{name}: cannot be removed for a new run \(.*\); remove it, or .* --out"):
        RunFolder.create(tmp_path, print)


def test_what_could_not_be_saved_is_said_once_and_forgotten_when_it_is(tmp_path, monkeypatch):
    said = []
    folder = RunFolder.create(tmp_path, said.append)
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        assert folder.write("mesh.ply", b"1") is None
        assert folder.write("mesh.ply", b"2") is None
    assert len(said) == 1
    assert "mesh.ply could not be saved (No space left on device)" in said[0]
    assert folder.not_saved == {"mesh.ply": "No space left on device"}
    assert folder.write("mesh.ply", b"3") == tmp_path / "mesh.ply"
    assert folder.not_saved == {}


def tetrahedron(colors: bool) -> Mesh:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)
    rgb = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [9, 8, 7]], np.uint8)
    return Mesh(vertices, faces, rgb if colors else None)


@pytest.mark.parametrize("form", ["ply", "glb", "obj"])
def test_trimesh_reads_back_geometry_and_vertex_colours(tmp_path, form):
    mesh = tetrahedron(True)
    (tmp_path / f"m.{form}").write_bytes(mesh_bytes(mesh, form))
    back = trimesh.load(tmp_path / f"m.{form}", force="mesh", process=False)
    assert np.allclose(back.vertices, mesh.vertices, atol=1e-6)
    assert np.array_equal(back.faces, mesh.faces)
    assert np.array_equal(back.visual.vertex_colors[:, :3], mesh.colors)
    assert back.volume == pytest.approx(1 / 6)


@pytest.mark.parametrize("points", [0, 3])
def test_points_without_triangles_are_no_surface(tmp_path, points):
    (tmp_path / "m.ply").write_bytes(mesh_bytes(Mesh(np.eye(3)[:points], np.zeros((0, 3), np.int32)), "ply"))
    with pytest.raises(NoSurface, match="without triangles"):
        load_mesh(tmp_path / "m.ply")


def test_ply_without_colours_and_without_triangles(tmp_path):
    (tmp_path / "m.ply").write_bytes(mesh_bytes(tetrahedron(False), "ply"))
    assert trimesh.load(tmp_path / "m.ply", process=False).visual.kind is None
    empty = Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    assert b"element face 0\n" in mesh_bytes(empty, "ply")
    with pytest.raises(InputError, match="there are ply, glb and obj"):
        mesh_bytes(empty, "stl")
