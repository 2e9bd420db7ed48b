"""The first view, and who moves the camera: the page until the viewer does."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest
from ecslam_app import server, views
from ecslam_app.geometry import behind, overview, square_side, sticks_out

from ecslam.types import Mesh
from tests.fake_engine import FakeEngine, room_mesh
from tests.test_app_security import CAMERA, dial, enter, press, say, until, viewing

BOX = np.array(np.meshgrid([-2.0, 2], [-2.0, 2], [0.0, 2])).reshape(3, -1).T


@pytest.fixture
def page(tmp_path, monkeypatch):
    monkeypatch.setattr(views, "GLIDE_S", 0.05)
    engine = FakeEngine(tmp_path / "run", frames=60)
    page = server.start(engine, port=0)
    page.hub.scene.points = BOX
    yield page
    page.close()
    engine.stop()


@pytest.fixture
def viewer(page):
    with viewing(page) as connection:
        client = next(iter(page.hub.viewers()))
        assert until(lambda: page.hub.views._framed)
        where = page.hub.views._framed[client.client_id].position
        assert until(lambda: np.allclose(client.camera.position, where))
        yield connection, client


def grow(page, factor):
    """The map has become larger; the hub's thread has dealt with that when this returns."""
    page.hub.scene.points = factor * BOX
    done = []
    page.hub.post(page.hub.views.keep_framed)
    page.hub.post(lambda: done.append(1))
    assert until(lambda: done)


def test_a_growing_map_stays_in_sight(page, viewer):
    _, client = viewer
    before = np.array(client.camera.position)
    grow(page, 2)
    assert until(lambda: np.linalg.norm(client.camera.position) > 1.5 * np.linalg.norm(before))


def test_another_shape_of_the_window_is_framed_anew(page, viewer):
    connection, client = viewer
    before = page.hub.views._framed[client.client_id].position
    say(connection, "ViewerCameraMessage", **{**CAMERA, "position": before.tolist(), "image_width": 400})
    assert until(lambda: np.linalg.norm(client.camera.position) > 1.1 * np.linalg.norm(before))


def test_a_little_growth_moves_nobody(page, viewer):
    _, client = viewer
    before = np.array(client.camera.position)
    grow(page, 1.02)
    assert np.array_equal(client.camera.position, before)


def test_what_sticks_out_of_the_picture_is_brought_back_into_it(page, viewer):
    _, client = viewer
    before = np.array(client.camera.position)
    page.hub.scene.points = 1.1 * BOX
    place = page.hub.views._all(client)
    assert np.linalg.norm(place[0] - before) < views.WORTH_A_MOVE * np.linalg.norm(before)
    grow(page, 1.1)
    assert until(lambda: np.allclose(client.camera.position, place[0]))


@pytest.mark.parametrize("aspect", [0.5, 1.4])
def test_only_what_clearly_sticks_out_of_a_framed_view_is_outside(aspect):
    up = np.array([0.0, 0, 1])
    place = overview(BOX, up, np.array([0.8, -0.6, 0]), aspect, views.FOV_RAD)
    assert not sticks_out(1.02 * BOX, up, *place, aspect, views.FOV_RAD)
    assert sticks_out(1.2 * BOX, up, *place, aspect, views.FOV_RAD)
    behind_camera = place[0] + 0.1 * (place[0] - place[1])
    assert sticks_out(behind_camera[None], up, *place, aspect, views.FOV_RAD)


def test_who_has_moved_the_camera_keeps_it(page, viewer):
    connection, client = viewer
    say(connection, "ViewerCameraMessage", **{**CAMERA, "position": [1.0, 2.0, 3.0]})
    assert until(lambda: np.allclose(client.camera.position, [1, 2, 3]))
    grow(page, 2)
    grow(page, 3)
    assert np.allclose(client.camera.position, [1, 2, 3])
    page.hub.post(lambda: page.hub.views.show_all(client))
    assert until(lambda: np.linalg.norm(client.camera.position) > 5)
    assert client.client_id in page.hub.views._framed, "the page frames it again"


