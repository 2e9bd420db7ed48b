"""Adam for the map's parameters: torch's fused update, without the seconds that importing ``torch.optim``'s compiler
support costs at the first step, and with moments in plain sight."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

BETAS = (0.9, 0.99)
EPSILON = 1e-15


class FieldAdam:
    """Updates ``parameters`` in place (Kingma and Ba 2015); all of them float32 on one device.

    mean, square: moments, one a parameter. count: float32 [], steps done.
    """

    def __init__(self, parameters: Sequence[Tensor]) -> None:
        self.parameters = list(parameters)
        self.mean = [torch.zeros_like(p) for p in self.parameters]
        self.square = [torch.zeros_like(p) for p in self.parameters]
        self.count = torch.zeros((), device=self.parameters[0].device)

    def step(self, gradients: list[Tensor], first_rate: float | Tensor, rate: float | Tensor) -> None:
        """One update with a learning rate for the first parameter and one for the others, numbers or tensors [] on the
        parameters' device: two launches on a GPU, however many parameters there are."""
        self.count += 1
        for part, lr in ((slice(0, 1), first_rate), (slice(1, None), rate)):
            torch._fused_adam_(
                self.parameters[part],
                gradients[part],
                self.mean[part],
                self.square[part],
                [],
                [self.count] * len(self.parameters[part]),
                lr=lr,
                beta1=BETAS[0],
                beta2=BETAS[1],
                weight_decay=0.0,
                eps=EPSILON,
                amsgrad=False,
                maximize=False,
            )

    def moved(self, parameters: Sequence[Tensor], change: Callable[[Tensor, Tensor], Tensor]) -> FieldAdam:
        """The same state for other ``parameters``; ``change(moment, parameter)`` gives the moment in its new shape."""
        out = FieldAdam(parameters)
        out.mean = [change(m, p) for m, p in zip(self.mean, out.parameters, strict=True)]
        out.square = [change(s, p) for s, p in zip(self.square, out.parameters, strict=True)]
        out.count = self.count
        return out
