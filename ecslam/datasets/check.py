"""What a sequence is and what looks odd about it, before any time is spent on a run."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..config import Config
from ..indices import evenly
from ..types import Frame, FrameError, Intrinsics, Sequence
from .agreement import odd_truth
from .prefetch import Prefetch
from .reading import finite_poses
from .registry import open_sequence
from .views import problems

USUAL_DEPTH_M = (0.2, 10.0)
ROOMS_MEDIAN_M = (0.5, 5.0)
SCALES = {1e3: "1000 times", 10.0: "10 times", 5.0: "5 times", 0.2: "a fifth of", 0.1: "a tenth of", 1e-3: "1/1000 of"}
MOST_WITHOUT_DEPTH = 0.6
MOST_LEFT_OUT = 0.5
HARDLY_ANY = 0.05
BLACK = 4.0  # mean colour value
MOST_MESSAGES = 3
JUMP_M, JUMP_DEG, JUMP_RATIO = 0.3, 30.0, 10.0


@dataclass(frozen=True)
class DepthStats:
    """Of the frames read. low_m, median_m, high_m: 1, 50 and 99 % of the valid depths (NaN when there are none).

    missing: share of pixels without depth. empty: frames without any. too_near, too_far: shares of the valid depths
    that a run leaves out.
    """

    low_m: float
    median_m: float
    high_m: float
    missing: float
    empty: int
    too_near: float
    too_far: float


@dataclass(frozen=True)
class PoseStats:
    """Of the ground truth. max_step_m, max_step_deg, median_step_m: between successive frames that both have a pose."""

    path_m: float
    median_step_m: float
    max_step_m: float
    max_step_deg: float
    max_step_frame: int
    missing: int


@dataclass(frozen=True)
class TimeStats:
    """Of all time stamps. fps: frames per second by the median step, 0 when there is none."""

    duration_s: float
    fps: float


@dataclass(frozen=True)
class CheckReport:
    """What ``check_sequence`` found. frames_read of ``frames`` were read; unreadable: their messages; black: how many.

    used_m: the depths that a run uses. poses: None without ground truth. odd: what a person should
    look at before a run, in plain words; empty when fine.
    """

    name: str
    layout: str
    preset: str
    frames: int
    intrinsics: Intrinsics
    frames_read: int
    unreadable: tuple[str, ...]
    black: int
    depth: DepthStats
    used_m: tuple[float, float]
    poses: PoseStats | None
    time: TimeStats
    odd: tuple[str, ...]

    @property
    def hopeless(self) -> bool:
        """Whether not one of the frames tried could be read."""
        return len(self.unreadable) == self.frames_read


def check_sequence(sequence: Sequence | str | Path, samples: int = 40, config: Config | None = None) -> CheckReport:
    """Look a sequence over for a run with ``config``, reading at most ``samples`` frames spread over it. Raises
    InputError."""
    if isinstance(sequence, (str, Path)):
        sequence = open_sequence(sequence)
    indices = evenly(len(sequence), samples).tolist()
    config = config or Config()
    used_m = config.depth_near_m, config.depth_far_m
    depth, black, unreadable = _read_frames((result for _, result in Prefetch(sequence, indices)), used_m)
    poses = _pose_stats(sequence.poses_gt())
    return CheckReport(
        name=sequence.name,
        layout=sequence.layout,
        preset=sequence.preset,
        frames=len(sequence),
        intrinsics=sequence.intrinsics,
        frames_read=len(indices),
        unreadable=unreadable,
        black=black,
        depth=depth,
        used_m=used_m,
        poses=poses,
        time=_time_stats(sequence.timestamps()),
        odd=(
            *problems(sequence),
            *_odd_camera(sequence.intrinsics),
            *_odd_images(depth, used_m, black, unreadable, len(indices)),
            *_odd_poses(poses),
            *filter(None, [odd_truth(sequence)]),
        ),
    )


def format_report(report: CheckReport) -> str:
    """The report as text for a terminal, one fact a line, oddities last."""
    k, t, p = report.intrinsics, report.time, report.poses
    lens = ", distortion removed on reading" if k.distortion else ""
    rolling = f", depth read row by row in {1e3 * k.readout_s:.0f} ms" if k.readout_s else ""
    rows = [
        ("sequence", f"{report.name} ({report.layout} layout, preset {report.preset})"),
        (
            "frames",
            f"{report.frames}, {report.frames_read - len(report.unreadable)} of {report.frames_read} tried readable",
        ),
        ("images", f"{k.width}x{k.height}, fx {k.fx:.1f} fy {k.fy:.1f} cx {k.cx:.1f} cy {k.cy:.1f}{lens}"),
        *_depth_lines(report.depth, report.used_m),
        ("time", f"{t.duration_s:.1f} s at {t.fps:.1f} frames/s{rolling}"),
        ("poses", "no ground truth" if p is None else _pose_line(p)),
        *(("unreadable", message) for message in _first_few(report.unreadable)),
        *(("odd", message) for message in report.odd or ("nothing",)),
    ]
    return "\n".join(f"{label:<12}{text}" for label, text in rows)


def _depth_lines(d: DepthStats, used_m: tuple[float, float]) -> list[tuple[str, str]]:
    if np.isnan(d.median_m):
        return [("depth", "none in what could be read")]
    return [
        ("depth", f"{d.low_m:.2f} .. {d.high_m:.2f} m, median {d.median_m:.2f} m, {d.missing:.0%} of pixels without"),
        ("used", f"{used_m[0]:.2f} .. {used_m[1]:.2f} m, {1 - d.too_near - d.too_far:.0%} of the depth"),
    ]


def _first_few(messages: tuple[str, ...]) -> list[str]:
    """The first different ones, and how many there are besides."""
    different = list(dict.fromkeys(messages))
    more = len(different) - MOST_MESSAGES
    return [*different[:MOST_MESSAGES], *([f"and {more} more like these"] if more > 0 else [])]


def _pose_line(p: PoseStats) -> str:
    missing = f", {p.missing} missing" if p.missing else ""
    return f"path {p.path_m:.2f} m, largest step {p.max_step_m * 100:.1f} cm and {p.max_step_deg:.1f} degrees{missing}"


def _read_frames(
    results: Iterator[Frame | FrameError], used_m: tuple[float, float]
) -> tuple[DepthStats, int, tuple[str, ...]]:
    depths: list[NDArray[np.float32]] = []
    missing: list[float] = []
    unreadable: list[str] = []
    black = 0
    for result in results:
        if isinstance(result, FrameError):
            unreadable.append(str(result))
            continue
        valid = result.depth > 0
        missing.append(1.0 - float(valid.mean()))
        black += int(result.color.mean() < BLACK)
        depths.append(result.depth[::4, ::4][valid[::4, ::4]])
    pooled = np.concatenate(depths) if depths else np.empty(0, np.float32)
    low, median, high = np.percentile(pooled, [1, 50, 99]).tolist() if len(pooled) else [float("nan")] * 3
    share = float(np.mean(missing)) if missing else 1.0
    stats = DepthStats(low, median, high, share, missing.count(1.0), *_left_out(pooled, used_m))
    return stats, black, tuple(unreadable)


def _left_out(depths: NDArray[np.float32], used_m: tuple[float, float]) -> tuple[float, float]:
    """The shares of ``depths`` that are nearer and farther than those that a run uses."""
    count = max(len(depths), 1)
    return float((depths < used_m[0]).sum() / count), float((depths > used_m[1]).sum() / count)


def _pose_stats(poses: NDArray[np.float64] | None) -> PoseStats | None:
    from scipy.spatial.transform import Rotation

    if poses is None:
        return None
    good = finite_poses(poses)
    pairs = np.flatnonzero(good[:-1] & good[1:])
    if len(pairs) == 0:
        return PoseStats(0.0, 0.0, 0.0, 0.0, 0, int((~good).sum()))
    a, b = poses[pairs], poses[pairs + 1]
    steps = np.linalg.norm(b[:, :3, 3] - a[:, :3, 3], axis=1)
    turns = np.degrees((Rotation.from_matrix(a[:, :3, :3]).inv() * Rotation.from_matrix(b[:, :3, :3])).magnitude())
    return PoseStats(
        path_m=float(steps.sum()),
        median_step_m=float(np.median(steps)),
        max_step_m=float(steps.max()),
        max_step_deg=float(turns.max()),
        max_step_frame=int(pairs[steps.argmax()]) + 1,
        missing=int((~good).sum()),
    )


def _time_stats(times: NDArray[np.float64]) -> TimeStats:
    steps = np.diff(times)
    forward = steps[steps > 0]
    return TimeStats(
        duration_s=float(times.max() - times.min()),
        fps=float(1 / np.median(forward)) if len(forward) else 0.0,
    )


def _odd_camera(k: Intrinsics) -> Iterator[str]:
    if abs(k.cx / k.width - 0.5) > 0.15 or abs(k.cy / k.height - 0.5) > 0.15:
        yield f"the optical centre ({k.cx:.0f}, {k.cy:.0f}) is far from the middle of the image: wrong intrinsics?"
    if not 0.9 < k.fx / k.fy < 1.1:
        yield f"fx {k.fx:.0f} and fy {k.fy:.0f} differ by over 10 %: wrong intrinsics?"
    view_deg = np.degrees(2 * np.arctan(k.width / (2 * k.fx)))
    if not 25 < view_deg < 125:
        yield f"the camera would see {view_deg:.0f} degrees across: wrong intrinsics?"


def _odd_images(
    depth: DepthStats, used_m: tuple[float, float], black: int, unreadable: tuple[str, ...], tried: int
) -> Iterator[str]:
    if unreadable:
        yield f"{len(unreadable)} of {tried} frames are unreadable; a run skips them and stops when over 20 % are"
    if depth.low_m == depth.high_m:
        yield f"the depth is {depth.low_m:.3g} m everywhere: is it what the camera measured?"
    if black:
        yield f"{black} of {tried} frames are black"
    if depth.empty:
        yield f"{depth.empty} of {tried} frames have no depth at all"
    if depth.missing > MOST_WITHOUT_DEPTH and depth.empty < tried - len(unreadable):
        yield f"{depth.missing:.0%} of the pixels have no depth"
    if odd := _odd_distance(depth.median_m, depth.too_near, depth.too_far, used_m):
        yield odd


def odd_depth(depth: NDArray[np.float32], used_m: tuple[float, float]) -> str:
    """What is odd about a frame's depth [H, W] in metres as a whole, or "": none, hardly a room's, or hardly any of it
    within ``used_m``."""
    known = depth[::4, ::4][np.isfinite(depth[::4, ::4]) & (depth[::4, ::4] > 0)]
    if not len(known):
        return "no depth at all"
    return _odd_distance(float(np.median(known)), *_left_out(known, used_m), used_m)


def lacking_depth(depth: NDArray[np.float32], used_m: tuple[float, float]) -> str:
    """How little of a frame's depth [H, W] in metres is within ``used_m``, or "" where it is more than hardly any."""
    share = float(((depth > 0) & (depth >= used_m[0]) & (depth <= used_m[1])).mean())
    return f"{share:.1%} of the image has usable depth" if share < HARDLY_ANY else ""


