"""The compiled comparison of a frame with earlier views against numpy, written to be read."""

import numpy as np
import pytest

from ecslam.datasets import open_sequence
from ecslam.earlier import SAMPLES, around, cell_lens, cell_px, light, relief, to_views
from ecslam.exposure import WITHIN
from ecslam.kernels import earlier_views
from ecslam.movers import FRONT, compare
from ecslam.rigid import inverse

ROOM = open_sequence("synthetic/apartment?size=320x240&frames=120&visitor=1")


def nearest_in_cells(depth: np.ndarray) -> np.ndarray:
    cell = cell_px(depth.shape[1])
    inside = ((np.arange(SAMPLES) + 0.5) * cell / SAMPLES).astype(int)
    rows, columns = (side // cell * cell for side in depth.shape)
    looked_at = np.stack([depth[v:rows:cell, u:columns:cell] for v in inside for u in inside])
    measured = (looked_at > 0) & (looked_at < np.inf)
    return np.where(2 * measured.sum(0) >= len(measured), np.where(measured, looked_at, np.inf).min(0), 0)


def held_against(near: np.ndarray, lens: tuple, c2w: np.ndarray, seen: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """For each cell [h, w]: 2 where a view says that it has come, plus 1 where one saw a surface there; and which cells
    lie so near to a border of all this that rounding decides."""
    fx, fy, cx, cy = lens
    found, close = np.zeros(near.shape, int), np.zeros(near.shape, bool)
    came, settled = np.zeros((2, *near.shape), bool)
    v, u = np.indices(near.shape)
    local = np.stack([(u - cx) / fx * near, (v - cy) / fy * near, near, np.ones_like(near)], -1).astype(np.float64)
    for pose, (least, most) in zip(poses, seen, strict=True):
        x, y, z, _ = np.moveaxis(local @ (inverse(pose) @ c2w).T, -1, 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            column, row = x / z * fx + cx, y / z * fy + cy
        inside = (near > 0) & (z > 0) & (abs(column - (near.shape[1] - 1) / 2) < near.shape[1] / 2)
        inside &= abs(row - (near.shape[0] - 1) / 2) < near.shape[0] / 2
        at = np.where(inside, np.rint(row), 0).astype(int), np.where(inside, np.rint(column), 0).astype(int)
        known = inside & (least[at] > 0)
        margin = FRONT[0] + FRONT[1] * least[at]
        came |= known & (z < least[at] - margin)
        settled |= known & (z >= least[at] - margin) & (z < most[at] + margin)
        between = np.minimum(abs(column % 1 - 0.5), abs(row % 1 - 0.5)) < 1e-3
        limits = np.minimum(abs(z - least[at] + margin), abs(z - most[at] - margin)) < 1e-4
        close |= (near > 0) & (between | limits)
    found[came] += 2
    found[settled] += 1
    return np.where(close, -1, found)


@pytest.mark.parametrize("size", [(240, 320), (97, 131), (30, 40), (680, 1200)])
def test_the_nearest_depth_in_cells_is_that_of_numpy(size):
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.5, 5, size).astype(np.float32)
    for nothing in (0, np.nan, np.inf):
        depth[rng.random(size) < 0.15] = nothing
    depth[: size[0] // 3, : size[1] // 3] = 0
    assert np.array_equal(relief(depth), nearest_in_cells(depth).astype(np.float32))
    assert np.array_equal(relief(np.asfortranarray(depth)), relief(depth))


@pytest.mark.parametrize("now", [40, 72, 104])
def test_what_has_come_and_what_is_settled_is_what_numpy_says(now):
    views = [ROOM[i] for i in range(0, now, 8)]
    seen, poses = np.stack([around(relief(view.depth)) for view in views]), np.stack([view.c2w_gt for view in views])
    frame = ROOM[now]
    lens = cell_lens(ROOM.intrinsics, cell_px(frame.depth.shape[1]))
    came, settled = compare(relief(frame.depth), lens, frame.c2w_gt, seen, poses)
    expected = held_against(relief(frame.depth), lens, frame.c2w_gt, seen, poses)
    sure = expected >= 0
    assert sure.mean() > 0.8
    assert np.array_equal((2 * came + settled)[sure], expected[sure])
    assert came.any()
    assert settled.any()
    assert not settled.all()


@pytest.mark.parametrize(("every", "stride"), [(1, 1), (2, 2), (1, 3)])
def test_ratios_are_those_of_the_cells_that_see_the_same(every, stride):
    views = [ROOM[i] for i in range(0, 72, 8)]
    reliefs, poses = [relief(view.depth) for view in views], np.stack([view.c2w_gt for view in views])
    frame = ROOM[73]
    near, lit, cell = relief(frame.depth), light(frame.color), cell_px(frame.depth.shape[1])
    assert (lit == 0).any()
    lens = cell_lens(ROOM.intrinsics, cell)
    seen, lights = np.stack([around(r) for r in reliefs]), np.stack([light(view.color) for view in views])
    to_view = (inverse(poses) @ frame.c2w_gt)[:, :3].astype(np.float32)
    out = np.full(len(views) * near.size, np.nan, np.float32)
    found = earlier_views.ratios(near, lit, lens, to_view, seen, lights, WITHIN, every, stride, out)
    assert np.isnan(out[found:]).all()
    assert np.isfinite(out[:found]).all()
    expected = []
    v, u = (side[::stride, ::stride].ravel() for side in np.indices(near.shape))
    z, (fx, fy, cx, cy) = near[v, u], lens
    local = np.stack([(u - cx) / fx * z, (v - cy) / fy * z, z])
    for m, (least, most), theirs in list(zip(to_view, seen, lights, strict=True))[::every]:
        x, y, ahead = m[:, :3] @ local + m[:, 3:]
        with np.errstate(divide="ignore", invalid="ignore"):
            column, row = np.floor(x / ahead * fx + cx + 0.5), np.floor(y / ahead * fy + cy + 0.5)
        there = (z > 0) & (ahead > 0) & (column >= 0) & (row >= 0) & (column < near.shape[1]) & (row < near.shape[0])
        at = np.where(there, row, 0).astype(int), np.where(there, column, 0).astype(int)
        margin = WITHIN[0] + WITHIN[1] * least[at]
        there &= (least[at] > 0) & (ahead > least[at] - margin) & (ahead < most[at] + margin)
        there &= (theirs[at] > 0) & (lit[v, u] > 0)
        expected.append((theirs[at] - lit[v, u])[there])
    expected = np.concatenate(expected)
    assert found == pytest.approx(len(expected), rel=0.02)
    assert found > 300 / stride**2
    some = (0.1, 0.5, 0.9)
    assert np.quantile(out[:found], some) == pytest.approx(np.quantile(expected, some), abs=5e-3)


def test_motions_to_views_are_those_of_numpy():
    poses = np.stack([ROOM[i].c2w_gt for i in range(0, 72, 8)])
    expected = (inverse(poses) @ ROOM[73].c2w_gt)[:, :3]
    np.testing.assert_allclose(to_views(ROOM[73].c2w_gt, poses), expected, rtol=0, atol=1e-6)
    assert to_views(ROOM[73].c2w_gt, poses[:0]).shape == (0, 3, 4)
