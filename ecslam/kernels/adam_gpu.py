"""Steps of Adam for the map on a GPU: one launch, however many parameters there are."""

from __future__ import annotations

import math

from torch import Tensor

from ._gpu_adam import Learnt, adam_kernel
from ._gpu_device import beside
from .types import AdamStep

BLOCK, WARPS = 1024, 4  # eight numbers a thread, so that enough loads are under way


def map_step(parameters: list[Tensor], gradients: list[Tensor], adam: AdamStep) -> None:
    """See ``reference.map_step``. Never waits for the device."""
    several = zip(parameters, gradients, adam.mean, adam.square, strict=True)
    learnt = tuple(Learnt(*given, given[0].numel()) for given in several)
    blocks = max((-(-one.size // BLOCK) for one in learnt), default=0)
    rest, logarithms = tuple(1 - decay for decay in adam.decays), tuple(math.log(decay) for decay in adam.decays)
    if blocks:
        with beside(adam.count):
            adam_kernel[(blocks,)](
                learnt, adam.count, adam.rate, adam.decays, rest, logarithms, adam.epsilon,
                rate_is_number=not isinstance(adam.rate, Tensor), block=BLOCK, num_warps=WARPS,
            )  # fmt: skip
