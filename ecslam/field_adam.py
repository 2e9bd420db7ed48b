"""Adam for the map's parameters, with moments in plain sight; a back end of the kernels takes its steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from .kernels import AdamStep

BETAS = (0.9, 0.99)
EPSILON = 1e-15


class FieldAdam:
    """What is known of ``parameters``, all of them float32 on one device, and of the steps they have taken.

    mean, square: moments, one a parameter. count: float32 [], steps done.
    """

    def __init__(self, parameters: Sequence[Tensor]) -> None:
        self.parameters = list(parameters)
        self.mean = [torch.zeros_like(p) for p in self.parameters]
        self.square = [torch.zeros_like(p) for p in self.parameters]
        self.count = torch.zeros((), device=self.parameters[0].device)

    def steps(self, first_rate: float | Tensor, rate: float | Tensor) -> tuple[AdamStep, AdamStep]:
        """The next step, for whoever computes it: that of the first parameter and that of the others, each with a
        learning rate of its own, numbers or tensors [] on the parameters' device."""
        self.count += 1
        first, others = (
            AdamStep(self.mean[part], self.square[part], self.count, lr, BETAS, EPSILON)
            for part, lr in ((slice(0, 1), first_rate), (slice(1, None), rate))
        )
        return first, others

    def moved(self, parameters: Sequence[Tensor], change: Callable[[Tensor, Tensor], Tensor]) -> FieldAdam:
        """The same state for other ``parameters``; ``change(moment, parameter)`` gives the moment in its new shape."""
        out = FieldAdam(parameters)
        out.mean = [change(m, p) for m, p in zip(self.mean, out.parameters, strict=True)]
        out.square = [change(s, p) for s, p in zip(self.square, out.parameters, strict=True)]
        out.count = self.count
        return out
