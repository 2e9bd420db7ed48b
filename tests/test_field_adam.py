"""The map's optimiser against torch's own."""

import torch

from ecslam.field_adam import BETAS, EPSILON, FieldAdam


def test_same_as_torch():
    generator = torch.Generator().manual_seed(0)
    start = [torch.randn(*shape, generator=generator) for shape in ((40, 2), (7,), (3, 5))]
    ours, theirs = [p.clone() for p in start], [p.clone().requires_grad_() for p in start]
    rates = (1e-2, 3e-3)
    groups = [{"params": theirs[:1], "lr": rates[0]}, {"params": theirs[1:], "lr": rates[1]}]
    reference, adam = torch.optim.Adam(groups, betas=BETAS, eps=EPSILON), FieldAdam(ours)
    for _ in range(5):
        gradients = [torch.randn(p.shape, generator=generator) for p in start]
        for p, g in zip(theirs, gradients, strict=True):
            p.grad = g
        reference.step()
        adam.step(gradients, *rates)
    for p, q in zip(ours, theirs, strict=True):
        torch.testing.assert_close(p, q.detach(), rtol=1e-5, atol=1e-6)
    assert adam.count == 5


def test_state_moves_to_other_parameters():
    adam = FieldAdam([torch.zeros(3), torch.zeros(1)])
    adam.step([torch.tensor([1.0, -2.0, 0.5]), torch.ones(1)], 0.1, 0.1)
    grown = adam.moved([torch.zeros(4), torch.zeros(2)], lambda moment, p: torch.cat([moment, p.new_zeros(1)]))
    assert grown.mean[0].tolist() == [*adam.mean[0].tolist(), 0.0]
    assert grown.count == 1
    grown.step([torch.ones(4), torch.ones(2)], 0.1, 0.1)
    assert (grown.parameters[0] != 0).all()


def test_a_step_takes_two_launches(monkeypatch):
    launched = []
    monkeypatch.setattr(torch, "_fused_adam_", lambda parameters, *_, **__: launched.append(len(parameters)))
    numbers = [torch.zeros(2) for _ in range(5)]
    FieldAdam(numbers).step(numbers, 0.1, 0.2)
    assert launched == [1, 4]
