"""`check`: the figures are those of the data, and each oddity is said, and only then."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
import pytest

from ecslam.config import Config
from ecslam.datasets.check import check_sequence, format_report
from ecslam.types import Frame, FrameError, InputError, Intrinsics, Mesh

W, H, N = 40, 30, 100
CAMERA = Intrinsics(40.0, 40.0, 19.5, 14.5, W, H)


@dataclass
class Recording:
    """A healthy recording in memory: a wall from 1 to 3 m, 1 cm a frame; tests spoil one thing each."""

    name: str = "healthy"
    layout: str = "test"
    preset: str = "lite"
    intrinsics: Intrinsics = CAMERA
    bounds: np.ndarray | None = None
    times: np.ndarray = field(default_factory=lambda: np.arange(N) / 30)
    poses: np.ndarray | None = field(default_factory=lambda: straight_path())
    depth: np.ndarray = field(default_factory=lambda: np.linspace(1, 3, W * H, dtype=np.float32).reshape(H, W))
    color: int = 120
    unreadable: frozenset[int] = frozenset()
    notes: tuple[str, ...] = ()
    read: list[int] = field(default_factory=list)

    def __len__(self) -> int:
        return N

    def __getitem__(self, index: int) -> Frame:
        self.read.append(index)
        if index in self.unreadable:
            raise FrameError(f"{index}.png: broken")
        return Frame(index, float(self.times[index]), np.full((H, W, 3), self.color, np.uint8), self.depth)

    def __iter__(self) -> Iterator[Frame]:
        return (self[i] for i in range(N))

    def timestamps(self) -> np.ndarray:
        return self.times

    def poses_gt(self) -> np.ndarray | None:
        return self.poses

    def reference_mesh(self) -> Mesh | None:
        return None


def straight_path() -> np.ndarray:
    poses = np.tile(np.eye(4), (N, 1, 1))
    poses[:, 0, 3] = 0.01 * np.arange(N)
    return poses


def jump(poses: np.ndarray) -> np.ndarray:
    poses[50:, 1, 3] += 1.0
    return poses


def turn(poses: np.ndarray) -> np.ndarray:
    poses[30:, :3, :3] = np.diag([-1.0, -1.0, 1.0])
    return poses


def without(poses: np.ndarray) -> np.ndarray:
    poses[10:13] = np.nan
    return poses


def test_a_healthy_recording_is_measured_and_not_odd() -> None:
    recording = Recording()
    report = check_sequence(recording)
    assert report.odd == ()
    assert (report.frames, report.frames_read, report.unreadable, report.black) == (N, 40, (), 0)
    assert sorted(recording.read)[:1] + sorted(recording.read)[-1:] == [0, N - 1]
    assert report.depth.median_m == pytest.approx(2, abs=0.06)
    assert report.depth.low_m == pytest.approx(1.02, abs=0.05)
    assert report.depth.high_m == pytest.approx(2.98, abs=0.15)
    assert (report.depth.missing, report.depth.empty) == (0, 0)
    assert report.poses is not None
    assert report.poses.path_m == pytest.approx(0.99)
    assert report.poses.max_step_m == pytest.approx(0.01)
    assert report.poses.max_step_deg == pytest.approx(0, abs=1e-6)
    assert report.time.fps == pytest.approx(30)
    assert report.time.duration_s == pytest.approx(3.3)
    with pytest.raises(dataclasses.FrozenInstanceError):
        report.frames = 3  # type: ignore[misc]


SPOILT: list[tuple[str, Callable[[], Recording]]] = [
    ("wrong depth scale", lambda: Recording(depth=np.full((H, W), 0.002, np.float32))),
    ("wrong depth scale", lambda: Recording(depth=np.full((H, W), 50, np.float32))),
    ("a fifth of or a tenth of that would be a room's", lambda: Recording(depth=np.full((H, W), 12, np.float32))),
    ("correct the depth scale", lambda: Recording(depth=np.full((H, W), 9.9, np.float32))),
    ("100% of the depth is beyond depth_far_m = 8", lambda: Recording(depth=np.full((H, W), 9, np.float32))),
    ("40 of 40 frames are black", lambda: Recording(color=1)),
    ("40 of 40 frames have no depth", lambda: Recording(depth=np.zeros((H, W), np.float32))),
    (
        "75% of the pixels have no depth",
        lambda: Recording(depth=np.tile(np.array([2, 0, 0, 0], np.float32), (H, W // 4))),
    ),
    ("jumps by 1.00 m at frame 50", lambda: Recording(poses=jump(straight_path()))),
    ("turns by 180 degrees", lambda: Recording(poses=turn(straight_path()))),
    ("2 of 40 frames are unreadable", lambda: Recording(unreadable=frozenset([0, N - 1]))),
    ("1 gaps of more than 1 s", lambda: Recording(times=np.where(np.arange(N) < 20, 0, 5) + np.arange(N) / 30)),
    ("go backwards", lambda: Recording(times=np.arange(N)[::-1] / 30)),
    ("only 1 of 100 frames are of use", lambda: Recording(times=np.zeros(N))),
    ("the depth is 2 m everywhere", lambda: Recording(depth=np.full((H, W), 2, np.float32))),
    ("look like milliseconds", lambda: Recording(times=1e3 * np.arange(N) / 30)),
    ("look like nanoseconds", lambda: Recording(times=1.6e18 + 1e9 * np.arange(N) / 30)),
    ("repeat the time", lambda: Recording(times=np.floor(np.arange(N) / 2))),
    ("optical centre", lambda: Recording(intrinsics=Intrinsics(40, 40, 1, 14, W, H))),
    ("differ by over 10 %", lambda: Recording(intrinsics=Intrinsics(40, 80, 19, 14, W, H))),
    ("8 degrees across", lambda: Recording(intrinsics=Intrinsics(300, 300, 19, 14, W, H))),
    ("said by the loader", lambda: Recording(notes=("said by the loader",))),
]


@pytest.mark.parametrize(("says", "make"), SPOILT, ids=[says for says, _ in SPOILT])
def test_each_oddity_is_said_in_the_report_and_its_text(says: str, make: Callable[[], Recording]) -> None:
    report = check_sequence(make())
    assert any(says in odd for odd in report.odd)
    assert says in format_report(report)


def test_what_a_run_would_leave_out_is_measured() -> None:
    config = Config(depth_near_m=1.5, depth_far_m=2.5)
    report = check_sequence(Recording(), config=config)
    assert report.odd == ()
    assert (report.depth.too_near, report.depth.too_far) == pytest.approx((0.25, 0.25), abs=0.05)
    assert "1.50 .. 2.50 m" in format_report(report)
    (odd,) = check_sequence(Recording(), config=Config(depth_near_m=2.5)).odd
    assert "below depth_near_m = 2.5" in odd


def test_missing_poses_are_counted_and_left_out_of_the_path() -> None:
    report = check_sequence(Recording(poses=without(straight_path())))
    assert report.poses is not None
    assert report.poses.missing == 3
    assert report.poses.path_m == pytest.approx(0.95)


def test_it_lives_with_no_ground_truth_and_with_nothing_readable() -> None:
    report = check_sequence(Recording(poses=None, unreadable=frozenset(range(N))))
    assert report.poses is None
    assert len(report.unreadable) == 40
    assert np.isnan(report.depth.median_m)
    text = format_report(report)
    assert "no ground truth" in text
    assert "0.png: broken" in text
    assert text.count("broken") == 3
    assert "and 37 more like these" in text
    assert "nan" not in text
    assert "none in what could be read" in text
    assert "used " not in text


def test_a_message_that_all_frames_share_is_said_once() -> None:
    report = dataclasses.replace(check_sequence(Recording()), unreadable=("no depth here",) * 40)
    assert format_report(report).count("no depth here") == 1


def test_frames_without_any_depth_are_said_once() -> None:
    report = check_sequence(Recording(depth=np.zeros((H, W), np.float32)))
    assert report.odd == ("40 of 40 frames have no depth at all",)
    assert "none in what could be read" in format_report(report)


def test_a_path_that_does_not_open_is_an_input_error() -> None:
    with pytest.raises(InputError, match="no such folder"):
        check_sequence("/does/not/exist")
