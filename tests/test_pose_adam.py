"""Adam for poses: it turns a camera about what it sees."""

import numpy as np
import pytest
import torch

from ecslam import se3
from ecslam.config import TrackingConfig
from ecslam.kernels import RayBatch
from ecslam.pose_adam import PoseAdam, pose_rates
from ecslam.rays import view_centre


def batch(direction, depth):
    """Rays of which only the measurement matters."""
    count = len(depth)
    feature, pose = torch.zeros(count, dtype=torch.bool), torch.zeros(count, dtype=torch.int64)
    return RayBatch(direction, depth[:, None], depth, torch.zeros(count, 3), feature, pose)


def test_the_middle_of_what_a_view_measured():
    direction = torch.tensor([[0.0, 0, 1], [1, 0, 1], [5, 5, 1]])
    assert view_centre(batch(direction, torch.tensor([2.0, 4, 0]))).tolist() == [2, 0, 3]
    assert view_centre(batch(direction, torch.zeros(3))).tolist() == [0, 0, 0]


def off(c2w, local, world):
    """Mean squared distance of where a pose [1, 3 or 4, 4] puts the points from where they are."""
    return (local @ c2w[0, :3, :3].T + c2w[0, :3, 3] - world).square().sum(-1).mean()


def descended(start, local, world, about, momentum):
    """Root mean squared metres that the points are off after the iterations of a frame."""
    t = TrackingConfig()
    rates = t.unaligned_rate * pose_rates(torch.zeros(1, dtype=torch.bool), t.lr_rotation, t.lr_translation)
    poses = PoseAdam(start, rates, momentum, about)
    for _ in range(t.iterations):
        top = poses.c2w[:, :3].clone().requires_grad_()
        poses.step(torch.autograd.grad(off(top, local, world), top)[0])
    return float(off(poses.c2w, local, world)) ** 0.5


def test_poses_that_turn_about_what_they_see_come_to_rest_at_the_truth():
    """Neither about the camera nor with Adam's usual momentum do they."""
    about_middle, about_camera, sluggish = [], [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        local = torch.from_numpy(rng.uniform([-1.5, -1, 2], [1.5, 1, 4], (300, 3)))
        move = torch.from_numpy(rng.standard_normal((1, 2, 3)))
        move *= (0.002, 0.005, 0.01)[seed % 3] / move.norm(dim=2, keepdim=True)
        start = torch.eye(4, dtype=torch.float64)[None]
        truth = se3.retract(start, move.view(1, 6))
        world = local @ truth[0, :3, :3].T + truth[0, :3, 3]
        before = float(off(start, local, world)) ** 0.5
        middle, camera = local.mean(0, keepdim=True), torch.zeros(1, 3, dtype=torch.float64)
        about_middle.append(descended(start, local, world, middle, TrackingConfig().momentum) / before)
        about_camera.append(descended(start, local, world, camera, TrackingConfig().momentum) / before)
        sluggish.append(descended(start, local, world, middle, 0.9) / before)
    assert np.mean(about_middle) < 0.07
    assert np.mean(about_camera) > 0.12
    assert np.mean(sluggish) > 0.3


def test_rates_are_of_translation_first_and_none_for_a_fixed_pose():
    rates = pose_rates(torch.tensor([False, True]), lr_rotation=0.1, lr_translation=0.2)
    assert rates.tolist() == [[0.2, 0.2, 0.2, 0.1, 0.1, 0.1], [0.0] * 6]


@pytest.mark.parametrize(("share", "part"), [(None, 1.0), (0.25, 0.25), (torch.tensor(0.5), 0.5), (0.0, 0.0)])
def test_the_first_step_is_as_long_as_the_share_of_the_rate(share, part):
    """Adam's first step goes against the gradient's sign, however large that is."""
    adam = PoseAdam(torch.eye(4, dtype=torch.float64)[None], pose_rates(torch.tensor([False]), 0.01, 0.02))
    gradient = torch.zeros(1, 3, 4)
    gradient[0, 0, 3], gradient[0, 1, 3] = 7.0, -1e-3
    adam.step(gradient, share)
    expected = part * torch.tensor([-0.02, 0.02, 0], dtype=torch.float64)
    assert torch.allclose(adam.c2w[0, :3, 3], expected, atol=1e-6)
