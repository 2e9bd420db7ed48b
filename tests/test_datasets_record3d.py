"""Record3D: frames, camera, poses and times of the file and the unzipped folder, and what is damaged in it."""

from __future__ import annotations

import json
import sys
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

lzfse = pytest.importorskip("lzfse")

import phone_video  # noqa: E402

from ecslam import cli  # noqa: E402
from ecslam.config_files import for_layout, load_preset  # noqa: E402
from ecslam.datasets import open_sequence, problems  # noqa: E402
from ecslam.datasets.agreement import odd_truth  # noqa: E402
from ecslam.datasets.check import check_sequence, format_report  # noqa: E402
from ecslam.datasets.roots import sequences_under  # noqa: E402
from ecslam.datasets.stray import finer  # noqa: E402
from ecslam.types import FrameError, InputError, Sequence  # noqa: E402

N = 8
ARKIT = "the ground truth is ARKit's estimate: a difference from it need not be an error"


@pytest.fixture(scope="module")
def fine() -> Sequence:
    return open_sequence(f"synthetic/studio?size=160x120&frames={N}")


@pytest.fixture(scope="module")
def coarse() -> Sequence:
    return open_sequence(f"synthetic/studio?size=40x30&frames={N}")


@pytest.fixture
def files(fine: Sequence, coarse: Sequence) -> dict[str, bytes]:
    return made(fine, coarse)


def made(fine: Sequence, coarse: Sequence, **more: Any) -> dict[str, bytes]:
    poses = fine.poses_gt()
    assert poses is not None
    matrix = more.pop("matrix", fine.intrinsics.matrix())
    return phone_video.parts(
        [f.color for f in fine], [f.depth for f in coarse], list(more.pop("given", poses)), matrix, **more
    )


def test_frames_are_those_of_the_room(
    tmp_path: Path, files: dict[str, bytes], fine: Sequence, coarse: Sequence
) -> None:
    for path in (tmp_path / "kitchen.r3d", tmp_path / "kitchen"):
        sequence = open_sequence(phone_video.write(path, files))
        assert (sequence.name, sequence.layout, sequence.preset, len(sequence)) == ("kitchen", "record3d", "lite", N)
        np.testing.assert_allclose(sequence.intrinsics.matrix(), fine.intrinsics.resized(80, 60).matrix())
        np.testing.assert_allclose(sequence.timestamps(), np.arange(N) / 30)
        np.testing.assert_allclose(sequence.poses_gt(), fine.poses_gt(), atol=1e-6)  # type: ignore[arg-type]
        assert problems(sequence) == [ARKIT]
        assert odd_truth(sequence) == ""
        for frame, source, original in zip(sequence, coarse, fine, strict=True):
            np.testing.assert_array_equal(frame.depth, finer(source.depth, (80, 60)))
            area = original.color.reshape(60, 2, 80, 2, 3).mean((1, 3))
            assert np.abs(frame.color - area).mean() < 3


def test_frames_come_in_any_order_and_to_many_threads(tmp_path: Path, files: dict[str, bytes]) -> None:
    sequence = open_sequence(phone_video.write(tmp_path / "a.r3d", files))
    alone = [frame.color for frame in sequence]
    order = [5, 0, 7, 7, 2, 6, 1, 3, 4, 0] * 4
    with ThreadPoolExecutor(8) as pool:
        for index, frame in zip(order, pool.map(sequence.__getitem__, order), strict=True):
            assert frame.index == index
            np.testing.assert_array_equal(frame.color, alone[index])


