"""The first view, and who moves the camera: the page until the viewer does."""

from __future__ import annotations

import numpy as np
import pytest
from ecslam_app import server, views
from ecslam_app.geometry import behind

from tests.fake_engine import FakeEngine
from tests.test_app_security import CAMERA, dial, enter, press, say, until

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
    with dial(page) as connection:
        enter(connection)
        assert until(lambda: list(page.hub.viewers()))
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
