"""Mapping: joint optimisation of the map and the poses in the window (paper, section III-B, global BA)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .config import Config
from .draws import DeviceDraw, DeviceViews, Draw, HostDraw, device_views, padded
from .field import TsdfField, grow_field, map_params, regrow
from .field_adam import FieldAdam
from .kernels import LOSS_NAMES, Backend, DevicePixels, FieldParams, Weights
from .kernels.graphs import Recorder
from .pixel_bank import PixelBank
from .pixels import Pixels
from .pose_adam import PoseAdam, pose_rates
from .rays import kernel_weights
from .samples import seeded, smooth_lattice, uniform
from .saving import Arrays, pack_field, pack_random, part, prefixed, unpack_field, unpack_random

MIN_BETA = 1.0
CHUNK = 10  # iterations in a CUDA graph where no pose moves


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


@dataclass(frozen=True)
class Job:
    """What all iterations of a run have in common. move: whether any pose does. smooth, settle: see ``Mapper.run``."""

    config: Config
    move: bool
    smooth: bool
    settle: bool

    @property
    def weights(self) -> Weights:
        """Loss weights."""
        return kernel_weights(self.config.mapping.loss, self.config)

    def pose_rates(self, fixed: NDArray[np.bool_]) -> Tensor:
        """Learning rates [W, 6] of poses of which some are ``fixed`` [W]."""
        m = self.config.mapping
        return pose_rates(torch.from_numpy(fixed), m.lr_rotation, m.lr_translation)

    def map_rates(self, left: float | Tensor) -> tuple[float | Tensor, float | Tensor]:
        """Learning rates of the grid and of the map's other parameters when the share ``left`` of the iterations
        remains."""
        m, share = self.config.mapping, left if self.settle else 1.0
        return share * m.lr_grid, share * m.lr_decoder


class Mapper:
    """Owns the field and its Adam state; the only writer of both.

    On a GPU the iterations are one CUDA graph, or a few, that never wait for the host.
    """

    def __init__(self, field: TsdfField, kernels: Backend, seed: int, recorder: Recorder | None = None) -> None:
        self.field, self.kernels, self.recorder = field, kernels, recorder or Recorder()
        self._rng = np.random.default_rng(seed)
        self._generator = torch.Generator().manual_seed(seed)
        self._gradients = map_params(field.params, torch.zeros_like)
        self._optimiser = FieldAdam(_tensors(field.params))
        self._bank, self._spare = PixelBank(field.device), [torch.zeros(0)]

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
        before = self._backup()
        job = Job(config, bool(not fixed.all()), smooth, settle)
        interrupt = interrupt or (lambda: None)
        if self.field.device.type == "cpu":
            draw = HostDraw(views, config, self.field, self.kernels, self._rng, self._generator)
            left = [1 - i / iterations for i in range(iterations)]
            moved, losses = self._iterate(job, draw, torch.from_numpy(c2w), job.pose_rates(fixed), left, interrupt)
        else:
            moved, losses = self._on_device(job, views, c2w, fixed, iterations, interrupt)
        sound = torch.stack([*torch._foreach_norm(self._learnt()), moved.float().norm()]).isfinite().all()
        told = torch.cat([moved.reshape(-1), losses[0].to(moved), losses[-1].to(moved), sound[None].to(moved)]).cpu()
        if not told[-1]:
            torch._foreach_copy_(self._learnt(), before)
            return MapResult(c2w, {}, float("nan"), failed=True)
        first, last = told[c2w.size : -1].float().view(2, -1)
        poses = told[: c2w.size].view(c2w.shape).numpy()
        return MapResult(poses, dict(zip(LOSS_NAMES, last.tolist(), strict=True)), float(first.sum()))

    def _on_device(
        self,
        job: Job,
        views: Sequence[Pixels],
        c2w: NDArray[np.float64],
        fixed: NDArray[np.bool_],
        iterations: int,
        interrupt: Callable[[], None],
    ) -> tuple[Tensor, Tensor]:
        """The poses [W, 4, 4] and the loss terms [I, 5] of iterations, ``CHUNK`` (with moving poses all) in a graph;
        ``interrupt`` is called between graphs."""
        device, count = self.field.device, max(len(views), job.config.window.size)
        generator = seeded(self._rng, device)
        still = np.arange(count) >= len(views)
        still[: len(views)] |= fixed
        given = torch.from_numpy(padded(c2w, count)), job.pose_rates(still), 1 - torch.arange(iterations) / iterations
        poses, rates, left = (t.to(device, non_blocking=True) for t in given)
        chosen, losses = device_views(self._bank, views, count, job.config, self.field.layout.box, device), []
        recorder = Recorder(plain=True) if job.smooth else self.recorder
        for part_left in left.split(max(iterations, 1) if job.move else CHUNK):
            interrupt()
            jitter = uniform(generator, device, len(part_left), len(chosen.row), chosen.numbers(job.config))
            inputs = (poses, rates, part_left, chosen.spans, chosen.row, chosen.box, jitter)
            poses, found = recorder(
                partial(self._loop, job, chosen.pixels, chosen.missing),
                *inputs,
                key=(job, chosen.missing),
                over=(self.field, self._optimiser, chosen.pixels),
            )
            losses.append(found)
        return poses[: len(views)], torch.cat(losses)

    def _loop(
        self,
        job: Job,
        pixels: DevicePixels,
        missing: bool,
        c2w: Tensor,
        rates: Tensor,
        left: Tensor,
        spans: Tensor,
        row: Tensor,
        box: Tensor,
        jitter: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Iterations as a function of tensors. left: [I]; jitter: [I, R, numbers]; the rest: see ``DeviceViews``."""
        views = DeviceViews(pixels, spans, row, box, missing)
        draw = DeviceDraw(views, jitter, c2w, job.config, self.field, self.kernels)
        return self._iterate(job, draw, c2w, rates, left.unbind(), lambda: None)

    def _iterate(
        self,
        job: Job,
        draw: Draw,
        c2w: Tensor,
        rates: Tensor,
        left: Sequence[float | Tensor],
        interrupt: Callable[[], None],
    ) -> tuple[Tensor, Tensor]:
        """One iteration for each share in ``left`` of the learning rates: the poses and the loss terms [I, 5]."""
        m, field, kernels = job.config.mapping, self.field, self.kernels
        learnt, gradients = _tensors(field.params), _tensors(self._gradients)
        smooth = job.smooth and m.smooth_weight > 0
        poses, losses = PoseAdam(c2w, rates, kernels=kernels), []
        for iteration, share in enumerate(left):
            interrupt()
            now = poses.c2w.float()
            rays = draw(iteration, now)
            of_table, of_others = self._optimiser.steps(*job.map_rates(share))
            given = field.layout, field.params, now, rays, job.weights, self._gradients, job.move
            result = kernels.step(*given, None if smooth else of_table)
            if smooth:
                lattice = smooth_lattice(field, m, self._generator)
                gradient = kernels.smoothness(field.layout, field.params.table, lattice)
                self._gradients.table.add_(gradient, alpha=m.smooth_weight)
                kernels.map_step(learnt[:1], gradients[:1], of_table)
            kernels.map_step(learnt[1:], gradients[1:], of_others)
            field.params.beta.clamp_(min=MIN_BETA)
            if result.d_c2w is not None:
                poses.step(result.d_c2w, share)
            losses.append(result.losses)
        return poses.c2w, torch.stack(losses or [torch.zeros(len(LOSS_NAMES), device=c2w.device)])

    def _backup(self) -> list[Tensor]:
        """Copies of all that is learnt, where those of the last run were."""
        learnt = self._learnt()
        if [t.shape for t in self._spare] != [t.shape for t in learnt]:
            self._spare = [torch.empty_like(t) for t in learnt]
        torch._foreach_copy_(self._spare, learnt)
        return self._spare

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
    def restore(cls, state: Arrays, kernels: Backend, device: torch.device, recorder: Recorder | None = None) -> Mapper:
        """The inverse of ``state``."""
        self = cls(unpack_field(part("field", state), device), kernels, 0, recorder)
        unpack_random(part("random", state), self._rng, self._generator)
        found = {k: torch.from_numpy(v.copy()).to(device) for k, v in part("adam", state).items()}
        adam = self._optimiser
        adam.mean = [found[f"mean{i}"] for i in range(len(adam.parameters))]
        adam.square = [found[f"square{i}"] for i in range(len(adam.parameters))]
        adam.count = found["count"]
        return self

    def grow(self, box: NDArray[np.float64]) -> None:
        """Extend the field to the union of its box and ``box`` [2, 3]; values inside and the Adam state are kept."""
        old = self.field
        self.field = grow_field(old, box)
        self._gradients = map_params(self.field.params, torch.zeros_like)
        table = self.field.params.table

        def change(moment: Tensor, parameter: Tensor) -> Tensor:
            return regrow(old.layout, self.field.layout, moment) if parameter is table else moment

        self._optimiser = self._optimiser.moved(_tensors(self.field.params), change)
