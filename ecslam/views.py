"""Looking at the map: numpy callables for meshing, and rendered pictures from any pose."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from .config import Config
from .field import TsdfField
from .kernels import Backend, RayBatch
from .kernels.reference_depths import stratified
from .types import Intrinsics

CHUNK_POINTS = 1 << 18
CHUNK_RAYS = 1 << 13

SdfQuery = Callable[[NDArray[np.float32]], NDArray[np.float32]]
ColorQuery = Callable[[NDArray[np.float32]], NDArray[np.uint8]]


def queries(field: TsdfField, kernels: Backend) -> tuple[SdfQuery, ColorQuery]:
    """TSDF (in truncations, negative inside) and colour (uint8 RGB) of world points float32 [N, 3]."""

    def evaluate(points: NDArray[np.float32]) -> tuple[torch.Tensor, torch.Tensor]:
        parts = torch.from_numpy(np.ascontiguousarray(points, np.float32)).split(CHUNK_POINTS)
        found = [kernels.values(field.layout, field.params, part.to(field.device)) for part in parts]
        return torch.cat([sdf for sdf, _ in found]), torch.cat([rgb for _, rgb in found])

    def sdf(points: NDArray[np.float32]) -> NDArray[np.float32]:
        return evaluate(points)[0].cpu().numpy()

    def color(points: NDArray[np.float32]) -> NDArray[np.uint8]:
        return (evaluate(points)[1] * 255 + 0.5).byte().cpu().numpy()

    return sdf, color


def render_view(
    field: TsdfField,
    kernels: Backend,
    camera: Intrinsics,
    c2w: NDArray[np.float64],
    depth: NDArray[np.float32],
    config: Config,
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Colour uint8 [H, W, 3] and depth float32 [H, W] metres as the map sees them from c2w [4, 4].

    Samples lie along the whole ray and, where ``depth`` [H, W] > 0 gives a guess, densely around it.
    """
    v, u = np.divmod(np.arange(camera.width * camera.height), camera.width)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(len(u))], 1)
    direction = torch.from_numpy(rays.astype(np.float32)).to(field.device)
    pose = torch.from_numpy(c2w.astype(np.float32))[None].to(field.device)
    measured = torch.from_numpy(depth.reshape(-1)).to(field.device)
    s = config.sampling
    middle = torch.full((1, s.uniform), 0.5, device=field.device)
    around = torch.linspace(-1, 1, s.near_depth, device=field.device) * s.depth_range_m
    colors, depths = [], []
    for part, near in zip(direction.split(CHUNK_RAYS), measured.split(CHUNK_RAYS), strict=True):
        has = (near > 0)[:, None]
        end = torch.where(has[:, 0], near + s.depth_range_m, torch.full_like(near, config.depth_far_m))
        z_even = stratified(torch.full_like(near, s.near_m), end, s.uniform, middle)
        z_near = torch.where(has, near[:, None] + around, end[:, None] * (1 + 0.01 * around.abs()))
        z = torch.cat([z_even, z_near], 1).clamp_min(1e-3).sort(1).values
        zero = torch.zeros(len(part), device=field.device)
        batch = RayBatch(part, z, zero, torch.zeros_like(part), zero > 0, zero.long())
        color, rendered, _ = kernels.render(field.layout, field.params, pose, batch)
        colors.append((color * 255 + 0.5).clamp(0, 255).byte().cpu())
        depths.append(rendered.cpu())
    size = (camera.height, camera.width)
    return torch.cat(colors).numpy().reshape(*size, 3), torch.cat(depths).numpy().reshape(size)