def test_a_browser_that_reports_late_has_not_moved_the_camera(page, viewer):
    connection, client = viewer
    first = np.array(client.camera.position)
    grow(page, 2)
    second = page.hub.views._framed[client.client_id].position
    assert np.linalg.norm(second) > 1.5 * np.linalg.norm(first)
    assert until(lambda: np.allclose(client.camera.position, second)), "the glide is over"
    halfway = (first + second) / 2
    for late in (first, halfway):
        say(connection, "ViewerCameraMessage", **{**CAMERA, "position": late.tolist()})
        assert until(lambda late=late: np.allclose(client.camera.position, late))
        grow(page, 2)
        assert client.client_id in page.hub.views._framed
    grow(page, 4)
    assert until(lambda: np.linalg.norm(client.camera.position) > 1.5 * np.linalg.norm(second))


def test_flying_to_a_keyframe_ends_the_framing(page, viewer):
    _, client = viewer
    page.hub.post(lambda: page.hub.views.visit(client, np.eye(4)))
    assert until(lambda: client.client_id not in page.hub.views._framed)
    assert until(lambda: np.linalg.norm(client.camera.position) < 1)
    grow(page, 2)
    assert np.linalg.norm(client.camera.position) < 1


def test_a_flight_ends_the_one_before(page, viewer):
    _, client = viewer
    views, loop = page.hub.views, page.hub.server.get_event_loop()
    places = []

    def fly():
        views.show_all(client, 0.3)
        views.visit(client, np.eye(4))
        places.append(behind(np.eye(4), page.hub.scene.up, 0.45)[0])

    page.hub.post(fly)
    assert until(lambda: places and np.allclose(client.camera.position, places[0]))
    asyncio.run_coroutine_threadsafe(asyncio.sleep(0.5), loop).result()
    assert np.allclose(client.camera.position, places[0])


def test_who_follows_the_camera_goes_along_until_he_moves(page, viewer):
    connection, client = viewer
    with dial(page) as other:
        enter(other)
        assert until(lambda: len(list(page.hub.viewers())) == 2)
        bystander = next(c for c in page.hub.viewers() if c.client_id != client.client_id)
        assert until(lambda: bystander.client_id in page.hub.views._framed)
        before = np.array(bystander.camera.position)
        page.engine.skip_to(5)
        assert until(lambda: page.hub.current is page.engine.latest())
        press(page, connection, "Follow camera", True)
        for frame in (10, 20):
            c2w = page.engine.skip_to(frame).latest().trajectory[-1]
            assert until(lambda c2w=c2w: np.allclose(client.camera.position, behind(c2w, page.hub.scene.up)[0]))
            grow(page, frame)
            assert np.allclose(client.camera.position, behind(c2w, page.hub.scene.up)[0])
        page.hub.post(page.hub.views.begin)
        c2w = page.engine.skip_to(21).latest().trajectory[-1]
        assert until(lambda: np.allclose(client.camera.position, behind(c2w, page.hub.scene.up)[0])), "in a new run too"
        say(connection, "ViewerCameraMessage", **{**CAMERA, "position": [1.0, 2.0, 3.0]})
        assert until(lambda: np.allclose(client.camera.position, [1, 2, 3]))
        page.engine.skip_to(30)
        assert until(lambda: page.hub.current.frame == 30)
        grow(page, 1)
        assert np.allclose(client.camera.position, [1, 2, 3])
        assert np.linalg.norm(bystander.camera.position) > np.linalg.norm(before), "it has everything in sight"


