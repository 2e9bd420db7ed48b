"""Averaging a view into the fused volume against the same in plain numpy."""

from dataclasses import replace

import numpy as np
import pytest
from planes import POSES, SWEEP, TINY_CAMERA, noisy_corner

from ecslam.kernels import fusion, fusion_views
from ecslam.kernels.fusion import CELLS, Blocks
from ecslam.volume import FusedVolume

CAMERA = replace(TINY_CAMERA, fy=47.0)
VOXEL_M, BAND_M = 0.03, 0.11


def lattice(place):
    """The voxels [N, 512, 3] of the blocks ``place`` [N] in the world."""
    block = np.stack([place >> (2 * fusion.BITS), (place >> fusion.BITS) & fusion.MASK, place & fusion.MASK], 1)
    cell = np.stack(np.meshgrid(*[np.arange(8)] * 3, indexing="ij"), -1)[..., ::-1].reshape(-1, 3)
    return VOXEL_M * ((block[:, None] - fusion.HALF) * 8 + cell)


def view_of(seen, camera, c2w, sweep):
    """What a volume makes of a frame before it averages it in."""
    numbers, (height, width) = (camera.fx, camera.fy, camera.cx, camera.cy), seen.depth.shape
    normals = np.empty((-(-height // 2), -(-width // 2), 3), np.float32)
    fusion_views.normals(seen.depth, numbers, normals, 0, len(normals))
    light = seen.color[..., 0] / np.float32(255)
    return fusion_views.View(seen.depth, light, normals, numbers, c2w, tuple(sweep))


def averaged(place, voxels, view, sweep):
    """The voxels int16 [N, 512, 3] after a view: what ``fusion_views.integrate`` makes of them, written to be read."""
    height, width = view.depth.shape
    (fx, fy, cx, cy), c2w = view.camera, view.c2w
    local = (lattice(place) - c2w[:3, 3]) @ c2w[:3, :3]
    ahead = np.maximum(local[..., 2], fusion_views.NEAREST_M)
    read = np.clip((fy * local[..., 1] / ahead + cy + 0.5) / height - 0.5, -0.5, 0.5)
    local = local - read[..., None] * (sweep[:3] + np.cross(sweep[3:], local))
    x, y, z = np.moveaxis(local, -1, 0)
    ahead = np.maximum(z, fusion_views.NEAREST_M)
    u, v = (np.floor(f * a / ahead + c + 0.5) for f, a, c in ((fx, x, cx), (fy, y, cy)))
    inside = (z > fusion_views.NEAREST_M) & (u >= 0) & (v >= 0) & (u < width) & (v < height)
    row, column = (np.where(inside, a, 0).astype(int) for a in (v, u))
    d, n = view.depth[row, column].astype(np.float64), view.normal[row // 2, column // 2].astype(np.float64)
    measured = np.stack([(u - cx) / fx * d, (v - cy) / fy * d, d], -1)
    distance = ((local - measured) * n).sum(-1) / BAND_M
    distance = np.where(d - z > 2 * BAND_M, 1.0, distance)
    changed = inside & (d > 0) & (d >= z - 2 * BAND_M) & (distance >= -1)
    facing = -(measured * n).sum(-1) / np.maximum(np.linalg.norm(measured, axis=-1), 1e-9)
    steps = np.floor(fusion_views.WEIGHT_STEPS * np.maximum(facing, 0) / np.maximum(1, d * d) + 0.5)
    added = np.where(changed, np.maximum(1, steps), 0)
    held = voxels.astype(np.float64)
    share = added / np.maximum(held[..., 2] + added, 1)
    light = view.light[row, column].astype(np.float64)
    near = np.abs(distance) < 1
    out = held.copy()
    out[..., 0] += np.rint(share * (np.minimum(distance, 1) * fusion.SCALE - held[..., 0]))
    out[..., 1] += np.where(near, np.rint(share * (light * fusion.SCALE - held[..., 1])), 0)
    out[..., 2] = np.minimum(held[..., 2] + added, fusion_views.MAX_WEIGHT)
    return np.where(changed[..., None], out, held).astype(np.int16)


@pytest.mark.parametrize("sweep", [np.zeros(6), SWEEP], ids=["still", "moving"])
@pytest.mark.parametrize("width", [48, 47])
def test_views_are_averaged_in_as_written_to_be_read(width, sweep):
    camera, volume = replace(CAMERA, width=width), FusedVolume(VOXEL_M, BAND_M)
    for c2w in POSES:
        volume.integrate(noisy_corner(c2w, camera), camera, c2w, 0.1, 8.0)
    place = volume.state()["place"]
    voxels, rows = np.zeros((len(place), CELLS, 3), np.int16), np.arange(len(place))
    blocks = Blocks(np.empty(0, np.int64), np.empty(0, np.int32), place, voxels)
    for c2w in POSES * 2:
        before, view = voxels.copy(), view_of(noisy_corner(c2w, camera), camera, c2w, sweep)
        fusion_views.integrate(blocks, rows, view, VOXEL_M, BAND_M)
        expected = averaged(place, before, view, sweep)
        assert (expected != before).any(2).sum() > 30_000
        off = (np.abs(voxels.astype(int) - expected) > 1).any(2)
        assert off.sum() <= 2, "a voxel on the border between two pixels may be seen by either, but by no others"
