"""What surrounds the alignment of a frame on a GPU, against the same in numpy.

Not collected by itself: ``test_kernels_gpu.py`` runs it in a process of its own (see ``gpu_checks.py``).
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from on_gpu import DEVICE, INTERPRETED
from planes import corner, look, pose

from ecslam.config import Config
from ecslam.kernels import fusion_gpu, tracking_gpu
from ecslam.kernels._gpu_descent import COST, COUNT, DONE
from ecslam.observed import LEAST_KNOWN, VOXEL_M, ObservedVoxels
from ecslam.observed_gpu import ObservedTable
from ecslam.pixels import LUMINANCE
from ecslam.pixels_gpu import DeviceFrame, choose, grid_cells, spread
from ecslam.types import Intrinsics
from ecslam.volume import FusedVolume
from ecslam.volume_gpu import GpuVolume

torch.set_num_threads(1)
CAMERA = Intrinsics(48.0, 47.0, 23.6, 17.3, 48, 36)
CONFIG = Config(border_px=2, depth_near_m=0.5, depth_far_m=2.05)
LENGTHS = (0.04, 0.11)
TRUE = pose((2, 3, -1), (0.02, 0.01, -0.02))
GAIN = torch.ones(1, dtype=torch.float64, device=DEVICE)
ELSEWHERE = pose((20, 30, -10), (1.023, 0.317, -2.029))  # where no plane is the side of a voxel


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch):
    """So small that they have to be gone through several times."""
    monkeypatch.setattr(tracking_gpu, "WHOLE", 64)
    if INTERPRETED:
        monkeypatch.setattr(fusion_gpu, "BLOCK", 4096)
        monkeypatch.setattr(fusion_gpu, "POINTS", 512)


@pytest.fixture(scope="module")
def seen():
    """The corner in noise colours, with holes."""
    frame, rng = look(TRUE, corner(), CAMERA), np.random.default_rng(0)
    frame.color[:] = rng.integers(0, 256, frame.color.shape)
    frame.depth[rng.random(frame.depth.shape) < 0.1] = 0
    return frame


@pytest.fixture(scope="module")
def volumes():
    """The same volume on the host and on the device; it knows part of what the frame shows."""
    theirs, mine = FusedVolume(*LENGTHS), GpuVolume(*LENGTHS, DEVICE)
    part = look(TRUE, corner(), CAMERA)
    part.depth[:, 30:] = 0
    theirs.integrate(part, CAMERA, TRUE, 0.1, 8.0)
    mine.load(theirs.state())
    return theirs, mine


def numbers(*shape):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(3)).to(DEVICE)


def in_grid(cell, rows, columns, jitter):
    """Rows and columns of pixels at shares of the cells of a grid inside the border."""
    b, (h, w) = CONFIG.border_px, (36 - 2 * CONFIG.border_px, 48 - 2 * CONFIG.border_px)
    v = ((cell // columns + jitter[:, 0]) * np.float32(h / rows)).astype(int).clip(max=h - 1) + b
    return v, ((cell % columns + jitter[:, 1]) * np.float32(w / columns)).astype(int).clip(max=w - 1) + b


def rays_at(frame, v, u):
    """Directions and depths, 0 for those that do not count, of pixels."""
    d = frame.depth[v, u]
    direction = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(len(u))], 1)
    return direction, np.where((d >= CONFIG.depth_near_m) & (d <= CONFIG.depth_far_m), d, 0)


def test_a_frame_takes_the_place_of_one_of_its_size(seen):
    depth, nearer = seen.depth.copy(), replace(seen, depth=0.5 * seen.depth)
    place = DeviceFrame.of(seen, DEVICE)
    assert DeviceFrame.of(nearer, DEVICE, place) is place
    np.testing.assert_array_equal(place.depth.cpu(), nearer.depth)
    np.testing.assert_array_equal(seen.depth, depth)
    other = DeviceFrame.of(replace(seen, depth=depth[1:], color=seen.color[1:]), DEVICE, place)
    assert other.depth.shape == (len(depth) - 1, depth.shape[1])


@pytest.mark.parametrize(("count", "gain"), [(1, 1.0), (128, 0.7), (300, 1.6)])
def test_points_are_spread_over_the_image(seen, count, gain):
    shown = DeviceFrame.of(seen, DEVICE)
    cells = grid_cells(shown, count, CONFIG)
    jitter = numbers(cells, 2)
    points = spread(shown, CAMERA, count, CONFIG, jitter, gain * GAIN).cpu().numpy()
    rows = round(np.ceil(np.sqrt(count * 32 / 44)))
    v, u = in_grid(np.arange(cells), rows, cells // rows, jitter.cpu().numpy())
    direction, depth = rays_at(seen, v, u)
    np.testing.assert_allclose(points[:, :3], direction * depth[:, None], atol=1e-5)
    light = np.minimum(gain * (seen.color[v, u].astype(np.float32) @ LUMINANCE), 1)
    np.testing.assert_allclose(points[:, 3], light, atol=1e-6)
    assert count < 300 or 0.05 < (depth == 0).mean() < 0.9


def points_of(seen, count):
    shown = DeviceFrame.of(seen, DEVICE)
    return spread(shown, CAMERA, count, CONFIG, numbers(grid_cells(shown, count, CONFIG), 2), GAIN)


@pytest.mark.parametrize(("count", "least"), [(300, 10), (300, 10_000), (50, 5), (1, 5)])
def test_points_where_the_surface_is_known_are_aligned(seen, volumes, count, least):
    points, start = points_of(seen, count), torch.from_numpy(TRUE).to(DEVICE)
    packed, row = tracking_gpu.packed(volumes[1].blocks, points, start, least)
    given = points.cpu().numpy()
    has = given[:, 2] > 0
    _, known = volumes[0].distances(given[:, :3] @ TRUE[:3, :3].T + TRUE[:3, 3])
    expected = given[has & known if (has & known).sum() >= least else has]
    assert row[COUNT.value] == len(expected)
    np.testing.assert_array_equal(packed.cpu().numpy()[: len(expected)], expected)
    np.testing.assert_array_equal(row[:12].cpu().numpy(), TRUE[:3].ravel())
    assert row[DONE.value] == 0
    assert count < 300 or 20 < (has & known).sum() < has.sum() - 20


@pytest.mark.parametrize(("least_seen", "near_m"), [(0.1, 0.01), (0.1, 0.002), (0.99, 0.01)])
def test_what_is_told_of_a_pose(seen, volumes, least_seen, near_m):
    points, at = points_of(seen, 300), TRUE @ pose((0.1, 0, 0), (0.003, 0, 0.004))
    row = torch.zeros(112, dtype=torch.float64, device=DEVICE)
    row[COST.value], row[COUNT.value] = 3.0, 150
    told = tracking_gpu.told(volumes[1].blocks, points, torch.from_numpy(at).to(DEVICE), row, near_m, least_seen)
    given = points.cpu().numpy()
    measured = given[given[:, 2] > 0, :3]
    distance, known = volumes[0].distances(measured @ at[:3, :3].T + at[:3, 3])
    share = (np.abs(distance[known]) < near_m).mean() if known.sum() >= least_seen * len(measured) else 0
    np.testing.assert_allclose(told.cpu().numpy(), [*at[:3].ravel(), 3 / 150, share, len(measured)], rtol=1e-12)
    assert (share > 0) == (least_seen < 0.9)
    assert near_m > 0.005 or share < 0.9


@pytest.mark.parametrize("fus", [True, False])
@pytest.mark.parametrize(("observes", "blind"), [("half", False), ("nothing", False), ("half", True)])
def test_pixels_are_chosen_and_those_observed_are_taken_in_turn(seen, fus, observes, blind):
    config = Config(**{**vars(CONFIG), "fus": fus})
    depth = np.zeros_like(seen.depth) if blind else seen.depth
    frame = type(seen)(**{**{n: getattr(seen, n) for n in ("index", "timestamp", "color")}, "depth": depth})
    voxels, table = ObservedVoxels(), ObservedTable(DEVICE)
    v, u = np.mgrid[0:36, 0:30].reshape(2, -1)
    direction, d = rays_at(seen, v, u)
    if observes == "half":
        for one in (voxels, table):
            one.add((direction * d[:, None])[d > 0].astype(np.float32), ELSEWHERE)
    count, shown = 500, DeviceFrame.of(frame, DEVICE)
    grid = grid_cells(shown, count, config)
    order, jitter = np.random.default_rng(1).permutation(grid), numbers(count, 3)
    corners = np.array([500, 700, -1, 901, -1])
    there = (torch.from_numpy(a).to(DEVICE) for a in (corners if fus else corners[:0], order))
    found = choose(shown, CAMERA, config, *there, jitter, table, torch.from_numpy(ELSEWHERE).to(DEVICE))

    share = jitter.cpu().numpy()
    if fus:
        rows = round(np.ceil(np.sqrt(count * 32 / 44)))
        v, u = in_grid(order[(np.arange(count) + int(share[0, 2] * grid)) % grid], rows, grid // rows, share)
        first = np.flatnonzero(corners >= 0)
        v[first], u[first] = corners[first] // 48, corners[first] % 48
    else:
        v, u = in_grid(np.zeros(count, int), 1, 1, share)
    direction, d = rays_at(frame, v, u)
    known = voxels.contains((direction * d[:, None]) @ ELSEWHERE[:3, :3].T + ELSEWHERE[:3, 3]) & (d > 0)
    keep = np.flatnonzero(known if known.sum() >= LEAST_KNOWN else d > 0)
    assert (known.sum() >= LEAST_KNOWN) == (observes == "half" and not blind)
    keep = keep if len(keep) else np.zeros(1, int)
    taken = np.resize(keep, count)
    np.testing.assert_allclose(found.direction.cpu(), direction[taken], atol=1e-6)
    np.testing.assert_array_equal(found.depth.cpu(), d[taken].astype(np.float32))
    np.testing.assert_array_equal(found.color.cpu(), frame.color[v, u][taken])
    np.testing.assert_array_equal(found.feature.cpu(), np.isin(taken, np.flatnonzero(corners >= 0)) & fus)


def test_voxels_are_hashed_as_they_are_marked():
    """Both sides of every boundary, far from the origin, in all octants."""
    table, camera = ObservedTable(DEVICE), Intrinsics(1.0, 1.0, 0.0, 0.0, 64, 1)
    rng = np.random.default_rng(0)
    shift = pose((0, 0, 0), rng.uniform(-900, 900, 3))
    depth = (VOXEL_M * rng.integers(10, 60, (1, 64)) + rng.choice([-1e-4, 1e-4], (1, 64))).astype(np.float32)
    shown = DeviceFrame(torch.zeros(1, 64, 3, dtype=torch.uint8, device=DEVICE), torch.from_numpy(depth).to(DEVICE))
    config = Config(border_px=0, depth_near_m=0.1, depth_far_m=9.0, fus=False)
    u = np.arange(0, 64, 2)
    table.add(np.stack([u * depth[0, u], 0 * u, depth[0, u]], 1).astype(np.float32), shift)
    jitter = torch.stack([torch.zeros(64), (torch.arange(64) + 0.5) / 64, torch.zeros(64)], 1).to(DEVICE)
    none, least = torch.zeros(0, dtype=torch.int64, device=DEVICE), LEAST_KNOWN
    marks = tracking_gpu.Marks(table.marks.view(torch.uint8), len(table.marks), 1 / VOXEL_M)
    cells = tracking_gpu.Cells(64, 0, 1, 0, 63, 1.0, 64.0)
    lens = tracking_gpu.Lens(camera.fx, camera.fy, camera.cx, camera.cy, config.depth_near_m, config.depth_far_m)
    there = torch.from_numpy(shift).to(DEVICE)
    found = tracking_gpu.chosen(shown.color, shown.depth, jitter, none, None, cells, lens, marks, there, 1)
    assert least > 64
    np.testing.assert_array_equal(np.unique(found.direction[:, 0].cpu()), u)
