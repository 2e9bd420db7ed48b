"""ATE and RPE: their laws, and evo as an outside oracle. Trajectory files: round trips and clear refusals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ecslam.evaluation.trajectory import Similarity, absolute_error, align_umeyama, find_lag, relative_error
from ecslam.evaluation.trajectory_io import format_kitti, format_tum, read_tum
from ecslam.types import InputError

SEEDS = st.integers(0, 2**32 - 1)


def random_motion(rng: np.random.Generator) -> Similarity:
    return Similarity(Rotation.random(random_state=int(rng.integers(2**31))).as_matrix(), rng.normal(size=3) * 5)


def trajectories(seed: int, n: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """A smooth true path and a noisy estimate of it in another world."""
    rng = np.random.default_rng(seed)
    truth, estimate = np.tile(np.eye(4), (2, n, 1, 1))
    turns = np.cumsum(rng.normal(size=(n, 3)) * 0.05, 0)
    truth[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
    truth[:, :3, 3] = np.cumsum(rng.normal(size=(n, 3)) * 0.03, 0)
    estimate[:, :3, :3] = truth[:, :3, :3] @ Rotation.from_rotvec(rng.normal(size=(n, 3)) * 0.01).as_matrix()
    estimate[:, :3, 3] = truth[:, :3, 3] + rng.normal(size=(n, 3)) * 0.01
    return random_motion(rng).apply_to_poses(estimate), truth


@settings(max_examples=30)
@given(SEEDS)
def test_a_rigid_motion_of_either_side_changes_nothing(seed: int) -> None:
    estimate, truth = trajectories(seed)
    rng = np.random.default_rng(seed + 1)
    first = absolute_error(estimate, truth)
    moved = absolute_error(random_motion(rng).apply_to_poses(estimate), random_motion(rng).apply_to_poses(truth))
    assert first is not None
    assert moved is not None
    np.testing.assert_allclose(moved.errors_cm, first.errors_cm, atol=1e-8)
    relative, relative_moved = (
        relative_error(estimate, truth),
        relative_error(random_motion(rng).apply_to_poses(estimate), truth),
    )
    assert relative is not None
    assert relative_moved is not None
    assert relative_moved.cm.rmse == pytest.approx(relative.cm.rmse, rel=1e-8)
    assert relative_moved.deg.rmse == pytest.approx(relative.deg.rmse, rel=1e-6)


@settings(max_examples=30)
@given(SEEDS, st.floats(0.1, 10))
def test_alignment_finds_the_motion_back(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    points, motion = rng.normal(size=(20, 3)), random_motion(rng)
    motion = Similarity(motion.rotation, motion.translation, scale)
    found = align_umeyama(points, motion.apply(points), with_scale=True)
    np.testing.assert_allclose(found.rotation, motion.rotation, atol=1e-9)
    np.testing.assert_allclose(found.translation, motion.translation, atol=1e-8)
    assert found.scale == pytest.approx(scale)


@settings(max_examples=20)
@given(SEEDS)
def test_no_other_motion_is_better(seed: int) -> None:
    estimate, truth = trajectories(seed)
    best = absolute_error(estimate, truth)
    assert best is not None
    nudge = Similarity(Rotation.from_rotvec([1e-3, -2e-3, 1e-3]).as_matrix(), np.array([1e-3, 0, -1e-3]))
    worse = absolute_error(nudge.apply_to_poses(best.alignment.apply_to_poses(estimate)), truth, align=False)
    assert worse is not None
    assert worse.cm.rmse > best.cm.rmse


@pytest.mark.parametrize("points", [np.zeros((1, 3)), np.ones((4, 3)), np.arange(5)[:, None] * [1.0, 2.0, 3.0]])
def test_degenerate_points_still_align_by_a_rotation(points: np.ndarray) -> None:
    moved = points + np.array([1.0, 0, 0])
    found = align_umeyama(points, moved)
    np.testing.assert_allclose(found.apply(points), moved, atol=1e-12)
    assert np.linalg.det(found.rotation) == pytest.approx(1)


def test_a_mirrored_path_is_not_explained_by_a_mirror() -> None:
    _, truth = trajectories(3)
    mirrored = truth.copy()
    mirrored[:, 0, 3] *= -1
    result = absolute_error(mirrored, truth)
    assert result is not None
    assert np.linalg.det(result.alignment.rotation) == pytest.approx(1)
    assert result.cm.rmse > 1


def test_frames_without_a_pose_are_left_out_and_counted() -> None:
    estimate, truth = trajectories(0)
    holes = truth.copy()
    holes[[4, 17]] = np.nan
    holes[30, 0, 3] = np.inf
    result = absolute_error(estimate, holes)
    keep = np.setdiff1d(np.arange(60), [4, 17, 30])
    without = absolute_error(estimate[keep], truth[keep])
    assert result is not None
    assert without is not None
    assert result.left_out == 3
    assert result.cm == without.cm
    assert np.flatnonzero(np.isnan(result.errors_cm)).tolist() == [4, 17, 30]
    relative = relative_error(estimate, holes)
    assert relative is not None
    assert relative.left_out == 6
    assert absolute_error(estimate, np.full_like(truth, np.nan)) is None
    assert relative_error(estimate[:1], truth[:1]) is None


def test_relative_error_of_a_known_slip() -> None:
    truth = np.tile(np.eye(4), (10, 1, 1))
    estimate = truth.copy()
    estimate[6:, 0, 3] = 0.03
    estimate[6:, :3, :3] = Rotation.from_euler("z", 2, degrees=True).as_matrix()
    result = relative_error(estimate, truth)
    assert result is not None
    assert result.cm.max == pytest.approx(3)
    assert result.deg.max == pytest.approx(2)
    assert result.cm.mean == pytest.approx(3 / 9)
    assert result.cm.median == 0


@pytest.mark.parametrize("with_scale", [False, True])
@pytest.mark.parametrize("delta", [1, 5])
def test_evo_agrees(with_scale: bool, delta: int) -> None:
    metrics = pytest.importorskip("evo.core.metrics")
    from evo.core.trajectory import PosePath3D

    estimate, truth = trajectories(7)
    ours, relative = (
        absolute_error(estimate, truth, with_scale=with_scale),
        relative_error(estimate, truth, delta=delta),
    )
    assert ours is not None
    assert relative is not None
    reference, path = PosePath3D(poses_se3=list(truth)), PosePath3D(poses_se3=list(estimate))
    for relation, spread in (
        (metrics.PoseRelation.translation_part, relative.cm),
        (metrics.PoseRelation.rotation_angle_deg, relative.deg),
    ):
        rpe = metrics.RPE(relation, delta=delta, delta_unit=metrics.Unit.frames, all_pairs=True)
        rpe.process_data((reference, path))
        unit = 100 if relation is metrics.PoseRelation.translation_part else 1
        theirs = rpe.get_all_statistics()
        for name in ("rmse", "mean", "median", "max"):
            assert getattr(spread, name) == pytest.approx(unit * theirs[name], abs=1e-6)
    path.align(reference, correct_scale=with_scale)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, path))
    theirs = ape.get_all_statistics()
    for name in ("rmse", "mean", "median", "max"):
        assert getattr(ours.cm, name) == pytest.approx(100 * theirs[name], abs=1e-6)


@settings(max_examples=20)
@given(SEEDS)
def test_tum_files_give_back_what_was_written(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    path = tmp_path_factory.mktemp("tum") / "trajectory.txt"
    poses, _ = trajectories(seed)
    timestamps = 1305031102.175304 + np.arange(len(poses)) / 30
    path.write_text(format_tum(timestamps, poses))
    read_timestamps, read_poses = read_tum(path)
    np.testing.assert_array_equal(read_timestamps, timestamps)
    np.testing.assert_array_equal(read_poses[:, :3, 3], poses[:, :3, 3])
    np.testing.assert_allclose(read_poses, poses, atol=1e-14)


def test_evo_reads_our_files(tmp_path: Path) -> None:
    file_interface = pytest.importorskip("evo.tools.file_interface")
    poses, _ = trajectories(1)
    (tmp_path / "tum.txt").write_text(format_tum(np.arange(60) / 10, poses))
    (tmp_path / "kitti.txt").write_text(format_kitti(poses))
    for path in (
        file_interface.read_tum_trajectory_file(str(tmp_path / "tum.txt")),
        file_interface.read_kitti_poses_file(str(tmp_path / "kitti.txt")),
    ):
        np.testing.assert_allclose(np.stack(path.poses_se3), poses, atol=1e-12)


def test_poses_that_are_not_finite_are_left_out_of_tum_and_named_in_kitti() -> None:
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[1] = np.nan
    assert [line.split()[0] for line in format_tum(np.arange(3.0), poses).splitlines()] == ["0.0", "2.0"]
    assert format_kitti(poses).splitlines()[1] == " ".join(["nan"] * 12)
    assert format_tum(np.zeros(1), poses[1:2]) == ""


@pytest.mark.parametrize(
    ("text", "where", "what"),
    [
        ("# only a comment\n", "trajectory.txt:", "no pose"),
        ("0 0 0 0 0 0 0 1\n\n1 0 0 0 0 0 1\n", ":3:", "eight numbers"),
        ("0 0 0 0 0 0 0 one\n", ":1:", "eight numbers"),
        ("0 0 nan 0 0 0 0 1\n", ":1:", "eight numbers"),
        ("0 0 0 0 0 0 0 2\n", ":1:", "quaternion"),
        ("1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", ":2:", "time does not increase"),
    ],
)
def test_bad_files_are_refused_in_one_line(tmp_path: Path, text: str, where: str, what: str) -> None:
    (tmp_path / "trajectory.txt").write_text(text)
    with pytest.raises(InputError) as caught:
        read_tum(tmp_path / "trajectory.txt")
    message = str(caught.value)
    assert where in message
    assert what in message
    assert "\n" not in message


def test_missing_and_binary_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="No such file"):
        read_tum(tmp_path / "missing.txt")
    (tmp_path / "binary").write_bytes(bytes(range(128, 256)))
    with pytest.raises(InputError, match="not a text file"):
        read_tum(tmp_path / "binary")


@pytest.mark.parametrize("late_s", [0.03, -0.05, 0.0])
def test_a_lag_is_found_and_what_the_error_were_without(late_s: float) -> None:
    times = np.arange(150) / 30
    truth, estimate = np.tile(np.eye(4), (2, len(times), 1, 1))
    for poses, moment in ((truth, times), (estimate, times - late_s)):
        poses[:, :3, 3] = np.stack([np.sin(2 * moment), np.cos(3 * moment), 0.3 * np.sin(5 * moment)], 1)
    estimate[40], truth[70] = np.nan, np.nan
    found = find_lag(random_motion(np.random.default_rng(0)).apply_to_poses(estimate), truth, times)
    assert found is not None
    assert found.seconds == pytest.approx(late_s, abs=1e-9)
    assert found.rmse_cm < 0.2
    assert late_s == 0 or found.rmse_cm < 0.05 * found.with_cm


def test_a_lag_is_not_looked_for_in_a_moment() -> None:
    estimate, truth = trajectories(0, 20)
    assert find_lag(estimate, truth, np.arange(20) / 30) is None
    assert find_lag(estimate, np.full_like(truth, np.nan), np.arange(20) / 3) is None
