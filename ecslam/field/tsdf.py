"""The map: a hash grid, a one-blob encoding and two tiny decoders that hold a TSDF and a colour."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from numpy.typing import NDArray

from ..config import FieldConfig
from ..kernels.types import FEATURES, HIDDEN, FieldParams, GridLayout
from .grid import build_layout, grow_layout, regrow, table_rows


@dataclass(frozen=True)
class TsdfField:
    """A map: where its cells lie, and the learnt numbers in them (mutated in place by the mapper's optimiser alone).

    table_size: rows of a hashed level; none has more.
    """

    layout: GridLayout
    params: FieldParams
    table_size: int

    @property
    def device(self) -> torch.device:
        """Where the learnt numbers live."""
        return self.params.table.device

    @property
    def parameters(self) -> int:
        """How many learnt numbers there are."""
        return sum(getattr(self.params, f.name).numel() for f in fields(self.params))

    def freeze(self, into: TsdfField | None = None) -> TsdfField:
        """A copy that later mapping does not touch (about a millisecond): ``into``, where that has the same layout and
        is another field, so that what has been recorded over it stays valid."""
        if into is None or into is self or into.layout is not self.layout:
            return replace(self, params=map_params(self.params, torch.clone))
        for f in fields(self.params):
            getattr(into.params, f.name).copy_(getattr(self.params, f.name))
        return into


def map_params(params: FieldParams, function: object) -> FieldParams:
    """Apply ``function`` to every tensor."""
    assert callable(function)
    return FieldParams(*(function(getattr(params, f.name)) for f in fields(params)))


def create_field(config: FieldConfig, box: NDArray[np.float64], seed: int, device: torch.device) -> TsdfField:
    """A fresh map over a scene box [2, 3] metres: features within ``init_scale``, decoders as torch's Linear."""
    layout = build_layout(config, box)
    generator = torch.Generator().manual_seed(seed)

    def uniform(rows: int, columns: int, bound: float) -> torch.Tensor:
        return (torch.rand(rows, columns, generator=generator) * 2 - 1) * bound

    params = FieldParams(
        table=uniform(table_rows(layout), FEATURES, config.init_scale),
        w_in=uniform(layout.inputs, 2 * HIDDEN, 1 / math.sqrt(layout.inputs)),
        w_sdf=uniform(HIDDEN, 1, 1 / math.sqrt(HIDDEN)),
        w_rgb=uniform(HIDDEN, 3, 1 / math.sqrt(HIDDEN)),
        beta=torch.tensor([config.beta]),
    )
    return TsdfField(layout, map_params(params, lambda t: t.to(device)), 2**config.log2_table_size)


def grow_field(field: TsdfField, box: NDArray[np.float64]) -> TsdfField:
    """The same map over the union of its box and ``box``: features zero outside the old box and unchanged inside,
    but for collisions where a level gets too large to be dense."""
    layout = grow_layout(field.layout, box, field.table_size)
    table = regrow(field.layout, layout, field.params.table)
    return replace(field, layout=layout, params=replace(field.params, table=table))
