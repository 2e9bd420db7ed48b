"""Mapping: joint optimisation of the map and the poses in the window (paper, section III-B, global BA)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .config import Config
from .field import TsdfField, grow_field, map_params, regrow
from .field_adam import FieldAdam
from .kernels import LOSS_NAMES, Backend, FieldParams
from .losses import smooth_lattice, smoothness
from .pixels import Pixels
from .pose_adam import PoseAdam
from .rays import gather, kernel_weights, make_rays
from .samples import resample_missing
from .saving import Arrays, pack_field, pack_random, part, prefixed, unpack_field, unpack_random

MIN_BETA = 1.0


@dataclass(frozen=True)
class MapResult:
    """c2w: float64 [W, 4, 4] refined poses of the views. losses: weighted terms of the last iteration; loss_first: the
    objective of the first one. failed: NaN or infinity came up, so map and poses are as they were before."""

    c2w: NDArray[np.float64]
    losses: dict[str, float]
    loss_first: float
    failed: bool = False


def _tensors(params: FieldParams) -> list[Tensor]:
    return [params.table, params.w_in, params.w_sdf, params.w_rgb, params.beta]


class Mapper:
    """Owns the field and its Adam state; the only writer of both."""

    def __init__(self, field: TsdfField, kernels: Backend, seed: int) -> None:
        self.field, self.kernels = field, kernels
        self._rng = np.random.default_rng(seed)
        self._generator = torch.Generator().manual_seed(seed)
        self._gradients = map_params(field.params, torch.zeros_like)
        self._optimiser = FieldAdam(_tensors(field.params))

    def run(
        self,
        views: Sequence[Pixels],
        c2w: NDArray[np.float64],
        fixed: NDArray[np.bool_],
        iterations: int,
        config: Config,
        interrupt: Callable[[], None] | None = None,
        smooth: bool = False,
        settle: bool = False,
    ) -> MapResult:
        """Optimise the map and the poses c2w [W, 4, 4] of the views where not ``fixed`` [W].

        Every iteration draws its rays from the stored pixels and transforms them by the current poses. smooth: with the
        smoothness term. settle: the map's learning rates fade to none, as those of the poses always do.
        """
        m, field, device = config.mapping, self.field, self.field.device
        poses = PoseAdam(torch.from_numpy(c2w).to(device), m.lr_rotation, m.lr_translation)
        poses.fix(torch.from_numpy(np.flatnonzero(fixed)).to(device))
        weights, move = kernel_weights(m.loss, config), not fixed.all()
        first = last = torch.zeros(len(LOSS_NAMES), device=device)
        before = [t.clone() for t in self._learnt()]
        for iteration in range(iterations):
            if interrupt is not None:
                interrupt()
            pixels, row = gather(views, self._pick(views, m.rays, m.newest_share))
            rays = make_rays(pixels, row, poses.c2w, field.layout.box, config, self._generator, device)
            rays = resample_missing(rays, poses.c2w.float(), field, self.kernels, config.sampling, self._generator)
            result = self.kernels.step(
                field.layout, field.params, poses.c2w.float(), rays, weights, self._gradients, move
            )
            if smooth and m.smooth_weight > 0:
                _, gradient = smoothness(field, smooth_lattice(field, m, self._generator))
                self._gradients.table.add_(gradient, alpha=m.smooth_weight)
            left = 1 - iteration / iterations
            decoders = [m.lr_decoder] * (len(FieldParams.__dataclass_fields__) - 1)
            rates = [(left if settle else 1.0) * rate for rate in (m.lr_grid, *decoders)]
            self._optimiser.step(_tensors(self._gradients), rates)
            field.params.beta.clamp_(min=MIN_BETA)
            if result.d_c2w is not None:
                poses.step(result.d_c2w, left)
            last = result.losses
            first = last if iteration == 0 else first
        if not all(bool(torch.isfinite(t).all()) for t in (*self._learnt(), poses.c2w)):
            for tensor, kept in zip(self._learnt(), before, strict=True):
                tensor.copy_(kept)
            return MapResult(c2w, {}, float("nan"), failed=True)
        losses = dict(zip(LOSS_NAMES, last.tolist(), strict=True))
        return MapResult(poses.c2w.cpu().numpy(), losses, float(first.sum()))

    def _learnt(self) -> list[Tensor]:
        adam = self._optimiser
        return [*_tensors(self.field.params), *adam.mean, *adam.square, adam.count]

    def state(self) -> Arrays:
        """The field, the optimiser's moments and the random states, as copies."""
        adam = self._optimiser
        moments = {f"mean{i}": m for i, m in enumerate(adam.mean)} | {
            f"square{i}": s for i, s in enumerate(adam.square)
        }
        return {
            **prefixed("field", pack_field(self.field)),
            **prefixed("random", pack_random(self._rng, self._generator)),
            **prefixed("adam", {k: v.cpu().numpy().copy() for k, v in (moments | {"count": adam.count}).items()}),
        }

    @classmethod
    def restore(cls, state: Arrays, kernels: Backend, device: torch.device) -> Mapper:
        """The inverse of ``state``."""
        self = cls(unpack_field(part("field", state), device), kernels, 0)
        unpack_random(part("random", state), self._rng, self._generator)
        found = {k: torch.from_numpy(v.copy()).to(device) for k, v in part("adam", state).items()}
        adam = self._optimiser
        adam.mean = [found[f"mean{i}"] for i in range(len(adam.parameters))]
        adam.square = [found[f"square{i}"] for i in range(len(adam.parameters))]
        adam.count = found["count"]
        return self

    def _pick(self, views: Sequence[Pixels], rays: int, newest_share: float) -> list[NDArray[np.int64]]:
        """The newest view gets ``newest_share`` of the rays (an equal share if that is more), the others the rest."""
        newest = max(round(rays * newest_share), -(-rays // len(views)))
        older = -(-(rays - newest) // max(len(views) - 1, 1))
        counts = [older] * (len(views) - 1) + [newest]
        return [self._rng.integers(0, len(view), count) for view, count in zip(views, counts, strict=True)]

    def grow(self, box: NDArray[np.float64]) -> None:
        """Extend the field to the union of its box and ``box`` [2, 3]; values inside and the Adam state are kept."""
        old = self.field
        self.field = grow_field(old, box)
        self._gradients = map_params(self.field.params, torch.zeros_like)
        table = self.field.params.table

        def change(moment: Tensor, parameter: Tensor) -> Tensor:
            return regrow(old.layout, self.field.layout, moment) if parameter is table else moment

        self._optimiser = self._optimiser.moved(_tensors(self.field.params), change)
