"""Fields, rays and weights that the kernel tests share, and how they compare."""

from dataclasses import fields

import numpy as np
import torch

from ecslam.config import FieldConfig
from ecslam.field import TsdfField, create_field, map_params
from ecslam.kernels import AlignSettings, FieldParams, RayBatch, Weights

BOX = np.array([[-1.5, -1.2, -1.0], [1.6, 1.1, 1.2]])
WEIGHTS = Weights(
    free_space=5, centre=200, tail=10, depth_uniform=0.1, depth_feature=0.2, colour_uniform=5, colour_feature=4,
    truncation_m=0.06, centre_share=0.4,
)  # fmt: skip
ALIGN = AlignSettings(
    truncation_m=0.06, kernel_m=0.02, tsdf_limit=0.95, gradient_low=0.0, gradient_high=1e3, colour_weight=0.1,
    colour_kernel=0.1,
)  # fmt: skip


def make_field(config: FieldConfig | None = None, seed: int = 0) -> TsdfField:
    """A field of random features, some levels dense and some hashed."""
    config = config or FieldConfig(log2_table_size=12, init_scale=0.1)
    return create_field(config, BOX, seed, torch.device("cpu"))


def make_poses(count: int, generator: torch.Generator) -> torch.Tensor:
    """Camera-to-world matrices [P, 4, 4] near the middle of the box."""
    rotation, _ = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator))
    c2w = torch.eye(4).repeat(count, 1, 1)
    c2w[:, :3, :3] = rotation * torch.linalg.det(rotation)[:, None, None]
    c2w[:, :3, 3] = torch.rand(count, 3, generator=generator) - 0.5
    return c2w


def make_rays(count: int, samples: int, poses: int = 3, seed: int = 0) -> tuple[torch.Tensor, RayBatch]:
    """Poses and rays: a fifth has no depth, a third is at features, some samples lie outside the box."""
    g = torch.Generator().manual_seed(seed)
    direction = torch.cat([torch.rand(count, 2, generator=g) - 0.5, torch.ones(count, 1)], 1)
    depth = 0.4 + torch.rand(count, generator=g)
    near = depth[:, None] + 0.15 * (torch.rand(count, samples // 2, generator=g) - 0.5)
    z = torch.cat([torch.rand(count, samples - samples // 2, generator=g) * 2 + 0.05, near], 1).sort(1).values
    depth[torch.rand(count, generator=g) < 0.2] = 0
    pose = torch.randint(poses, (count,), generator=g).sort().values
    feature = torch.rand(count, generator=g) < 0.3
    return make_poses(poses, g), RayBatch(direction, z, depth, torch.rand(count, 3, generator=g), feature, pose)


def make_points(count: int, seed: int = 0) -> torch.Tensor:
    """Points [N, 3], some of them outside the box."""
    low, high = torch.from_numpy(BOX).float()
    return low - 0.2 + (high - low + 0.4) * torch.rand(count, 3, generator=torch.Generator().manual_seed(seed))


def double(value):
    """The same dataclass of tensors in float64."""
    parts = (getattr(value, f.name) for f in fields(value))
    return type(value)(*(t.double() if t.is_floating_point() else t for t in parts))


def blank(params: FieldParams) -> FieldParams:
    """Buffers for gradients, full of rubbish that must not survive."""
    return map_params(params, lambda t: torch.full_like(t, 1e3))


def relative_rms(found: torch.Tensor, expected: torch.Tensor) -> float:
    """Root mean square of the difference over that of the expected value; 0 where both are zero."""
    assert found.shape == expected.shape
    found, expected = found.double(), expected.double()
    if not expected.numel() or not (found - expected).abs().max():
        return 0.0
    return float(((found - expected).pow(2).mean() / expected.pow(2).mean()).sqrt())
