"""The map's optimiser against torch's own, and the steps that back ends take for it."""

import pytest
import torch

from ecslam.field_adam import BETAS, EPSILON, FieldAdam
from ecslam.kernels import cpu, reference

RATES = (1e-2, 3e-3)


def some(shapes):
    generator = torch.Generator().manual_seed(0)
    return [torch.randn(*shape, generator=generator) for shape in shapes]


@pytest.mark.parametrize("kernels", [reference, cpu])
@pytest.mark.parametrize("table", [(40, 2), (70_001, 2)])
def test_same_as_torch(kernels, table):
    shapes = (table, (7,), (3, 5))
    start, generator = some(shapes), torch.Generator().manual_seed(1)
    ours, theirs = [p.clone() for p in start], [p.clone().requires_grad_() for p in start]
    groups = [{"params": theirs[:1], "lr": RATES[0]}, {"params": theirs[1:], "lr": RATES[1]}]
    expected, adam = torch.optim.Adam(groups, betas=BETAS, eps=EPSILON), FieldAdam(ours)
    for _ in range(5):
        gradients = [torch.randn(p.shape, generator=generator) for p in start]
        for p, g in zip(theirs, gradients, strict=True):
            p.grad = g
        expected.step()
        first, others = adam.steps(*RATES)
        kernels.map_step(ours[:1], gradients[:1], first)
        kernels.map_step(ours[1:], gradients[1:], others)
    for p, q in zip(ours, theirs, strict=True):
        torch.testing.assert_close(p, q.detach(), rtol=1e-5, atol=1e-6)
    for i, q in enumerate(theirs):
        torch.testing.assert_close(adam.mean[i], expected.state[q]["exp_avg"])
        torch.testing.assert_close(adam.square[i], expected.state[q]["exp_avg_sq"])
    assert adam.count == 5


@pytest.mark.parametrize("kernels", [reference, cpu])
def test_without_a_gradient_nothing_moves(kernels):
    start = some([(40, 2)])
    moved = [start[0].clone()]
    kernels.map_step(moved, [torch.zeros(40, 2)], FieldAdam(start).steps(*RATES)[0])
    assert torch.equal(moved[0], start[0])


def test_state_moves_to_other_parameters():
    adam = FieldAdam([torch.zeros(3), torch.zeros(1)])
    first, _ = adam.steps(0.1, 0.1)
    reference.map_step(adam.parameters[:1], [torch.tensor([1.0, -2.0, 0.5])], first)
    grown = adam.moved([torch.zeros(4), torch.zeros(2)], lambda moment, p: torch.cat([moment, p.new_zeros(1)]))
    assert grown.mean[0].tolist() == [*adam.mean[0].tolist(), 0.0]
    assert grown.count == 1
    first, _ = grown.steps(0.1, 0.1)
    reference.map_step(grown.parameters[:1], [torch.ones(4)], first)
    assert (grown.parameters[0] != 0).all()


def test_a_step_takes_one_launch_for_each_rate(monkeypatch):
    launched = []
    monkeypatch.setattr(torch, "_fused_adam_", lambda parameters, *_, **__: launched.append(len(parameters)))
    numbers = [torch.zeros(2) for _ in range(5)]
    first, others = FieldAdam(numbers).steps(0.1, 0.2)
    reference.map_step(numbers[:1], numbers[:1], first)
    reference.map_step(numbers[1:], numbers[1:], others)
    assert launched == [1, 4]
