"""The picture of a run: it shows the map from inside, hides what is hidden, and copes with what a run may lack."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from matplotlib.axes import Axes
from scipy.spatial.transform import Rotation

from ecslam.evaluation.dollhouse import dollhouse, floor_plan, visible_pixels
from ecslam.evaluation.plots import plot_run
from ecslam.types import Mesh

UP = np.array([0, 0, 1.0])
EMPTY = Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))


def painted_room() -> Mesh:
    """Walls of 4 x 3 x 2.5 m seen from inside: green floor, red ceiling, grey walls, and a grey shell 10 cm outside."""
    inner, shell = trimesh.creation.box([4, 3, 2.5]).subdivide(), trimesh.creation.box([4.2, 3.2, 2.7])
    inner.invert()
    height = inner.triangles_center[:, 2]
    colors = np.full((len(inner.faces), 3), 128, np.uint8)
    colors[height < -1.2], colors[height > 1.2] = (0, 255, 0), (255, 0, 0)
    vertices = np.concatenate([inner.triangles.reshape(-1, 3), shell.triangles.reshape(-1, 3)]).astype(np.float32)
    colors = np.concatenate([colors.repeat(3, 0), np.full((3 * len(shell.faces), 3), 60, np.uint8)])
    return Mesh(vertices, np.arange(len(vertices), dtype=np.int32).reshape(-1, 3), colors)


def poses(n: int = 40) -> np.ndarray:
    c2w = np.tile(np.eye(4), (n, 1, 1))
    angles = np.linspace(0, 2 * np.pi, n)
    c2w[:, :3, :3] = Rotation.from_euler("x", -90, degrees=True).as_matrix()
    c2w[:, 0, 3], c2w[:, 1, 3] = 0.5 * np.cos(angles), 0.4 * np.sin(angles)
    return c2w


def test_one_looks_through_the_shell_and_the_ceiling_onto_the_floor() -> None:
    picture = dollhouse(painted_room(), poses(), UP, 200, 150)
    shown = picture.rgba[picture.rgba[..., 3] > 0.99][:, :3]
    green, red = (shown[:, 1] > 2 * shown[:, 0]).mean(), (shown[:, 0] > 2 * shown[:, 1]).mean()
    assert picture.rgba.shape == (150, 200, 4)
    assert green > 0.3
    assert red == 0
    assert picture.rgba.min() >= 0
    assert picture.rgba.max() <= 1


@pytest.mark.parametrize("turn", [0, 25, 70])
def test_the_whole_room_is_in_the_picture(turn: float) -> None:
    room = painted_room()
    rotation = Rotation.from_euler("z", turn, degrees=True).as_matrix()
    turned = Mesh((room.vertices @ rotation.T).astype(np.float32), room.faces, room.colors)
    picture = dollhouse(turned, poses(), UP, 200, 150)
    rows, columns = np.nonzero(picture.rgba[..., 3])
    assert 3 <= rows.min() < rows.max() <= 146
    assert 3 <= columns.min() < columns.max() <= 196
    assert max(np.ptp(rows) / 150, np.ptp(columns) / 200) > 0.85


def test_points_behind_the_floor_are_hidden() -> None:
    picture = dollhouse(painted_room(), poses(), UP, 200, 150)
    pixels = visible_pixels(picture, np.array([[0, 0, 0], [0, 0, -1.2], [0, 0, -1.5]]))
    assert np.isfinite(pixels[:2]).all()
    assert np.isnan(pixels[2]).all()
    assert pixels[0, 1] < pixels[1, 1]


def test_a_map_is_drawn_with_x_to_the_right_and_y_up_where_z_is_up() -> None:
    np.testing.assert_allclose(floor_plan(UP), [[1, 0, 0], [0, 1, 0]])
    for up in np.random.default_rng(0).normal(size=(20, 3)):
        up = up / np.linalg.norm(up)
        plan = np.concatenate([floor_plan(up), up[None]])
        np.testing.assert_allclose(plan @ plan.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(plan) == pytest.approx(1)


@pytest.mark.parametrize("case", ["all", "no truth", "no mesh", "holes"])
def test_a_picture_is_written(tmp_path: Path, case: str) -> None:
    estimate, truth = poses(), poses()
    estimate[:, 0, 3] += np.linspace(0, 0.05, len(estimate))
    if case == "holes":
        truth[3:9] = np.nan
    mesh = EMPTY if case == "no mesh" else painted_room()
    plot_run(tmp_path / "run.png", mesh, estimate, None if case == "no truth" else truth, "A run")
    image = cv2.imread(str(tmp_path / "run.png"))
    assert image is not None
    assert image.shape == (990, 1920, 3)
    left = image[130:, :1250].astype(int)
    green = (left[..., 1] > 1.5 * left[..., 0]) & (left[..., 1] > 1.5 * left[..., 2])
    assert (green.mean() > 0.05) == (case != "no mesh")


def test_errors_are_drawn_at_the_numbers_of_their_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = []
    monkeypatch.setattr(Axes, "fill_between", lambda axes, x, y, **style: drawn.append(list(x)))
    estimate, frames = poses(4), np.array([0, 1, 5, 7])
    plot_run(tmp_path / "run.png", EMPTY, estimate, poses(4), frames=frames)
    plot_run(tmp_path / "run.png", EMPTY, estimate, poses(4))
    assert drawn == [[0, 1, 5, 7], [0, 1, 2, 3]]
