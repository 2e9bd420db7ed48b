"""How far an estimated trajectory is from the true one: ATE and RPE (Sturm et al., IROS 2012), frame by frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..rigid import best_motion, inverse, rotation_angle_deg

Floats = NDArray[np.float64]
MOST_LAG_S, LAG_STEP_S = 0.1, 0.002
LEAST_FRAMES = 20


@dataclass(frozen=True)
class Similarity:
    """x -> scale * rotation @ x + translation. rotation: [3, 3]; translation: [3], metres."""

    rotation: Floats
    translation: Floats
    scale: float = 1.0

    def apply(self, points: NDArray[np.floating]) -> Floats:
        """Move points [..., 3]."""
        return self.scale * points @ self.rotation.T + self.translation

    def apply_to_poses(self, c2w: Floats) -> Floats:
        """Move camera-to-world poses [..., 4, 4]; the result stays a rigid motion whatever the scale."""
        out = c2w.copy()
        out[..., :3, :3] = self.rotation @ c2w[..., :3, :3]
        out[..., :3, 3] = self.apply(c2w[..., :3, 3])
        return out


IDENTITY = Similarity(np.eye(3), np.zeros(3))


@dataclass(frozen=True)
class Spread:
    """Statistics of errors that are all >= 0."""

    rmse: float
    mean: float
    median: float
    max: float

    @classmethod
    def of(cls, errors: Floats) -> Spread:
        """Of at least one error [N]."""
        rmse = np.sqrt(np.mean(errors**2))
        return cls(float(rmse), float(errors.mean()), float(np.median(errors)), float(errors.max()))


@dataclass(frozen=True)
class AbsoluteError:
    """Absolute trajectory error. cm: over the frames that count. errors_cm: [N], NaN for a frame that is left out.

    left_out: frames without a finite pose on both sides. alignment: what was applied to the estimate.
    """

    cm: Spread
    errors_cm: Floats
    left_out: int
    alignment: Similarity


@dataclass(frozen=True)
class RelativeError:
    """Relative pose error between frames ``delta`` apart. left_out: pairs with a pose that is not finite."""

    cm: Spread
    deg: Spread
    left_out: int


def align_umeyama(source: Floats, target: Floats, *, with_scale: bool = False) -> Similarity:
    """The motion that brings points [N, 3] closest to others [N, 3] in least squares (Umeyama, PAMI 1991); N >= 1.

    Where the points leave it open (all on a line or at one place) it is one of the best motions.
    """
    rotation, middle, goal = best_motion(source, target)[:3, :3], source.mean(0), target.mean(0)
    turned = (source - middle) @ rotation.T
    variance = float((turned**2).sum())
    scale = float((turned * (target - goal)).sum()) / variance if with_scale and variance > 0 else 1.0
    return Similarity(rotation, goal - scale * rotation @ middle, scale)


def absolute_error(
    estimate: Floats, truth: Floats, *, align: bool = True, with_scale: bool = False
) -> AbsoluteError | None:
    """ATE of camera centres after alignment, in cm; None when no frame has both poses.

    estimate, truth: [N, 4, 4] camera-to-world, metres. Frames whose pose is not finite on either side are left out of
    the alignment and of the figures, and counted. with_scale: align the scale too (not done for RGB-D).
    """
    ok = _finite(estimate) & _finite(truth)
    if not ok.any():
        return None
    source, target = estimate[ok, :3, 3], truth[ok, :3, 3]
    alignment = align_umeyama(source, target, with_scale=with_scale) if align else IDENTITY
    errors = np.full(len(ok), np.nan)
    errors[ok] = 100 * np.linalg.norm(alignment.apply(source) - target, axis=1)
    return AbsoluteError(Spread.of(errors[ok]), errors, int((~ok).sum()), alignment)


def relative_error(estimate: Floats, truth: Floats, *, delta: int = 1) -> RelativeError | None:
    """RPE over all pairs of frames (i, i + delta), in cm and degrees; None when there is no pair.

    estimate, truth: [N, 4, 4] camera-to-world, metres. Needs no alignment. Per pair, not per second or per metre.
    """
    ok = _finite(estimate) & _finite(truth)
    pairs = np.flatnonzero(ok[:-delta] & ok[delta:])
    if not len(pairs):
        return None
    moved = [inverse(poses[pairs]) @ poses[pairs + delta] for poses in (truth, estimate)]
    error = inverse(moved[0]) @ moved[1]
    cm = 100 * np.linalg.norm(error[:, :3, 3], axis=1)
    deg = rotation_angle_deg(moved[0], moved[1])
    return RelativeError(Spread.of(cm), Spread.of(deg), len(ok) - delta - len(pairs))


@dataclass(frozen=True)
class Lag:
    """seconds: by how much an estimate is behind the truth. rmse_cm: its ATE without that; with_cm: and with it."""

    seconds: float
    rmse_cm: float
    with_cm: float


def find_lag(estimate: Floats, truth: Floats, times: Floats) -> Lag | None:
    """The lag of at most ``MOST_LAG_S`` either way without which an estimate [N, 4, 4] fits the truth [N, 4, 4] best;
    times: [N] of both, ascending seconds. Cameras and whatever measures the truth seldom have one clock, and images are
    stamped when they have arrived. None where too few frames have both poses."""
    ok = _finite(estimate) & _finite(truth)
    known, centres = times[_finite(estimate)], estimate[_finite(estimate), :3, 3]
    inner = ok & (times >= times[0] + MOST_LAG_S) & (times <= times[-1] - MOST_LAG_S)
    if inner.sum() < LEAST_FRAMES:
        return None
    lags = np.arange(-round(MOST_LAG_S / LAG_STEP_S), round(MOST_LAG_S / LAG_STEP_S) + 1) * LAG_STEP_S
    goal, rmse = truth[inner, :3, 3], np.empty(len(lags))
    for i, lag in enumerate(lags):
        at = np.stack([np.interp(times[inner] + lag, known, axis) for axis in centres.T], 1)
        rmse[i] = np.sqrt(((align_umeyama(at, goal).apply(at) - goal) ** 2).sum(1).mean())
    return Lag(float(lags[rmse.argmin()]), float(100 * rmse.min()), float(100 * rmse[len(lags) // 2]))


def _finite(poses: Floats) -> NDArray[np.bool_]:
    return np.asarray(np.isfinite(poses).all((1, 2)))
