"""The kernel seam: ten functions, one signature, three back ends.

``reference`` (torch, readable, any device), ``cpu`` (numba) and ``gpu`` (Triton). The device picks the back end;
``ECSLAM_KERNELS=reference`` or ``with kernels.use("reference")`` overrides. An explicit choice that cannot run raises
``InputError``; the automatic one falls back to the reference and ``select`` says why.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Protocol, cast

import torch
from torch import Tensor

from ..types import InputError
from .types import (
    LOSS_NAMES,
    AdamStep,
    AlignSettings,
    DevicePixels,
    FieldParams,
    GridLayout,
    NormalEquations,
    PoseMoments,
    RayBatch,
    Rules,
    StepResult,
    Weights,
)

__all__ = [
    "LOSS_NAMES",
    "AdamStep",
    "AlignSettings",
    "Backend",
    "DevicePixels",
    "FieldParams",
    "GridLayout",
    "NormalEquations",
    "PoseMoments",
    "RayBatch",
    "Rules",
    "StepResult",
    "Weights",
    "select",
    "use",
]

NAMES = ("reference", "cpu", "gpu")
_forced: ContextVar[str | None] = ContextVar("ecslam_kernels", default=None)


class Backend(Protocol):
    """The seam. See ``reference`` for what each function means; N = 0 and R = 0 are legal everywhere."""

    def values(self, layout: GridLayout, params: FieldParams, points: Tensor) -> tuple[Tensor, Tensor]:
        """TSDF [N] and colour [N, 3] at points [N, 3]."""
        ...

    def gradients(
        self, layout: GridLayout, params: FieldParams, points: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """TSDF, its gradient, luminance, its gradient at points [N, 3]."""
        ...

    def sample_depths(
        self, depth: Tensor, far: Tensor, jitter: Tensor, uniform: int, near_m: float, reach_m: float
    ) -> Tensor:
        """Sorted depths [R, S] along rays."""
        ...

    def importance_depths(self, z: Tensor, weights: Tensor, jitter: Tensor) -> Tensor:
        """Depths [R, S + K]: z [R, S] and K more where their weights are."""
        ...

    def render(
        self, layout: GridLayout, params: FieldParams, c2w: Tensor, rays: RayBatch
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Colour [R, 3], depth [R], weights [R, S]."""
        ...

    def step(
        self,
        layout: GridLayout,
        params: FieldParams,
        c2w: Tensor,
        rays: RayBatch,
        weights: Weights,
        into: FieldParams | None,
        want_poses: bool,
        adam: AdamStep | None = None,
    ) -> StepResult:
        """One optimisation step's losses and gradients, and with ``adam`` the table's own step."""
        ...

    def normal_equations(
        self,
        layout: GridLayout,
        params: FieldParams,
        c2w: Tensor,
        points: Tensor,
        luminance: Tensor,
        settings: AlignSettings,
    ) -> NormalEquations:
        """Sums for one Gauss-Newton step."""
        ...

    def pose_step(self, c2w: Tensor, d_c2w: Tensor, moments: PoseMoments, rates: Tensor, count: int) -> Tensor:
        """Poses [P, 4, 4] after one step of Adam."""
        ...

    def map_step(self, parameters: list[Tensor], gradients: list[Tensor], adam: AdamStep) -> None:
        """A step of Adam for parameters of the map, in place."""
        ...

    def smoothness(self, layout: GridLayout, table: Tensor, lattice: Tensor) -> Tensor:
        """Gradient [rows, 2] of the smoothness term on a lattice of points [n^3, 3]."""
        ...


@contextmanager
def use(name: str) -> Iterator[None]:
    """Use the named back end inside the block, whatever the device."""
    if name not in NAMES:
        raise InputError(f"kernels {name!r}: no such back end; there are {', '.join(NAMES)}")
    token = _forced.set(name)
    try:
        yield
    finally:
        _forced.reset(token)


def _load(name: str) -> Backend:
    return cast(Backend, importlib.import_module(f".{name}", __name__))


def select(device: torch.device) -> tuple[str, Backend, str]:
    """The back end for ``device``: its name, its functions, and a note when the automatic choice fell back.

    Raises InputError when an explicit choice is unknown or cannot run here.
    """
    forced = _forced.get() or os.environ.get("ECSLAM_KERNELS") or None
    if forced is not None and forced not in NAMES:
        raise InputError(f"ECSLAM_KERNELS={forced}: no such back end; there are {', '.join(NAMES)}")
    if forced in ("cpu", "gpu") and (forced == "cpu") != (device.type == "cpu"):
        raise InputError(f"kernels {forced!r} cannot run on device {device}; choose another --device or other kernels")
    name = forced or ("cpu" if device.type == "cpu" else "gpu" if device.type == "cuda" else "reference")
    try:
        return name, _load(name), ""
    except ImportError as error:
        if forced:
            raise InputError(f"kernels {name!r} cannot run here: {error}") from error
        return "reference", _load("reference"), f"the fast {name} kernels cannot run here ({error}); using plain torch"
