"""Adam for rigid poses: moments live in the tangent of ``se3.retract``, so a pose stays a pose."""

from __future__ import annotations

import torch
from torch import Tensor

from .kernels import Backend, PoseMoments, reference

BETA2, EPSILON = 0.999, 1e-8


def pose_rates(fixed: Tensor, lr_rotation: float, lr_translation: float) -> Tensor:
    """Learning rates [P, 6] (float64) for poses of which the ``fixed`` [P] never move."""
    rates = torch.tensor([lr_translation] * 3 + [lr_rotation] * 3, dtype=torch.float64)
    return torch.where(fixed[:, None], 0.0, rates)


class PoseAdam:
    """Optimises poses c2w [P, 4, 4] (float64) from gradients with respect to their upper rows. rates: [P, 6].

    momentum: Adam's first decay. about: float64 [P, 3], in camera coordinates, what each camera turns about; without,
    itself. A camera that turns about itself sees nearly what it sees when it moves sideways, and Adam, which scales
    each number alone, is slow to tell the two apart; about the middle of what it sees they differ. kernels: who
    computes.
    """

    def __init__(
        self,
        c2w: Tensor,
        rates: Tensor,
        momentum: float = 0.9,
        about: Tensor | None = None,
        kernels: Backend = reference,
    ) -> None:
        self.c2w, self._rates = c2w, rates
        self._moments = PoseMoments(torch.zeros_like(rates), torch.zeros_like(rates), about, (momentum, BETA2), EPSILON)
        self._count, self._kernels = 0, kernels

    def step(self, d_c2w: Tensor, share: float | Tensor | None = None) -> None:
        """One update from gradients [P, 3, 4] at ``share`` of the learning rates; None: at all of them."""
        self._count += 1
        rates = self._rates if share is None else share * self._rates
        self.c2w = self._kernels.pose_step(self.c2w, d_c2w, self._moments, rates, self._count)
