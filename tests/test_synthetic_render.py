"""The renderer of the synthetic rooms: exact depth, view-independent colour, the same bytes every time."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from ecslam.datasets.synthetic import open_synthetic
from ecslam.datasets.synthetic.lighting import AMBIENT, bake
from ecslam.datasets.synthetic.render import render
from ecslam.datasets.synthetic.rooms import box, lamp
from ecslam.datasets.synthetic.scene import HALF, pack
from ecslam.datasets.synthetic.sequence import room
from ecslam.datasets.synthetic.shapes import Paint, ball, block, can, pillar, place, rod, tilt
from ecslam.datasets.synthetic.solids import F
from ecslam.datasets.synthetic.surface import face_of, irradiance
from ecslam.datasets.synthetic.tracing import build, trace
from ecslam.types import Frame, Intrinsics
from tests.synthetic_oracles import distances, look_up, on_surface, points_of, rays, sphere_trace

CAMERA = Intrinsics(96.0, 96.0, 59.5, 44.5, 120, 90)


def solids():
    """One solid of each kind, some of them tilted, in front of a wall 3 m away."""
    wood = Paint("wood")
    return [
        block((-3, -3, 3), (3, 3, 3.2), Paint("bricks")),
        tilt(block((-1.2, -0.4, 1.5), (-0.6, 0.3, 1.9), wood), 30, 20),
        tilt(block((-0.4, -0.4, 1.6), (0.2, 0.2, 2.0), wood, 0.1), 25, 40),
        tilt(ball((0.7, -0.2, 1.8), (0.3, 0.15, 0.2), wood), 35, 10),
        tilt(can((-0.6, 0.5, 1.5), 0.2, 0.08, 0.4, wood), 50, 30),
        rod((0.2, 0.6, 1.2), (0.9, 0.4, 2.2), 0.06, wood),
        pillar((1.0, -0.7, 1.5), (1.3, 0.2, 2.0), 0.12, wood),
        ball((0.1, -0.7, 1.4), (0.2, 0.2, 0.2), wood),
    ]


def visible(camera, a, b):
    """Indices of the pixels of frame a (away from its edges) that frame b sees too, their depths and colours in b."""
    points = points_of(camera, a).reshape(-1, 3)
    inside, z, measured, color = look_up(camera, b, points)
    seen = inside & (np.abs(z - measured) < 0.002 * z)
    return seen, z, measured, color


def test_depth_lies_on_the_first_surface():
    shapes = solids()
    _, depth = render(pack(shapes), CAMERA, np.eye(4))
    directions = rays(CAMERA, np.eye(4)).reshape(-1, 3)
    points = depth.reshape(-1, 1) * directions
    assert on_surface(shapes, points).max() < 1e-5
    length = np.linalg.norm(directions, axis=1)
    traced = sphere_trace(shapes, np.zeros_like(directions), directions / length[:, None])
    found = np.isfinite(traced)
    assert found.mean() > 0.97
    assert_allclose(depth.ravel()[found], (traced / length)[found], atol=2e-4)


def test_every_solid_of_the_test_scene_is_seen():
    shapes = solids()
    _, depth = render(pack(shapes), CAMERA, np.eye(4))
    points = depth.reshape(-1, 1) * rays(CAMERA, np.eye(4)).reshape(-1, 3)
    for shape in shapes:
        assert (on_surface([shape], points) < 1e-5).sum() > 20


def test_nothing_in_view_is_depth_zero_and_black():
    away = np.diag([1.0, -1.0, -1.0, 1.0])
    color, depth = render(pack(solids()), CAMERA, away)
    assert not depth.any()
    assert not color.any()


@pytest.mark.parametrize("index", [0, 140])
def test_studio_depth_lies_on_the_surface_and_nothing_is_in_front(index):
    sequence = open_synthetic("studio", 160, 120)
    shapes = room("studio").shapes
    frame = sequence[index]
    assert (frame.depth > 0).all()
    points = points_of(sequence.intrinsics, frame).reshape(-1, 3)
    assert on_surface(shapes, points).max() < 1e-4
    eye = sequence.poses_gt()[index, :3, 3]
    for share in np.linspace(0.05, 0.95, 10):
        assert distances(shapes, (eye + share * (points - eye))[::7]).min() > -1e-4


def test_reprojection_agrees_in_depth_and_colour():
    sequence = open_synthetic("studio", 320, 240)
    for first, second in ((0, 6), (100, 92), (200, 212)):
        a, b = sequence[first], sequence[second]
        seen, z, measured, color = visible(sequence.intrinsics, a, b)
        assert seen.mean() > 0.5
        assert np.median(np.abs(z - measured)[seen]) < 5e-5
        assert np.quantile(np.abs(z - measured)[seen], 0.9) < 1.5e-3  # the interpolation of a curved surface
        error = np.abs(color - a.color.reshape(-1, 3)).mean(1)[seen]
        assert np.median(error) < 2.5
        assert np.quantile(error, 0.9) < 14


def test_colour_does_not_depend_on_the_side_it_is_seen_from():
    """A plain wall has no texture to filter: two far apart views of a point give the same grey."""
    wall = [block((-3, -3, 3), (3, 3, 3.2), Paint("plain", repeat_m=4.0))]
    scene = pack(wall)
    scene = scene._replace(light=np.linspace(0.2, 0.6, scene.light.size, dtype=np.float32).reshape(-1, 3))
    turned = np.eye(4)
    c, s = np.cos(0.5), np.sin(0.5)
    turned[:3, :3] = [[c, 0, -s], [0, 1, 0], [s, 0, c]]
    turned[:3, 3] = [1.2, 0.1, 0.3]
    frames = [Frame(0, 0.0, *render(scene, CAMERA, pose), pose) for pose in (np.eye(4), turned)]
    seen, _, _, color = visible(CAMERA, *frames)
    assert seen.mean() > 0.4
    assert np.quantile(np.abs(color - frames[0].color.reshape(-1, 3))[seen], 0.99) < 4
    assert np.median(np.abs(color - frames[0].color.reshape(-1, 3))[seen]) < 1.5


def test_a_third_of_the_size_is_every_third_ray():
    scene = pack(solids())
    small = Intrinsics(96.0, 96.0, 59.5, 44.5, 120, 90)
    large = small.resized(360, 270)
    assert_allclose(render(scene, small, np.eye(4))[1], render(scene, large, np.eye(4))[1][1::3, 1::3], rtol=2e-6)


def test_renders_the_same_bytes_from_any_thread():
    sequence = open_synthetic("studio", 160, 120)
    again = open_synthetic("synthetic/studio?size=160x120")
    wanted = [sequence[i] for i in (3, 50, 77)]
    with ThreadPoolExecutor(3) as pool:
        found = list(pool.map(lambda i: again[i], (3, 50, 77)))
    for a, b in zip(wanted, found, strict=True):
        assert_array_equal(a.color, b.color)
        assert_array_equal(a.depth, b.depth)
        assert_array_equal(a.c2w_gt, b.c2w_gt)


@pytest.mark.slow
def test_tracing_agrees_with_sphere_tracing():
    shapes = solids()
    scene = pack(shapes)
    tracer = build(scene)
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(300, 3)) * [0.5, 0.5, 0.1] + [0, 0, 1]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = rng.uniform(-0.3, 0.3, (300, 3))
    wanted = sphere_trace(shapes, origins, directions)
    for origin, direction, t in zip(np.float32(origins), np.float32(directions), wanted, strict=True):
        which, found = trace(scene.numbers, scene.values, *tracer, *origin, *direction, F(100), False)
        if np.isfinite(t):
            assert which >= 0
            assert abs(found - t) < 3e-4


def test_light_falls_off_with_distance_and_slant_and_shadows():
    """A small lamp 2 m above a black floor with a screen: irradiance goes with cos / d^2, plus what the sky gives."""
    black = Paint("plain", (0.0, 0.0, 0.0))
    shapes = [block((-4, -4, -0.1), (4, 4, 0), black), block((-4, 1.5, 0), (4, 1.55, 1.9), black)]
    interior = np.array([[-4.1, -4.1, -0.01], [4.1, 4.1, 3.0]])
    light = lamp((0, 0, 2), 1.0, box((-5, -5, -1), (5, 5, 4)), 0.01, (1.0, 1.0, 1.0))
    scene = bake(pack(shapes), [light], interior)

    def floor(x, y):
        half = scene.values[0, HALF : HALF + 2]
        a, b = F(0.5 + 0.5 * x / half[0]), F(0.5 + 0.5 * y / half[1])
        return irradiance(scene.numbers, scene.light, np.uint64(0), face_of(F(0), F(0), F(1)), a, b)[0]

    def expected(x, y):
        square = x * x + y * y + 4
        return 2 / np.sqrt(square) / (square + 0.05) + AMBIENT

    for x, y in ((1.0, 0.0), (2.0, -1.0), (-1.5, -1.0), (3.0, -2.0)):
        assert floor(x, y) / floor(0, 0) == pytest.approx(expected(x, y) / expected(0, 0), rel=0.03)
    assert floor(0.0, 3.0) / floor(0, 0) < AMBIENT / expected(0, 0)


def test_place_turns_before_it_moves():
    (shape,) = place([block((0, 0, 0), (2, 1, 1), Paint())], 5, 6, 0, 90)
    assert_allclose(shape.center, [4.5, 7, 0.5], atol=1e-12)
    assert_allclose(shape.rotation @ [1, 0, 0], [0, 1, 0], atol=1e-12)


@pytest.mark.slow
def test_what_is_compiled_and_what_is_read_back_from_disk_draw_the_same(tmp_path):
    script = (
        "import hashlib; from ecslam.datasets import open_sequence; "
        "frame = open_sequence('synthetic/studio?frames=8&size=320x240')[0]; "
        "print(hashlib.sha256(frame.depth.tobytes() + frame.color.tobytes()).hexdigest())"
    )
    env = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    first, second = (
        subprocess.run([sys.executable, "-c", script], env=env, capture_output=True, text=True, check=True).stdout
        for _ in range(2)
    )
    assert len(first.strip()) == 64
    assert first == second
