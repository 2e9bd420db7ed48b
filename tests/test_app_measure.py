"""Measuring in the map: where a ray meets a mesh, which way is up, and what two clicks on the page bring."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from ecslam_app import server
from ecslam_app.geometry import level
from ecslam_app.panels.measure import Panel as Measure
from ecslam_app.panels.measure import table
from ecslam_app.ruler import Hit, Measurement, first_hit, in_words

from ecslam import messages as m
from ecslam.types import Mesh
from tests.fake_engine import FakeEngine, room_mesh, write_run
from tests.test_app_security import CLICK, control, dial, enter, hit, press, say, until

UP, DOWN = np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0])
SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
HALVES = np.array([[0, 1, 2], [0, 2, 3]], np.int32)


def squares(*heights):
    """Level squares that face upwards, at these heights."""
    vertices = np.concatenate([SQUARE + np.array([0, 0, z]) for z in heights]).astype(np.float32)
    return Mesh(vertices, np.concatenate([HALVES + 4 * k for k in range(len(heights))]).astype(np.int32))


def turned(mesh, rotation):
    return Mesh((mesh.vertices @ rotation.T).astype(np.float32), mesh.faces)


def rotation(rng):
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


# ---- geometry ----------------------------------------------------------------------------------------------------


def test_the_nearest_front_face_is_hit():
    found = first_hit(squares(-2.0, 1.0, 0.5), np.array([0.3, -0.4, 5.0]), DOWN)
    assert np.allclose(found.point, [0.3, -0.4, 1.0])
    assert np.allclose(found.normal, UP)


def test_what_is_seen_from_behind_or_lies_behind_is_not_hit():
    assert first_hit(squares(1.0), np.array([0.0, 0.0, -5.0]), UP) is None
    assert first_hit(squares(1.0), np.array([0.0, 0.0, 5.0]), UP) is None
    assert first_hit(squares(1.0), np.array([1.2, 0.0, 5.0]), DOWN) is None
    assert np.allclose(first_hit(squares(1.0, 3.0), np.array([0.2, 0.1, 2.0]), DOWN).point, [0.2, 0.1, 1.0])


def test_a_room_is_measured_through_its_ceiling_and_walls():
    room = room_mesh()
    assert np.allclose(first_hit(room, np.array([1.5, 0.0, 10.0]), DOWN).point, [1.5, 0, 0], atol=1e-6)
    assert np.allclose(first_hit(room, np.array([0.1, 0.0, 10.0]), DOWN).point, [0.1, 0, 0.42], atol=1e-6)
    assert np.allclose(first_hit(room, np.array([1.5, 0.0, 1.0]), UP).point, [1.5, 0, 2.6], atol=1e-6)
    across = first_hit(room, np.array([-9.0, 0.7, 1.4]), np.array([1.0, 0.0, 0.0]))
    assert np.allclose(across.point, [2.2, 0.7, 1.4], atol=1e-6), "through a wall, to the cupboard before the other one"
    assert np.allclose(across.normal, [-1, 0, 0], atol=1e-6)


def test_no_ray_slips_through_an_edge_or_a_corner():
    fan = Mesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]], np.float32),
               np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1]], np.int32))  # fmt: skip
    rng = np.random.default_rng(0)
    for target in ([0, 0, 0], [0.5, 0, 0], [0, -0.25, 0]):
        for origin in rng.normal([0, 0, 6], 1.0, (50, 3)):
            assert first_hit(fan, origin, np.array(target) - origin) is not None


def test_random_triangles_are_hit_where_each_alone_would_be():
    rng = np.random.default_rng(1)
    hits = 0
    for _ in range(200):
        soup = Mesh(rng.normal(size=(60, 3)).astype(np.float32), np.arange(60, dtype=np.int32).reshape(-1, 3))
        origin, direction = 4 * rng.normal(size=3), rng.normal(size=3)
        direction = 0.3 * rng.normal(size=3) - origin if rng.random() < 0.8 else direction
        best = np.inf
        for a, b, c in soup.vertices[soup.faces].astype(float):
            if np.cross(b - a, c - a) @ direction < 0:
                t, u, v = np.linalg.solve(np.stack([-direction, b - a, c - a], 1), origin - a)
                if t > 0 and u >= 0 and v >= 0 and u + v <= 1:
                    best = min(best, t)
        found = first_hit(soup, origin, direction)
        assert (found is None) == (best == np.inf)
        if found is not None:
            hits += 1
            assert np.allclose(found.point, origin + best * direction, atol=1e-9)
    assert hits > 50


def test_a_hit_moves_with_the_world():
    rng, room = np.random.default_rng(2), room_mesh()
    for _ in range(20):
        r, origin, direction = rotation(rng), rng.normal([0, 0, 1.3], 0.2), rng.normal(size=3)
        here, there = first_hit(room, origin, direction), first_hit(turned(room, r), r @ origin, r @ direction)
        assert np.allclose(r @ here.point, there.point, atol=1e-5)
        assert np.allclose(r @ here.normal, there.normal, atol=1e-4)


@pytest.mark.parametrize("tilt_deg", [0, 1, 5, 15, 28])
def test_up_is_read_off_floors_and_tables(tilt_deg):
    t = np.radians(tilt_deg)
    r = np.array([[1, 0, 0], [0, np.cos(t), -np.sin(t)], [0, np.sin(t), np.cos(t)]])
    found = level(turned(room_mesh(), r), UP)
    assert np.allclose(found, UP if tilt_deg < 2 else r @ UP, atol=1e-4)
    assert np.array_equal(found, UP) == (tilt_deg < 2), "a world that is nearly upright is taken for upright"


def test_walls_alone_do_not_say_which_way_is_up():
    r = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    assert level(turned(squares(0.0, 2.0), r), UP) is None


@pytest.mark.parametrize("swap", [False, True])
def test_a_distance_has_a_horizontal_and_a_vertical_part(swap):
    ends = [Hit(np.array([1.0, 2.0, 0.5]), UP), Hit(np.array([4.0, 6.0, 12.5]), UP)]
    done = Measurement(*(reversed(ends) if swap else ends), UP)
    assert (done.distance, done.width, done.height) == pytest.approx((13.0, 5.0, 12.0))
    (a, corner), (same, b) = done.legs()
    assert np.allclose(corner, same)
    assert np.allclose(corner[:2], ends[1].point[:2], atol=1e-6), "plumb below the upper end"
    assert (corner - a) @ (b - corner) == pytest.approx(0)
    assert in_words(done) == "13.00 m\n↔ 5.00 m  ↕ 12.00 m"
    assert "which way is up" not in table([done])


def test_without_an_up_there_is_a_distance_only():
    done = Measurement(Hit(np.zeros(3), UP), Hit(np.array([0.3, 0.0, 0.4]), UP), None)
    assert (done.distance, done.width, done.height) == (pytest.approx(0.5), None, None)
    assert done.legs() == []
    assert in_words(done) == "50.0 cm"
    assert table([done]).count("<td>–</td>") == 2
    assert "which way is up" in table([done])


def test_a_level_line_has_no_legs():
    done = Measurement(Hit(np.zeros(3), UP), Hit(np.array([2.0, 0.0, 0.01]), UP), UP)
    assert done.legs() == []
    assert in_words(done) == "2.00 m"


def test_a_ring_lies_on_the_surface_around_its_point():
    found = Hit(np.array([1.0, 2.0, 3.0]), np.array([0.6, 0.0, 0.8]))
    ring = found.ring()
    assert np.allclose((ring - found.lifted) @ found.normal, 0)
    assert np.ptp(np.linalg.norm(ring - found.lifted, axis=-1)) < 1e-9
    assert np.allclose(ring[:, 1], np.roll(ring[:, 0], -1, 0)), "it is closed"


# ---- the page ----------------------------------------------------------------------------------------------------


@pytest.fixture
def engine(tmp_path):
    engine = FakeEngine(tmp_path / "run", frames=60, period=0.02).skip_to(20)
    yield engine
    engine.stop()


@pytest.fixture
def page(engine):
    page = server.start(engine, port=0)
    assert until(lambda: page.hub.current is engine.latest())
    page.hub.post(lambda: page.hub.scene.show_mesh(room_mesh()))
    assert until(lambda: page.hub.scene.mesh is not None)
    yield page
    page.close()


def panel_of(page):
    return next(p for p in page.hub.panels if isinstance(p, Measure))


def arrive(page, connection):
    """Enter, and get the handle of the new viewer."""
    before = set(page.hub.server.get_clients())
    enter(connection)
    assert until(lambda: set(page.hub.server.get_clients()) > before)
    return next(c for c in page.hub.viewers() if c.client_id not in before)


def begin(page, connection, client):
    press(page, connection, "Measure", True)
    assert until(lambda: panel_of(page).takes_clicks(client))


def click(connection, x, y, **changes):
    """Click straight from above."""
    say(connection, "ScenePointerMessage", **{**CLICK, "ray_origin": [x, y, 10.0], **changes})


def first(page, connection, client, x, y):
    """Click the first point, and wait until it is taken."""
    measurer = panel_of(page)._measurers[client.client_id]
    assert until(lambda: measurer.start is None)
    click(connection, x, y)
    assert until(lambda: measurer.start is not None)


def measure(page, connection, client, a, b):
    before = list(map(id, panel_of(page)._done))
    first(page, connection, client, *a)
    click(connection, *b)
    assert until(lambda: list(map(id, panel_of(page)._done)) != before)


def test_two_clicks_measure_and_a_third_begins_anew(page):
    panel = panel_of(page)
    with dial(page) as connection:
        client = arrive(page, connection)
        begin(page, connection, client)
        measure(page, connection, client, (1.5, 0.0), (0.1, 0.0))
        (done,) = panel._done
        assert (done.distance, done.width, done.height) == pytest.approx((np.hypot(1.4, 0.42), 1.4, 0.42), abs=1e-5)
        assert until(lambda: panel._html.visible and control(page, "Clear measurements")[1].visible)
        assert "1.46 m" in panel._html.content
        assert "1.40 m" in panel._html.content
        assert "42.0 cm" in panel._html.content
        assert np.allclose(panel._lines.points, [[done.start.lifted, done.end.lifted]], atol=1e-6)
        assert [label.text for label in panel._labels if label.visible] == ["1.46 m\n↔ 1.40 m  ↕ 42.0 cm"]
        first(page, connection, client, 1.5, 1.0)
        assert len(panel._done) == 1


def test_only_the_last_few_are_kept_until_they_are_cleared(page):
    panel = panel_of(page)
    with dial(page) as connection:
        client = arrive(page, connection)
        begin(page, connection, client)
        for k in range(7):
            measure(page, connection, client, (1.0, 0.5), (1.2 + 0.1 * k, 0.5))
        assert [round(done.distance, 2) for done in panel._done] == [0.4, 0.5, 0.6, 0.7, 0.8]
        assert until(lambda: [label.text for label in panel._labels][-1] == "80.0 cm")
        first(page, connection, client, 1.5, 1.0)
        press(page, connection, "Clear measurements", True)
        assert until(lambda: not panel._html.visible)
        assert len(panel._lines.points) == len(panel._rings.points) == 0
        assert not any(label.visible for label in panel._labels)
        assert panel._measurers[client.client_id].start is not None, "what is half done is its viewer's"


def test_who_measures_is_up_to_each_viewer(page, monkeypatch):
    panel, visited = panel_of(page), []
    monkeypatch.setattr(page.hub.views, "visit", lambda client, c2w: visited.append(client.client_id))
    keyframe = {**CLICK, "name": "/keyframes/faces", "instance_index": 1, "screen_pos": [0.5, 0.5], "owner": ""}
    del keyframe["event_type"]
    with dial(page) as connection, dial(page) as other:
        client, bystander = arrive(page, connection), arrive(page, other)
        begin(page, connection, client)
        say(connection, "SceneNodeClickMessage", **keyframe)
        first(page, connection, client, 1.5, 0.0)
        click(other, 0.1, 0.0)
        say(other, "SceneNodeClickMessage", **keyframe)
        assert until(lambda: visited)
        assert visited == [bystander.client_id], "a click that measures flies nowhere"
        begin(page, other, bystander)
        assert panel._measurers[bystander.client_id].start is None, "it had not measured before"
        measure(page, other, bystander, (1.5, 0.0), (1.5, 1.0))
        assert panel._measurers[client.client_id].start is not None
        click(connection, 1.5, 0.5)
        assert until(lambda: [round(done.distance, 2) for done in panel._done] == [1.0, 0.5])
        press(page, connection, "Measure", True)
        assert until(lambda: not panel.takes_clicks(client))
        assert panel.takes_clicks(bystander)
        assert client.scene._scene_pointer_cb == []
        assert page.hub.server.scene._scene_pointer_cb == []


def test_the_key_m_begins_and_ends_measuring(page):
    with dial(page) as connection:
        client = arrive(page, connection)
        for wanted in (True, False):
            hit(page, connection, "Measure")
            assert until(lambda wanted=wanted: panel_of(page).takes_clicks(client) == wanted)


@pytest.mark.parametrize("mode", ["Colour", "Normals", "Wireframe", "Off"])
def test_a_click_on_nothing_says_so_whatever_the_mesh_looks_like(page, monkeypatch, mode):
    panel, told = panel_of(page), []
    with dial(page) as connection:
        client = arrive(page, connection)
        monkeypatch.setattr(
            type(client), "add_notification", lambda self, title, text, **how: told.append(text) or _Said()
        )
        begin(page, connection, client)
        press(page, connection, "Mesh", mode)
        assert until(lambda: page.hub.scene._mode == mode)
        click(connection, 8.0, 8.0)
        assert until(lambda: len(told) == 2)
        assert ("no mesh" if mode == "Off" else "no surface") in told[1]
        if mode != "Off":
            measure(page, connection, client, (1.5, 0.0), (0.1, 0.0))
        assert len(panel._done) == (mode != "Off")


class _Said:
    def remove(self):
        pass


def test_measurements_outlast_a_mesh_but_not_a_run(page):
    panel = panel_of(page)
    with dial(page) as connection:
        client = arrive(page, connection)
        begin(page, connection, client)
        measure(page, connection, client, (1.5, 0.0), (0.1, 0.0))
        first(page, connection, client, 1.5, 0.0)
        page.hub.post(lambda: page.hub.scene.show_mesh(squares(0.0, 1.0)))
        assert until(lambda: len(page.hub.scene.mesh.faces) == 4)
        click(connection, 0.5, 0.0)
        assert until(lambda: len(panel._done) == 2)
        assert panel._done[1].distance == pytest.approx(np.sqrt(2), abs=1e-5), "from the old mesh to the new one"
        page.engine.skip_to(30)
        assert until(lambda: page.hub.current.frame == 30)
        assert len(panel._done) == 2
        first(page, connection, client, 0.0, 0.0)
        page.engine.start().submit(m.Restart("synthetic/apartment"))
        assert until(lambda: not panel._done)
        assert panel._measurers[client.client_id].start is None
        assert panel.takes_clicks(client)


def test_a_viewer_that_has_left_is_forgotten(page, caplog):
    panel = panel_of(page)
    with dial(page) as connection:
        client = arrive(page, connection)
        begin(page, connection, client)
        first(page, connection, client, 1.5, 0.0)
    assert until(lambda: not list(page.hub.viewers()))
    page.hub.post(panel.begin)
    with dial(page) as connection:
        newcomer = arrive(page, connection)
        begin(page, connection, newcomer)
    assert set(panel._measurers) == {newcomer.client_id}
    assert "could not carry out" not in caplog.text


def test_clicks_do_not_pile_up(page, monkeypatch):
    panel, stepped = panel_of(page), []
    monkeypatch.setattr(page.hub, "submit", lambda *command: stepped.append(command))
    with dial(page) as connection:
        client = arrive(page, connection)
        begin(page, connection, client)
        gate = threading.Event()
        page.hub.post(gate.wait)
        for _ in range(50):
            click(connection, 1.5, 0.0)
        hit(page, connection, "Step one frame")
        assert until(lambda: stepped), "all clicks have come"
        assert page.hub._inbox.qsize() < 5
        gate.set()
        assert until(lambda: panel._measurers[client.client_id].start is not None)


def test_a_replay_is_measured_too(tmp_path):
    page = server.view([write_run(tmp_path / "a", 30)], port=0)
    try:
        assert until(lambda: page.hub.scene.mesh is not None)
        with dial(page) as connection:
            client = arrive(page, connection)
            begin(page, connection, client)
            measure(page, connection, client, (1.5, 0.0), (1.5, 1.0))
            press(page, connection, "Frame", 12)
            assert until(lambda: page.hub.current.frame == 12)
            assert [round(done.distance, 3) for done in panel_of(page)._done] == [1.0]
    finally:
        page.close()
