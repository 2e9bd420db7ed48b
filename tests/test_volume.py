"""The fused TSDF volume: distances of known surfaces, growth, and the sums that alignment needs."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from planes import CAMERA, corner, look, pose

from ecslam import descent, se3, volume
from ecslam.align import align, cost_at, known_points, stages
from ecslam.config import Config
from ecslam.descent import RULES, moved
from ecslam.kernels import fusion_descent
from ecslam.kernels.graphs import Recorder
from ecslam.pixels import Points, spread_pixels
from ecslam.volume import FusedVolume, create_volume

CONFIG = Config(border_px=4)


def fused(planes, poses, voxel_m=0.02):
    out = FusedVolume(voxel_m, 0.06)
    for c2w in poses:
        out.integrate(look(c2w, planes), CAMERA, c2w, 0.1, 8.0)
    return out


@pytest.mark.parametrize("tilt_deg", [0, 25, 50])
@pytest.mark.parametrize("sign", [-1, 1])
def test_distance_to_a_plane(tilt_deg, sign):
    c2w = pose((3, -2, 5), (sign * 3.3, sign * -1.7, sign * 0.2))
    forward = c2w[:3, 2]
    tilt = np.radians(tilt_deg)
    n = np.cos(tilt) * forward + np.sin(tilt) * c2w[:3, 0]
    d = float(n @ (c2w[:3, 3] + 1.5 * forward))
    found = fused([(n, d)], [c2w])
    rng = np.random.default_rng(0)
    side = np.stack([c2w[:3, 1], np.cross(n, c2w[:3, 1])])
    base = c2w[:3, 3] + 1.5 * forward
    true = rng.uniform(-0.03, 0.03, 500)
    points = base + rng.uniform(-0.25, 0.25, (500, 2)) @ side - true[:, None] * n
    distance, known = found.distances(points)
    assert known.mean() > 0.95
    np.testing.assert_allclose(distance[known], true[known], atol=1e-3)


def test_what_nobody_saw_is_unknown():
    found = fused([(np.array([0, 0, 1.0]), 2.0)], [np.eye(4)])
    _, known = found.distances(np.array([[0, 0, 2.3], [0, 0, -1.0], [40.0, 0, 2], [0, 0, 2.0]]))
    assert known.tolist() == [False, False, False, True]
    _, known = FusedVolume(0.02, 0.06).distances(np.zeros((3, 3)))
    assert not known.any()
    assert FusedVolume(0.02, 0.06).distances(np.empty((0, 3)))[0].shape == (0,)


@pytest.mark.parametrize("color", [(220, 60, 10), (10, 60, 220), (255, 255, 255)])
def test_its_luminance_is_that_of_the_points_that_are_aligned_to_it(color):
    frame = replace(look(np.eye(4), corner()), color=np.full((CAMERA.height, CAMERA.width, 3), color, np.uint8))
    found = FusedVolume(0.02, 0.06)
    found.integrate(frame, CAMERA, np.eye(4), 0.1, 8.0)
    points = known_points(found, spread_pixels(frame, CAMERA, 500, CONFIG, np.random.default_rng(0)), np.eye(4))
    settings = replace(stages(CONFIG)[-1], colour_weight=1.0, colour_kernel=10.0)
    colourless = found.normal_equations(np.eye(4), points, replace(settings, colour_weight=0.0))
    added = found.normal_equations(np.eye(4), points, settings).cost - colourless.cost
    assert np.sqrt(2 * added / colourless.used) < 1 / 255


def test_depth_out_of_range_adds_nothing():
    out = FusedVolume(0.02, 0.06)
    out.integrate(look(np.eye(4), [(np.array([0, 0, 1.0]), 2.0)]), CAMERA, np.eye(4), 0.1, 1.9)
    assert out.used == 0


def test_growing_changes_nothing(monkeypatch):
    poses = [pose((0, 4 * k, 0)) for k in range(3)]
    large = fused(corner(), poses)
    monkeypatch.setattr(volume, "ROWS", 4)
    monkeypatch.setattr(volume, "LISTED", 4)
    small = fused(corner(), poses)
    points = np.random.default_rng(1).uniform(-1, 2.1, (4000, 3))
    assert large.used == small.used > 100
    for a, b in zip(large.distances(points), small.distances(points), strict=True):
        np.testing.assert_array_equal(a, b)


def test_state_goes_round():
    one = fused(corner(), [np.eye(4)])
    two = FusedVolume(0.02, 0.06)
    two.load(one.state())
    next_pose = pose((0, 5, 0), (0.1, 0, 0))
    for v in (one, two):
        v.integrate(look(next_pose, corner()), CAMERA, next_pose, 0.1, 8.0)
    for name, value in one.state().items():
        np.testing.assert_array_equal(value, two.state()[name])


def measured(planes, c2w, count=2000):
    return spread_pixels(look(c2w, planes), CAMERA, count, CONFIG, np.random.default_rng(2))


@pytest.mark.parametrize("colour", [0.0, 0.05])
def test_sums_are_the_derivative_of_the_cost(colour):
    """Laws: jtr is the slope of the robust cost to first order in the weights, used counts what took part."""
    found = fused(corner(), [np.eye(4), pose((0, 6, 2))])
    at = pose((0.4, -0.3, 0.2), (0.006, -0.004, 0.005))
    points = known_points(found, measured(corner(), np.eye(4)), at)
    settings = replace(stages(CONFIG)[0], colour_weight=colour, gradient_low=0.0, gradient_high=1e9, tsdf_limit=1e9)
    c2w = torch.from_numpy(at)
    sums = found.normal_equations(at, points, settings)
    assert sums.used > 500
    assert sums.inliers <= sums.used
    torch.testing.assert_close(sums.jtj, sums.jtj.T)
    assert float(torch.linalg.eigvalsh(sums.jtj)[0]) > 0
    for k in range(6):
        step = torch.zeros(6, dtype=torch.float64)
        step[k] = 1e-5
        up = found.normal_equations(se3.retract(c2w, step).numpy(), points, settings)
        down = found.normal_equations(se3.retract(c2w, -step).numpy(), points, settings)
        slope = (up.cost - down.cost) / 2e-5
        assert slope == pytest.approx(float(sums.jtr[k]), rel=0.03, abs=2e-3 * float(sums.jtr.abs().max()))


def test_alignment_finds_the_pose_in_a_corner():
    found = fused(corner(), [pose(centre=(1e-3, 2e-3, -1e-3)), pose((0, 6, 2)), pose((4, -5, 0))])
    true = pose((2, 3, -1), (0.02, 0.01, -0.02))
    guess = pose((3, 2, 0), (0.05, -0.01, 0.01))
    points = known_points(found, measured(corner(), true), guess)
    result = align(found, points, guess, CONFIG)
    assert np.linalg.norm(result.c2w[:3, 3] - true[:3, 3]) < 2e-3
    assert float(se3.rotation_angle_deg(result.c2w, true)) < 0.1
    assert result.cost == pytest.approx(cost_at(found, points, result.c2w, CONFIG))
    assert result.cost < cost_at(found, points, guess, CONFIG)


def test_colour_holds_what_a_plain_wall_leaves_free():
    wall = [(np.array([0, 0, 1.0]), 1.5)]
    found = fused(wall, [np.eye(4), pose(centre=(0.05, 0, 0))])
    true, guess = pose(centre=(0.02, 0.01, 0)), pose(centre=(0.04, -0.01, 0.01))
    points = known_points(found, measured(wall, true), guess)
    with_colour = align(found, points, guess, CONFIG).c2w
    without = align(found, points, guess, replace(CONFIG, align=replace(CONFIG.align, colour_weight_m=0.0))).c2w
    assert np.linalg.norm(with_colour[:3, 3] - true[:3, 3]) < 3e-3
    assert np.linalg.norm(without[:3, 3] - true[:3, 3]) > 0.01


@pytest.mark.parametrize("kernels", ["reference", "cpu"])
def test_without_gpu_kernels_the_volume_is_on_the_cpu(kernels):
    assert isinstance(create_volume(kernels, 0.02, 0.06, torch.device("cuda"), Recorder()), FusedVolume)


def test_moved_is_retract():
    c2w, xi = pose((10, -20, 30), (1, 2, 3)), np.array([0.1, -0.2, 0.3, 0.4, 0.1, -0.9])
    expected = se3.retract(torch.from_numpy(c2w), torch.from_numpy(xi)).numpy()
    np.testing.assert_allclose(moved(c2w, xi), expected, atol=1e-12)


TRUE, GUESS, FAR_GUESS = pose((2, 3, -1), (0.02, 0.01, -0.02)), pose((3, 2, 0), (0.05, -0.01, 0.01)), pose((3, -9, 6))
WALL = [(np.array([0, 0, 1.0]), 1.5)]


@pytest.fixture(scope="module")
def surface():
    return fused(corner(), [np.eye(4), pose((0, 6, 2)), pose((4, -5, 0))])


def noisy(count=2000, planes=None):
    """The first ``count`` points seen from TRUE, with noise; one in seven is far from any surface."""
    pixels, rng = measured(planes or corner(), TRUE), np.random.default_rng(3)
    local = pixels.points() + rng.normal(0, 0.004, (len(pixels.points()), 3)).astype(np.float32)
    local[3::7] += np.float32(0.4)
    light = rng.random(len(local), np.float32)
    return Points(torch.from_numpy(local[:count]), torch.from_numpy(light[:count]))


def assert_descends_alike(surface, points, guess, settings, iterations=10):
    expected = descent.descend(surface, points, guess, settings, iterations)
    found = surface.descend(points, guess, settings, iterations)
    np.testing.assert_allclose(found.c2w, expected.c2w, rtol=0, atol=1e-9)
    assert found.cost == pytest.approx(expected.cost, rel=1e-9)
    return found


@pytest.mark.parametrize("colour", [0.0, 0.05, 1.0])
@pytest.mark.parametrize("guess", [GUESS, FAR_GUESS], ids=["near", "far"])
@pytest.mark.parametrize("count", [0, 1, 5, 6, 23, 24, 25, 333, 2000])
def test_the_compiled_descent_is_the_readable_one(surface, count, guess, colour):
    settings = [replace(stage, colour_weight=colour) for stage in stages(CONFIG)]
    found = assert_descends_alike(surface, noisy(count), guess, settings)
    assert count < 333 or np.abs(found.c2w - guess).max() > 0.01


@pytest.mark.parametrize("iterations", [0, 1, 4, 40])
@pytest.mark.parametrize("kernels_m", [(0.02,), (0.06, 0.02), (0.2, 0.06, 0.02, 0.01)])
def test_a_descent_of_any_length(surface, kernels_m, iterations):
    settings = stages(replace(CONFIG, align=replace(CONFIG.align, kernels_m=kernels_m)))
    for guess in (TRUE, GUESS, FAR_GUESS):
        assert_descends_alike(surface, noisy(), guess, settings, iterations)
    assert len(fusion_descent.descend.signatures) == 1


@pytest.mark.parametrize("stride", [1, 3, 500, 5000])
def test_a_descent_with_any_share_of_the_points(monkeypatch, surface, stride):
    for module in (descent, volume):
        monkeypatch.setattr(module, "COARSE_STRIDE", stride)
    assert_descends_alike(surface, noisy(), GUESS, stages(CONFIG))


@pytest.mark.parametrize(
    "rule",
    [
        {"damping": 10.0}, {"least_damping": 1e-2}, {"most_damping": 5e-4}, {"settled": 0.02},
        {"still_after_gain": 0.03}, {"still_after_loss": 4e-3}, {"least_used": 1700},
    ],
    ids=str,
)  # fmt: skip
def test_a_descent_by_other_rules(monkeypatch, surface, rule):
    settings = [replace(stage, colour_weight=1.0) for stage in stages(CONFIG)]
    usual = surface.descend(noisy(), FAR_GUESS, settings, 10)
    for module in (descent, volume):
        monkeypatch.setattr(module, "RULES", RULES._replace(**rule))
    found = assert_descends_alike(surface, noisy(), FAR_GUESS, settings)
    assert np.abs(found.c2w - usual.c2w).max() > 1e-7


@pytest.mark.parametrize("colour", [0.0, 0.05])
def test_a_descent_where_the_surface_leaves_directions_free(colour):
    found = fused(WALL, [np.eye(4), pose(centre=(0.05, 0, 0))])
    settings = [replace(stage, colour_weight=colour) for stage in stages(CONFIG)]
    for guess in (GUESS, pose(centre=(0.04, -0.01, 0.01))):
        assert_descends_alike(found, noisy(planes=WALL), guess, settings)


def test_a_descent_repeats_and_leaves_its_guess_alone(surface):
    guess, points = GUESS.copy(), noisy()
    first, second = (align(surface, points, guess, CONFIG) for _ in range(2))
    np.testing.assert_array_equal(first.c2w, second.c2w)
    assert first.cost == second.cost
    np.testing.assert_array_equal(guess, GUESS)
    assert not np.shares_memory(first.c2w, second.c2w)


def test_a_matrix_that_is_not_positive_refuses_the_step(monkeypatch, surface):
    monkeypatch.setattr(volume, "RULES", RULES._replace(damping=-2.0))
    points = noisy()
    found = align(surface, points, GUESS, CONFIG)
    np.testing.assert_array_equal(found.c2w, GUESS)
    assert found.cost == pytest.approx(cost_at(surface, points, GUESS, CONFIG))


def test_damped_steps():
    """Law: they solve the damped system."""
    rng, lower, move = np.random.default_rng(4), np.empty((6, 6)), np.empty(6)
    for rank, damping in [(9, 0.0), (9, 3.0), (6, 1e-4), (2, 1e-2), (0, 1e-4)]:
        jacobian, sums = rng.normal(size=(rank, 6)), np.full(45, np.nan)
        jtj, jtr = jacobian.T @ jacobian, jacobian.T @ rng.normal(size=rank)
        sums[:36], sums[36:42] = np.where(np.tri(6).T > 0, jtj, np.nan).flat, jtr
        assert fusion_descent.damped_step.py_func(sums, damping, lower, move)
        damped = jtj + damping * np.diag(jtj.diagonal() + 1e-9)
        np.testing.assert_allclose(damped @ move, -jtr, atol=1e-9)
    for wrong in (0.0, -1.0, np.nan):
        assert not fusion_descent.damped_step.py_func(np.full(45, wrong), 0.0, lower, move)