def turn(axis, degrees):
    """Rotation [3, 3] about the x (0) or z (2) axis."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]] if axis == 0 else [[c, -s, 0], [s, c, 0], [0, 0, 1]])


@pytest.mark.parametrize("towards", [[1.0, 0.0, 3.0], [-0.2, -5.0, 0.1], [0.7, 0.8, 0.0]])
@pytest.mark.parametrize("yaw", [0, 20, 50, 85])
def test_the_nearest_side_that_is_square_to_the_walls(towards, yaw):
    up, room = np.array([0.0, 0.0, 1.0]), room_mesh()
    side = square_side(Mesh((room.vertices @ turn(2, yaw).T).astype(np.float32), room.faces), up, np.array(towards))
    assert np.linalg.norm(side) == pytest.approx(1)
    assert np.abs(side @ turn(2, yaw)).max() == pytest.approx(1, abs=1e-6)
    assert side @ towards >= np.linalg.norm(towards[:2]) * np.cos(np.radians(45.01))


def test_without_walls_one_looks_from_where_one_is():
    floor = Mesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32), np.array([[0, 1, 2]], np.int32))
    assert np.allclose(square_side(floor, np.array([0.0, 0, 1]), np.array([3.0, 4.0, 2.0])), [0.6, 0.8, 0])


@pytest.mark.parametrize("tilt", [0, 12])
def test_a_plan_is_seen_from_straight_above_and_a_wall_from_straight_before_it(page, viewer, tilt):
    connection, client = viewer
    room, world = room_mesh(), turn(0, tilt) @ turn(2, 20)
    page.hub.post(lambda: page.hub.scene.show_mesh(Mesh((room.vertices @ world.T).astype(np.float32), room.faces)))
    assert until(lambda: page.hub.scene.mesh is not None)
    with dial(page) as other:
        enter(other)
        assert until(lambda: len(list(page.hub.viewers())) == 2)
        bystander = next(c for c in page.hub.viewers() if c.client_id != client.client_id)
        assert until(lambda: np.isclose(bystander.camera.fov, views.FOV_RAD))
        for name, axes in (("Above", [2]), ("The side", [0, 1])):
            press(page, connection, "Look from", name)

            def straight(axes=axes):
                back = world.T @ (np.array(client.camera.position) - np.array(client.camera.look_at))
                return np.abs(back[axes]).max() > 0.9999 * np.linalg.norm(back) > 0

            assert until(straight), name
            assert until(lambda: np.isclose(client.camera.fov, views.STRAIGHT_FOV_RAD))
        assert np.isclose(bystander.camera.fov, views.FOV_RAD)
    assert client.client_id not in page.hub.views._framed, "what one looks at is not moved as the map grows"
    press(page, connection, "Reset view", True)
    assert until(lambda: np.isclose(client.camera.fov, views.FOV_RAD))


@pytest.mark.parametrize("position", [[0.0, 0.0, 0.0], [0.0, 0.0, 9.0]])
def test_a_plan_from_where_no_side_is_nearer(page, viewer, position):
    connection, client = viewer
    page.hub.post(lambda: page.hub.scene.show_mesh(room_mesh()))
    say(connection, "ViewerCameraMessage", **{**CAMERA, "position": position})
    assert until(lambda: np.allclose(client.camera.position, position))
    press(page, connection, "Look from", "The side")
    assert until(lambda: np.isclose(client.camera.fov, views.STRAIGHT_FOV_RAD))
    assert np.isfinite(client.camera.position).all()


def test_before_there_is_a_mesh_a_plan_is_the_overview(page, viewer):
    connection, client = viewer
    say(connection, "ViewerCameraMessage", **{**CAMERA, "position": [1.0, 2.0, 3.0]})
    assert until(lambda: np.allclose(client.camera.position, [1, 2, 3]))
    press(page, connection, "Look from", "Above")
    assert until(lambda: np.linalg.norm(client.camera.position) > 5)
    assert until(lambda: np.isclose(client.camera.fov, views.FOV_RAD))


def test_the_page_stands_upright_once_floors_tell_how(page, viewer):
    connection, client = viewer
    scene, room = page.hub.scene, room_mesh()

    def show(world, kept=slice(None)):
        mesh, done = Mesh((room.vertices @ world.T).astype(np.float32), room.faces[kept]), []
        page.hub.post(lambda: scene.show_mesh(mesh))
        page.hub.post(page.hub.views.keep_framed)
        page.hub.post(lambda: done.append(1))
        assert until(lambda: done)

    tilted = turn(0, 20)
    show(tilted)
    assert np.allclose(scene.up, tilted[:, 2], atol=1e-6)
    assert until(lambda: np.allclose(client.camera.up_direction, scene.up)), "who is framed anew sees it upright"
    assert np.allclose(scene.side @ scene.up, 0, atol=1e-6)
    before = scene.up
    show(turn(0, 21))
    assert scene.up is before, "a little is no reason to turn everything"
    walls = np.abs(np.cross(*np.diff(room.vertices[room.faces], axis=1).transpose(1, 0, 2))[:, 2]) < 1e-6
    show(tilted, walls)
    assert scene.up is before, "walls do not know better"
    page.hub.post(lambda: scene.begin(page.engine.skip_to(3).snapshot()))
    assert until(lambda: np.array_equal(scene.up, [0, 0, 1])), "another run, another world"
    press(page, connection, "Reset view", True)
    assert until(lambda: np.allclose(client.camera.up_direction, [0, 0, 1]))