def test_depth_that_is_unknown_or_doubted_is_none(tmp_path: Path, files: dict[str, bytes]) -> None:
    depth, levels = np.full((30, 40), 2.0, np.float32), np.full((30, 40), 2, np.uint8)
    depth[0, 0], depth[0, 5], depth[0, 10] = np.nan, np.inf, -1
    levels[5, 7], levels[9, 3] = 0, 1
    files["rgbd/1.depth"], files["rgbd/1.conf"] = lzfse.compress(depth.tobytes()), lzfse.compress(levels.tobytes())
    found = open_sequence(phone_video.write(tmp_path / "a.r3d", files))[1].depth
    missing = {(y // 2, x // 2) for y, x in np.argwhere(found == 0).tolist()}
    assert missing == {(0, 0), (0, 5), (0, 10), (5, 7)}


def test_a_face_camera_has_no_poses_no_confidence_and_colour_as_fine_as_depth(tmp_path: Path, coarse: Sequence) -> None:
    files = made(coarse, coarse, given=[phone_video.OPENGL] * N, cameraType=0)
    files = {name: data for name, data in files.items() if not name.endswith(".conf")}
    sequence = open_sequence(phone_video.write(tmp_path / "a.r3d", files))
    assert sequence.poses_gt() is None
    np.testing.assert_array_equal(sequence[3].depth, coarse[3].depth)
    found = " ".join(problems(sequence))
    assert "each of its poses is the identity" in found
    assert "no confidence" in found
    assert "ARKit" not in found


def test_metadata_of_each_frame_count(tmp_path: Path, fine: Sequence, coarse: Sequence) -> None:
    lens = [[100 + 2 * i, 101 + 2 * i, 80, 60] for i in range(N)]
    times = [0.5 + 0.04 * i for i in range(N)]
    files = made(fine, coarse, perFrameIntrinsicCoeffs=lens, frameTimestamps=times)
    del files["rgbd/2.depth"], files["rgbd/5.jpg"]
    sequence = open_sequence(phone_video.write(tmp_path / "a.r3d", files))
    kept = [0, 1, 3, 4, 6, 7]
    assert sequence.intrinsics.fx == 107 / 2
    np.testing.assert_allclose(sequence.timestamps(), np.array(times)[kept])
    truth = fine.poses_gt()
    assert truth is not None
    np.testing.assert_allclose(sequence.poses_gt(), truth[kept], atol=1e-6)  # type: ignore[arg-type]
    found = " ".join(problems(sequence))
    assert "autofocus moves the focal length by 12.3%" in found
    assert "1 depth images have no picture" in found


def test_damaged_and_missing_poses_cost_no_more_than_themselves(
    tmp_path: Path, fine: Sequence, files: dict[str, bytes]
) -> None:
    about = json.loads(files["metadata"])
    about["poses"][2][:4] = [0, 0, 0, 0]
    about["poses"] = about["poses"][:6]
    files["metadata"] = json.dumps(about).encode()
    sequence = open_sequence(phone_video.write(tmp_path / "a.r3d", files))
    assert [frame.c2w_gt is None for frame in sequence] == [i in (2, 6, 7) for i in range(N)]
    assert any("3 frames have no ground truth" in each for each in problems(sequence))
    about["poses"] = []
    files["metadata"] = json.dumps(about).encode()
    assert open_sequence(phone_video.write(tmp_path / "b.r3d", files)).poses_gt() is None


def test_each_file_in_a_folder_is_a_sequence(tmp_path: Path, files: dict[str, bytes]) -> None:
    for name in ("phone/a.r3d", "phone/b.r3d", "phone/c"):
        phone_video.write(tmp_path / name, files)
    found = sequences_under(tmp_path)
    assert [open_sequence(each).name for each in found] == ["a", "b", "c"]


# ---- what cannot be used ----


def test_without_the_codec_it_says_what_to_install(
    tmp_path: Path, files: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = phone_video.write(tmp_path / "a.r3d", files)
    monkeypatch.setitem(sys.modules, "lzfse", None)
    with pytest.raises(InputError, match="pip install lzfse"):
        open_sequence(file)


@pytest.mark.parametrize("data", [b"", b"PK\x03\x04", b"REDV" * 100])
def test_a_file_that_is_no_zip_is_refused(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "a.r3d").write_bytes(data)
    with pytest.raises(InputError, match=r"a\.r3d: not a recording of Record3D"):
        open_sequence(tmp_path / "a.r3d")


def test_a_truncated_file_is_refused(tmp_path: Path, files: dict[str, bytes]) -> None:
    file = phone_video.write(tmp_path / "a.r3d", files)
    file.write_bytes(file.read_bytes()[:-500])
    with pytest.raises(InputError, match="truncated one; export it again"):
        open_sequence(file)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"K": [1, 2, 3]}, "not as the app writes it"),
        ({"K": None}, "KeyError"),
        ({"K": [0] * 9}, "intrinsics"),
        ({"w": "wide"}, "not as the app writes it"),
        ({"w": 0}, "out of range"),
        ({"dw": 10**9}, "out of range"),
        ({"dw": 30}, "different shapes"),
        ({"fps": 0}, "out of range"),
        ({"poses": [[1, 2]]}, "not as the app writes it"),
        ({"poses": 5}, "not as the app writes it"),
        ({"frameTimestamps": {"a": 1}}, "not as the app writes it"),
    ],
)
def test_metadata_that_cannot_be_used_are_refused(
    tmp_path: Path, files: dict[str, bytes], change: dict[str, Any], says: str
) -> None:
    about = {**json.loads(files["metadata"]), **change}
    files["metadata"] = json.dumps({k: v for k, v in about.items() if v is not None}).encode()
    with pytest.raises(InputError, match=says) as caught:
        open_sequence(phone_video.write(tmp_path / "a.r3d", files))
    assert "a.r3d" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", [b"", b"{", b"[]", b"[" * 100_000, b"\xff\xfe"])
def test_metadata_that_are_no_json_are_refused(tmp_path: Path, files: dict[str, bytes], text: bytes) -> None:
    files["metadata"] = text
    for path in (tmp_path / "a.r3d", tmp_path / "a"):
        with pytest.raises(InputError, match="metadata"):
            open_sequence(phone_video.write(path, files))


def test_a_recording_without_frames_or_metadata_is_refused(tmp_path: Path, files: dict[str, bytes]) -> None:
    about = {"metadata": files["metadata"]}
    with pytest.raises(InputError, match="no frame has both"):
        open_sequence(phone_video.write(tmp_path / "a.r3d", about))
    del files["metadata"]
    with pytest.raises(InputError, match="no readable metadata"):
        open_sequence(phone_video.write(tmp_path / "b.r3d", files))


@pytest.mark.parametrize(
    ("name", "data", "says"),
    [
        ("jpg", b"", "neither PNG nor JPEG|empty file"),
        ("jpg", b"\xff\xd8" + bytes(500), "header"),
        ("depth", b"", "damaged|empty file"),
        ("depth", b"bvx2", "damaged"),
        ("depth", b"no LZFSE at all", "damaged"),
        ("depth", lzfse.compress(np.ones((30, 40), np.float32).tobytes())[:-20], "damaged"),
        ("depth", lzfse.compress(bytes(4796)), "holds 4796 bytes, not the 4800"),
        ("depth", lzfse.compress(bytes(50 << 20)), "damaged"),
        ("depth", b"bvx2" + b"\xff" * 60, "damaged"),
        ("depth", bytes(1 << 20), "damaged"),
        ("conf", b"nothing", "damaged"),
        ("conf", None, "missing or damaged|cannot be read"),
    ],
)
def test_a_damaged_part_costs_its_own_frame(
    tmp_path: Path, files: dict[str, bytes], name: str, data: bytes | None, says: str
) -> None:
    files[f"rgbd/3.{name}"] = data or b""
    if data is None:
        del files[f"rgbd/3.{name}"]
    for path in (tmp_path / "a.r3d", tmp_path / "a"):
        sequence = open_sequence(phone_video.write(path, files))
        with pytest.raises(FrameError, match=says) as caught:
            sequence[3]
        assert f"rgbd/3.{name}" in str(caught.value)
        assert sequence[4].index == 4


def test_a_damaged_zip_costs_the_frame_that_it_hits(tmp_path: Path, files: dict[str, bytes]) -> None:
    file = phone_video.write(tmp_path / "a.r3d", files)
    with zipfile.ZipFile(file) as archive:
        at = archive.getinfo("rgbd/3.jpg").header_offset
    data = bytearray(file.read_bytes())
    data[at + 200 : at + 260] = bytes(60)
    file.write_bytes(data)
    sequence = open_sequence(file)
    with pytest.raises(FrameError, match=r"rgbd/3\.jpg"):
        sequence[3]
    assert sequence[4].index == 4


# ---- as a whole ----


def test_a_check_reads_well(tmp_path: Path, files: dict[str, bytes]) -> None:
    text = format_report(check_sequence(phone_video.write(tmp_path / "kitchen.r3d", files)))
    assert "kitchen (record3d layout, preset lite)" in text
    assert text.endswith(ARKIT)


def test_depth_beyond_a_phones_reach_is_left_out() -> None:
    assert for_layout(load_preset("live"), "record3d").depth_far_m == 5.0


@pytest.mark.slow
def test_a_run_on_a_file_follows_the_camera(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rooms = [open_sequence(f"synthetic/studio?size={size}&frames=12") for size in ("320x240", "80x60")]
    phone_video.write(tmp_path / "kitchen.r3d", made(*rooms))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["ecslam", "run", "kitchen.r3d", "--preset", "live", "--headless"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert not ended.value.code
    summary = json.loads((tmp_path / "runs/kitchen-live/summary.json").read_text())
    assert (summary["sequence"], summary["frames"]) == ("kitchen", 12)
    assert summary["ate_rmse_cm"] < 2