def _odd_distance(median_m: float, too_near: float, too_far: float, used_m: tuple[float, float]) -> str:
    if median_m < USUAL_DEPTH_M[0] or median_m > USUAL_DEPTH_M[1]:
        likely = [name for scale, name in SCALES.items() if ROOMS_MEDIAN_M[0] <= scale * median_m <= ROOMS_MEDIAN_M[1]]
        hint = f"; {' or '.join(likely)} that would be a room's, so export it in the layout's unit" if likely else ""
        return f"the median depth is {median_m:.3g} m: probably a wrong depth scale{hint}"
    small = f"is below depth_near_m = {used_m[0]:g} and left out: lower that with --set"
    large = f"is beyond depth_far_m = {used_m[1]:g} and left out: raise that with --set"
    for share, text in ((too_near, small), (too_far, large)):
        if share > MOST_LEFT_OUT:
            return f"{share:.0%} of the depth {text}, or correct the depth scale if the room is not like that"
    return ""


def _odd_poses(poses: PoseStats | None) -> Iterator[str]:
    if poses is None:
        return
    if poses.max_step_m > max(JUMP_M, JUMP_RATIO * poses.median_step_m):
        yield f"the ground truth jumps by {poses.max_step_m:.2f} m at frame {poses.max_step_frame}"
    if poses.max_step_deg > JUMP_DEG:
        yield f"the ground truth turns by {poses.max_step_deg:.0f} degrees between two frames"
