"""Mapping: joint optimisation of the map and the poses in the window (paper, section III-B, global BA)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from .config import Config
from .field import TsdfField, grow_field, map_params, regrow
from .kernels import LOSS_NAMES, Backend
from .losses import smoothness_gradient
from .pixels import Pixels
from .pose_adam import PoseAdam
from .rays import gather, kernel_weights, make_rays
from .samples import resample_missing

BETAS = (0.9, 0.99)
EPSILON = 1e-15
MIN_BETA = 1.0


@dataclass(frozen=True)
class MapResult:
    """c2w: float64 [W, 4, 4] refined poses of the views. losses: weighted terms of the last iteration; loss_first: the
    objective of the first one."""

    c2w: NDArray[np.float64]
    losses: dict[str, float]
    loss_first: float


class Mapper:
    """Owns the field and its Adam state; the only writer of both."""

    def __init__(self, field: TsdfField, kernels: Backend, config: Config, seed: int) -> None:
        self.field, self.kernels = field, kernels
        self._rng = np.random.default_rng(seed)
        self._generator = torch.Generator().manual_seed(seed)
        self._gradients = map_params(field.params, torch.zeros_like)
        self._optimiser = self._make_optimiser(config)

    def _make_optimiser(self, config: Config) -> torch.optim.Adam:
        p, g = self.field.params, self._gradients
        pairs = [(p.table, g.table), (p.w_in, g.w_in), (p.w_sdf, g.w_sdf), (p.w_rgb, g.w_rgb), (p.beta, g.beta)]
        for tensor, gradient in pairs:
            tensor.grad = gradient
        m = config.mapping
        groups = [
            {"params": [p.table], "lr": m.lr_grid},
            {"params": [tensor for tensor, _ in pairs[1:]], "lr": m.lr_decoder},
        ]
        return torch.optim.Adam(groups, betas=BETAS, eps=EPSILON, fused=True)

    def run(
        self,
        views: Sequence[Pixels],
        c2w: NDArray[np.float64],
        fixed: NDArray[np.bool_],
        iterations: int,
        config: Config,
        interrupt: Callable[[], None] | None = None,
        smooth: bool = False,
    ) -> MapResult:
        """Optimise the map and the poses c2w [W, 4, 4] of the views where not ``fixed`` [W].

        The rays of all iterations are drawn at once; every iteration transforms its share by the current poses.
        """
        m, field, device = config.mapping, self.field, self.field.device
        poses = PoseAdam(torch.from_numpy(c2w).to(device), m.lr_rotation, m.lr_translation)
        poses.fix(torch.from_numpy(np.flatnonzero(fixed)).to(device))
        weights, move = kernel_weights(m.loss, config), not fixed.all()
        first = last = torch.zeros(len(LOSS_NAMES), device=device)
        for iteration in range(iterations):
            if interrupt is not None:
                interrupt()
            pixels, row = gather(views, self._pick(views, m.rays))
            rays = make_rays(pixels, row, poses.c2w, field.layout.box, config, self._generator, device)
            rays = resample_missing(rays, poses.c2w.float(), field, self.kernels, config.sampling, self._generator)
            result = self.kernels.step(
                field.layout, field.params, poses.c2w.float(), rays, weights, self._gradients, move
            )
            if smooth and m.smooth_weight > 0:
                self._gradients.table.add_(smoothness_gradient(field, m, self._generator))
            self._optimiser.step()
            field.params.beta.clamp_(min=MIN_BETA)
            if result.d_c2w is not None:
                poses.step(result.d_c2w)
            last = result.losses
            first = last if iteration == 0 else first
        losses = dict(zip(LOSS_NAMES, last.tolist(), strict=True))
        return MapResult(poses.c2w.cpu().numpy(), losses, float(first.sum()))

    def _pick(self, views: Sequence[Pixels], rays: int) -> list[NDArray[np.int64]]:
        """An equal share of the rays for every view."""
        share = -(-rays // len(views))
        return [self._rng.integers(0, len(view), share) for view in views]

    def grow(self, box: NDArray[np.float64], config: Config) -> None:
        """Extend the field to the union of its box and ``box`` [2, 3]; values inside and the Adam state are kept."""
        old, moments = self.field, self._optimiser.state_dict()["state"]
        self.field = grow_field(old, box)
        self._gradients = map_params(self.field.params, torch.zeros_like)
        self._optimiser = self._make_optimiser(config)
        table = old.params.table.shape
        carried = {
            i: {k: regrow(old.layout, self.field.layout, v) if v.shape == table else v for k, v in state.items()}
            for i, state in moments.items()
        }
        self._optimiser.load_state_dict(
            {"state": carried, "param_groups": self._optimiser.state_dict()["param_groups"]}
        )
