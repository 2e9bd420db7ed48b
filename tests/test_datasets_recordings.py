"""The layouts on real recordings, where they lie beside the checkout or where ECSLAM_RECORDINGS says."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest

from ecslam.datasets import Prefetch, open_sequence
from ecslam.datasets.check import check_sequence
from ecslam.datasets.files import FileSequence
from ecslam.types import Frame

RECORDINGS = Path(os.environ.get("ECSLAM_RECORDINGS", Path(__file__).parents[2] / "shared/data"))
pytestmark = pytest.mark.recordings


def recording(name: str) -> Path:
    if not (RECORDINGS / name).is_dir():
        pytest.skip(f"no recording {name}")
    return RECORDINGS / name


def cloud(frame: Frame, camera: np.ndarray) -> np.ndarray:
    """World points [N, 3] of every 8th pixel with depth."""
    v, u = np.mgrid[24:456:8, 24:616:8]
    z = frame.depth[v, u]
    points = np.stack([u, v, np.ones_like(u)], -1)[z > 0] @ np.linalg.inv(camera).T * z[z > 0][:, None]
    assert frame.c2w_gt is not None
    return points @ frame.c2w_gt[:3, :3].T + frame.c2w_gt[:3, 3]


def misfit_m(points: np.ndarray, frame: Frame, camera: np.ndarray) -> float:
    """Median difference between the points' depth in ``frame`` and what it measured there."""
    assert frame.c2w_gt is not None
    local = (points - frame.c2w_gt[:3, 3]) @ frame.c2w_gt[:3, :3]
    pixels = np.rint((local @ camera.T)[:, :2] / local[:, 2:]).astype(int)
    inside = ((pixels >= 0) & (pixels < [640, 480])).all(1) & (local[:, 2] > 0)
    measured = frame.depth[pixels[inside, 1], pixels[inside, 0]]
    return float(np.median(np.abs(measured - local[inside, 2])[measured > 0]))


@pytest.mark.parametrize(("name", "layout"), [("7scenes-redkitchen", "7scenes"), ("tum-fr1-xyz", "tum")])
def test_depth_poses_and_intrinsics_agree_with_each_other(name: str, layout: str) -> None:
    """Points of one frame, moved by ground truth, must fall on the surface another frame measured."""
    sequence = open_sequence(recording(name))
    assert (sequence.layout, sequence.name) == (layout, name)
    camera = sequence.intrinsics.matrix()
    misfits = [misfit_m(cloud(sequence[i], camera), sequence[i + 25], camera) for i in range(0, 140, 20)]
    assert np.mean(misfits) < 0.02


def colour_misfit(a: Frame, b: Frame, camera: np.ndarray) -> float:
    """Mean difference of brightness at points that two frames measured."""
    assert a.c2w_gt is not None
    assert b.c2w_gt is not None
    v, u = np.mgrid[24:456:2, 24:616:2]
    z = a.depth[v, u]
    points = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(camera).T * z[..., None]
    a_to_b = np.linalg.inv(b.c2w_gt) @ a.c2w_gt
    local = points @ a_to_b[:3, :3].T + a_to_b[:3, 3]
    with np.errstate(all="ignore"):
        x, y = np.rint(np.nan_to_num((local @ camera.T)[..., :2] / local[..., 2:])).astype(int).transpose(2, 0, 1)
    both = (z > 0) & (x >= 0) & (x < 640) & (y >= 0) & (y < 480)
    x, y = x[both], y[both]
    same = np.abs(b.depth[y, x] - local[both][:, 2]) < 0.03
    return float(np.abs(a.color.mean(2)[v, u][both][same] - b.color.mean(2)[y, x][same]).mean())


def test_colour_of_7scenes_lies_where_depth_is() -> None:
    """Two frames must see a point in the same colour; as stored they see what is beside it."""
    sequence = open_sequence(recording("7scenes-redkitchen"))
    assert isinstance(sequence, FileSequence)
    camera, as_stored = sequence.intrinsics.matrix(), dataclasses.replace(sequence, registration=None)
    pairs = [(i, i + 8) for i in range(0, 160, 40)]
    moved, stored = (np.mean([colour_misfit(s[a], s[b], camera) for a, b in pairs]) for s in (sequence, as_stored))
    assert moved < 0.75 * stored


@pytest.mark.parametrize(("name", "frames"), [("7scenes-redkitchen", 400), ("tum-fr1-xyz", 174)])
def test_check_finds_them_healthy(name: str, frames: int) -> None:
    report = check_sequence(recording(name))
    assert report.frames == frames
    assert report.unreadable == ()
    assert report.time.fps == pytest.approx(30, abs=2)
    assert [odd for odd in report.odd if "no partner" not in odd] == []


def test_reading_ahead_gives_the_same_frames() -> None:
    sequence = open_sequence(recording("tum-fr1-xyz"))
    for index, frame in Prefetch(sequence, range(3)):
        assert isinstance(frame, Frame)
        np.testing.assert_array_equal(frame.color, sequence[index].color)
        np.testing.assert_array_equal(frame.depth, sequence[index].depth)
