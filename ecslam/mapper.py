"""Mapping: joint optimisation of the map and the poses in the window (paper, section III-B, global BA)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .config import Config
from .draws import Desk, DeviceDraw, DeviceViews, Draw, HostDraw
from .field import TsdfField, grow_field, map_params, regrow
from .field_adam import FieldAdam
from .kernels import LOSS_NAMES, Backend, FieldParams, Weights
from .kernels.graphs import Recorder
from .pixel_bank import PixelBank
from .pixels import Pixels
from .pose_adam import PoseAdam, pose_rates
from .rays import kernel_weights
from .samples import seeded, smooth_lattice
from .saving import Arrays, pack_field, pack_random, part, prefixed, unpack_field, unpack_random
from .sending import Since

MIN_BETA = 1.0
CHUNK = 10  # iterations in a CUDA graph where no pose moves


@dataclass(frozen=True)
class MapResult:
    """c2w: float64 [W, 4, 4] refined poses of the views. losses: weighted terms of the last iteration; loss_first: the
    objective of the first one. took_s: seconds. failed: NaN or infinity came up, so map and poses are as before."""

    c2w: NDArray[np.float64]
    losses: dict[str, float]
    loss_first: float
    took_s: float
    failed: bool = False


class Mapping:
    """A mapping that has begun, see ``Mapper.begin``; on a GPU its result arrives by itself."""

    def __init__(self, c2w: NDArray[np.float64], told: Tensor, since: Since, undo: Callable[[], None]) -> None:
        """told: float64 [16 W + 11], the poses [W, 4, 4], the loss terms of the first and the last iteration [5] each,
        and whether all is finite."""
        self._c2w, self._since, self._undo, self._told = c2w, since, undo, since.bring(told)

    def done(self) -> bool:
        """Whether ``result`` need not wait."""
        return self._since.done()

    def result(self) -> MapResult:
        """What came of it; waits for it."""
        took_s, told = self._since.seconds(), self._told
        if not told[-1]:
            self._undo()
            return MapResult(self._c2w, {}, float("nan"), took_s, failed=True)
        first, last = told[self._c2w.size : -1].float().view(2, -1)
        poses = told[: self._c2w.size].view(self._c2w.shape).numpy()
        return MapResult(poses, dict(zip(LOSS_NAMES, last.tolist(), strict=True)), float(first.sum()), took_s)


def _tensors(params: FieldParams) -> list[Tensor]:
    return [params.table, params.w_in, params.w_sdf, params.w_rgb, params.beta]


@dataclass(frozen=True)
class Job:
    """What all iterations of a mapping have in common. move: whether any pose does. smooth, settle: see
    ``Mapper.begin``."""

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
        self._desk, self._box = Desk(0, 0, field.device), field.layout.box.to(field.device)

    def begin(
        self,
        views: Sequence[Pixels],
        c2w: NDArray[np.float64],
        fixed: NDArray[np.bool_],
        iterations: int,
        config: Config,
        interrupt: Callable[[], None] | None = None,
        smooth: bool = False,
        settle: bool = False,
    ) -> Mapping:
        """Optimise the map and the poses c2w [W, 4, 4] of the views where not ``fixed`` [W]. On a GPU that is only on
        its way when this returns; one at a time. Where it comes to nothing, all is put back when its result is asked
        for.

        Every iteration draws its rays from the stored pixels and transforms them by the current poses. smooth: with the
        smoothness term. settle: the map's learning rates fade to none, as those of the poses always do.
        """
        since, before = Since(self.field.device), self._backup()
        job = Job(config, bool(not fixed.all()), smooth, settle)
        interrupt = interrupt or (lambda: None)
        if self.field.device.type == "cpu":
            draw = HostDraw(views, config, self.field, self.kernels, self._rng, self._generator)
            left = [1 - i / iterations for i in range(iterations)]
            moved, losses = self._iterate(job, draw, torch.from_numpy(c2w), job.pose_rates(fixed), left, interrupt)
            sound = self._sound(moved)
        else:
            moved, losses, sound = self._on_device(job, views, c2w, fixed, iterations, interrupt)
        told = torch.cat([moved.reshape(-1), losses[0].to(moved), losses[-1].to(moved), sound.to(moved)])
        return Mapping(c2w, told, since, lambda: torch._foreach_copy_(self._learnt(), before))

    def _on_device(
        self,
        job: Job,
        views: Sequence[Pixels],
        c2w: NDArray[np.float64],
        fixed: NDArray[np.bool_],
        iterations: int,
        interrupt: Callable[[], None],
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The poses [W, 4, 4], the loss terms [I, 5] of iterations, ``CHUNK`` (with moving poses all) in a graph, and
        whether all is finite [1]; ``interrupt`` is called between graphs."""
        config, m, device, losses = job.config, job.config.mapping, self.field.device, []
        room = max(len(views), config.window.size)
        if (self._desk.poses, self._desk.rays) != (room, m.rays):
            self._desk = Desk(room, m.rays, device)
        rates = job.pose_rates(fixed).numpy()
        chosen = self._desk.lay_out(self._bank, views, c2w, rates, m.newest_share, self._box)
        # Triton compiles some kernels once for sizes that are multiples of 16 and once for others.
        aligned = self.field.params.table.numel() % 16 == 0
        generator, recorder = seeded(self._rng, device), Recorder(plain=True) if job.smooth else self.recorder
        for left in _fading(iterations, device).split(max(iterations, 1) if job.move else CHUNK):
            interrupt()
            jitter = self._desk.jitter(len(left), chosen.jitter(config), generator)
            poses, found, sound = recorder(
                partial(self._loop, job, chosen, jitter),
                left,
                key=(id(config), job.move, job.smooth, job.settle, chosen.missing, aligned),
                over=(self.field, self._optimiser, config, chosen.pixels, chosen.numbers, chosen.row, jitter),
                lent=True,
            )
            losses.append(found.clone())
        return poses[: len(views)], torch.cat(losses), sound

    def _loop(self, job: Job, views: DeviceViews, jitter: Tensor, left: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Iterations as a function of tensors. left: [I]; jitter: [I, R, numbers]."""
        draw = DeviceDraw(views, jitter, views.c2w, job.config, self.field, self.kernels)
        poses, losses = self._iterate(job, draw, views.c2w, views.rates, left.unbind(), lambda: None)
        return poses, losses, self._sound(poses)

    def _sound(self, poses: Tensor) -> Tensor:
        """Whether all that was learnt is finite, bool [1]."""
        return torch.stack([*torch._foreach_norm(self._learnt()), poses.float().norm()]).isfinite().all()[None]

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
        """Extend the field to the union of its box and ``box`` [2, 3]; values inside and the Adam state are kept. Looks
        at no point of it, so that the kernels know the new layout before a graph is recorded that uses it."""
        old = self.field
        self.field = grow_field(old, box)
        self._box = self.field.layout.box.to(old.device)
        self._gradients = map_params(self.field.params, torch.zeros_like)
        table = self.field.params.table

        def change(moment: Tensor, parameter: Tensor) -> Tensor:
            return regrow(old.layout, self.field.layout, moment) if parameter is table else moment

        self._optimiser = self._optimiser.moved(_tensors(self.field.params), change)
        self.kernels.values(self.field.layout, self.field.params, table.new_empty(0, 3))


@cache
def _fading(iterations: int, device: torch.device) -> Tensor:
    """The share of the iterations that remains at each of them [I]."""
    return (1 - torch.arange(iterations) / iterations).to(device, non_blocking=True)
