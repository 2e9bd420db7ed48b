"""The grid behind a wall: whoever looks straight at it has one, as large as it says, and nobody else does."""

from __future__ import annotations

import numpy as np
import pytest
import viser.transforms as vt
from ecslam_app import server, theme, views
from ecslam_app.geometry import standing
from ecslam_app.grids import GAP_M

from ecslam.types import Mesh
from tests.fake_engine import FakeEngine, room_mesh
from tests.test_app_security import dial, enter, press, until, viewing

TILTED = vt.SO3.exp(np.array([0.2, -0.1, 0.4])).as_matrix()


@pytest.fixture
def page(tmp_path, monkeypatch):
    monkeypatch.setattr(views, "GLIDE_S", 0.05)
    engine, room = FakeEngine(tmp_path / "run", frames=60), room_mesh()
    page = server.start(engine, port=0)
    mesh = Mesh((room.vertices @ TILTED.T).astype(np.float32), room.faces, room.colors)
    page.hub.post(lambda: page.hub.scene.show_mesh(mesh))
    assert until(lambda: page.hub.scene.mesh is not None)
    yield page
    page.close()
    engine.stop()


def backwards(camera):
    back = np.array(camera.position) - np.array(camera.look_at)
    return back / np.linalg.norm(back)


def test_a_standing_grid_has_up_and_front_where_they_belong():
    up, front = TILTED[:, 2], TILTED[:, 0]
    axes = vt.SO3(standing(up, front)).as_matrix()
    assert np.allclose(axes, np.stack([np.cross(up, front), up, front], 1))
    assert np.linalg.det(axes) == pytest.approx(1)


def test_who_looks_straight_at_a_wall_alone_has_a_grid_behind_it(page):
    scene = page.hub.scene
    page.engine.skip_to(3)
    assert until(lambda: page.hub.current is page.engine.latest() and scene.mesh is not None)
    with dial(page) as connection, dial(page) as other:
        enter(connection)
        assert until(lambda: len(list(page.hub.viewers())) == 1)
        viewer = next(iter(page.hub.viewers()))
        enter(other)
        assert until(lambda: len(list(page.hub.viewers())) == 2)
        assert until(lambda: len(page.hub.views._framed) == 2), "the first views would take grids down again"
        for leaving in (("Look from", "Above"), ("Reset view", True), ("Follow camera", True)):
            press(page, connection, "Look from", "The side")
            assert until(lambda: viewer.client_id in page.hub.views.walls._grids)
            grids = page.hub.views.walls._grids
            assert len(grids) == 1
            _, up, front = vt.SO3(np.array(grids[viewer.client_id].wxyz)).as_matrix().T
            assert np.allclose(up, scene.up)
            place = np.array(grids[viewer.client_id].position)
            assert (place - scene.floor) @ up == pytest.approx(0, abs=1e-6), "a line lies where the floor does"
            assert ((scene.mesh.vertices - place) @ front).min() == pytest.approx(GAP_M, abs=1e-4)
            assert until(lambda: np.isclose(viewer.camera.fov, views.STRAIGHT_FOV_RAD))
            assert until(lambda front=front: np.allclose(backwards(viewer.camera), front, atol=1e-3))
            press(page, connection, *leaving)
            assert until(lambda: not page.hub.views.walls._grids), leaving


def test_the_grid_behind_a_wall_is_dark_on_a_dark_page(page):
    with viewing(page) as connection:
        press(page, connection, "Look from", "The side")
        assert until(lambda: page.hub.views.walls._grids)
        (grid,) = page.hub.views.walls._grids.values()
        press(page, connection, "Dark", True)
        assert until(lambda: tuple(grid.cell_color) == theme.GRID[1])
        press(page, connection, "Reset view", True)
        assert until(lambda: not page.hub.views.walls._grids)
        press(page, connection, "Look from", "The side")
        assert until(lambda: page.hub.views.walls._grids)
        assert tuple(next(iter(page.hub.views.walls._grids.values())).cell_color) == theme.GRID[1]


def test_the_grid_of_a_viewer_that_has_left_is_forgotten(page, recwarn):
    with viewing(page) as connection:
        press(page, connection, "Look from", "The side")
        assert until(lambda: page.hub.views.walls._grids)
    assert until(lambda: not list(page.hub.viewers()))
    page.hub.views.walls.set_dark(True)
    assert not page.hub.views.walls._grids
    assert not [w for w in recwarn if "closed connection" in str(w.message)]
