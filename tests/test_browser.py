"""What a user does, in a real browser: watch a run, steer it, take it away, look at it again."""

from __future__ import annotations

import io
import re
import time
import warnings

import numpy as np
import pytest
import trimesh
from ecslam_app import server
from ecslam_app.browser import PATIENCE_MS, dismiss_toasts, install_chromium, launch, new_page
from PIL import Image

from ecslam import messages as m
from ecslam.config_files import load_preset
from ecslam.datasets import open_sequence
from ecslam.runtime.engine import Engine
from tests.fake_engine import FakeEngine, write_run

pytestmark = [pytest.mark.browser, pytest.mark.slow]


@pytest.fixture(scope="session")
def browser():
    pytest.importorskip("playwright", reason="browser tests need: pip install playwright")
    path = install_chromium()
    if path is None:
        warnings.warn("BROWSER TESTS SKIPPED: no Chromium here, and apt may not install it", stacklevel=1)
        pytest.skip("no Chromium here, and apt may not install it")
    with launch(path) as chromium:
        yield chromium


# The lowest contrast (WCAG 2) of small texts on the status card: each is painted on all that lies behind it.
CONTRAST = """() => {
  const pen = document.createElement('canvas').getContext('2d', {willReadFrequently: true});
  const light = colours => {
    for (const c of ['white', ...colours]) { pen.fillStyle = c; pen.fillRect(0, 0, 1, 1); }
    const [r, g, b] = [...pen.getImageData(0, 0, 1, 1).data].map(v => ((v / 255 + 0.055) / 1.055) ** 2.4);
    return 0.2126 * r + 0.7152 * g + 0.0722 * b + 0.05;
  };
  const behind = e => e ? [...behind(e.parentElement), getComputedStyle(e).backgroundColor] : [];
  return Math.min(...[...document.querySelectorAll('.ec-chip, .ec .dim, .ec-cell span, .ec-key span')].map(e => {
    const [text, ground] = [light([...behind(e), getComputedStyle(e).color]), light(behind(e))];
    return Math.max(text, ground) / Math.min(text, ground);
  }));
}"""


class Visit:
    """One tab on a dashboard, with what its console complained about."""

    def __init__(self, browser, dashboard, width=1060, height=640):
        self.errors, self.dashboard = [], dashboard
        self.page = new_page(browser, width, height)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("console", lambda line: self.errors.append(line.text) if line.type == "error" else None)
        self.page.goto(dashboard.url)
        self.page.locator(".ec-row b").wait_for()
        self.wait(lambda: dashboard.hub.scene.mesh is not None)
        self.page.wait_for_timeout(1500)
        dismiss_toasts(self.page)

    @property
    def frame(self):
        return int(self.page.locator(".ec-row b").inner_text())

    @property
    def camera(self):
        return np.array(next(iter(self.dashboard.hub.viewers())).camera.position)

    @property
    def axes(self):
        """Right, down and forward of the camera, as columns."""
        return _rotation(next(iter(self.dashboard.hub.viewers())).camera.wxyz)

    def pixel(self, point):
        """Where on the page a point of the world [3] is seen."""
        client, box = next(iter(self.dashboard.hub.viewers())), self.page.locator("canvas").first.bounding_box()
        x, y, z = self.axes.T @ (point - client.camera.position)
        focal = box["height"] / 2 / np.tan(client.camera.fov / 2)
        return box["x"] + box["width"] / 2 + focal * x / z, box["y"] + box["height"] / 2 + focal * y / z

    def finger(self, *path):
        """Touch the page, move along the path, and let go."""
        touch = self.page.context.new_cdp_session(self.page)
        for k, (x, y) in enumerate(path):
            kind = "touchMove" if k else "touchStart"
            touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": [{"x": x, "y": y}]})
        touch.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
        touch.detach()

    def press(self, name):
        self.page.get_by_role("button", name=name, exact=True).click()

    def choose(self, label, option):
        self.page.get_by_label(label, exact=True).first.click()
        self.page.get_by_role("option", name=option, exact=True).click()

    def tab(self, name):
        self.page.get_by_role("tab", name=name).click()

    def tick(self, label):
        self.page.get_by_label(label, exact=True).click()

    def state(self, text):
        self.wait(lambda: self.page.locator(".ec-chip", has_text=text).count() == 1)

    def wait(self, condition, seconds=120):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if condition():
                return
            self.page.wait_for_timeout(50)
        shown, current = self.page.locator(".ec").first.inner_text(), self.dashboard.hub.current.state
        raise AssertionError(f"waited in vain; the page says {shown!r}, the engine {current}")

    def wait_or_reload(self, condition, seconds=40):
        """Browsers that draw in software sometimes stop taking messages; a person would load the page again."""
        try:
            self.wait(condition, seconds)
        except AssertionError:
            self.page.reload()
            self.wait(condition)

    def download(self, button):
        with self.page.expect_download(timeout=PATIENCE_MS) as download:
            self.press(button)
        return download.value

    def pixels(self):
        """The scene without the panel at the right, float [h, w, 3]."""
        self.page.wait_for_timeout(700)
        picture = Image.open(io.BytesIO(self.page.screenshot())).convert("RGB")
        return np.asarray(picture, float)[:, : picture.width - 380]


def hue_count(pixels, hue_deg, spread=14):
    """How many clearly coloured pixels have about this hue."""
    hsv = np.asarray(Image.fromarray(pixels.astype(np.uint8)).convert("HSV"), float)
    away = np.abs((hsv[..., 0] * 360 / 255 - hue_deg + 180) % 360 - 180)
    return int(((away < spread) & (hsv[..., 1] > 110) & (hsv[..., 2] > 110)).sum())


@pytest.fixture
def live(tmp_path, browser):
    engine = FakeEngine(tmp_path / "run", frames=400, period=0.25).skip_to(100).start()
    dashboard = server.start(engine, port=0)
    visit = Visit(browser, dashboard)
    yield engine, visit
    visit.page.close()
    dashboard.close()
    engine.stop()
    assert visit.errors == []


def test_scene_shows_mesh_trajectories_and_frusta(live):
    _, visit = live
    visit.tab("View")
    full = visit.pixels()
    visit.choose("Mesh", "Off")
    visit.wait(lambda: (np.abs(full - visit.pixels()).max(-1) > 25).mean() > 0.1)  # the mesh covers much of the view
    bare = visit.pixels()
    assert hue_count(bare, 25) > 300, "the estimate is orange"
    assert hue_count(bare, 217) > 300, "the ground truth is blue"
    assert hue_count(bare, 292) > 60, "the window is magenta"
    visit.tick("Ground truth")
    visit.wait(lambda: hue_count(visit.pixels(), 217) < 0.2 * hue_count(bare, 217))
    visit.tick("Keyframes")
    visit.wait(lambda: hue_count(visit.pixels(), 292) < 0.5 * hue_count(bare, 292))
    visit.choose("Mesh", "Wireframe")
    visit.wait(lambda: (np.abs(visit.pixels() - bare).max(-1) > 25).mean() > 0.02)


def test_pause_step_resume_and_hot_keys(live):
    _, visit = live
    visit.press("Resume")
    visit.wait(lambda: visit.frame > 103)
    visit.press("Pause")
    visit.state("Paused")
    before = visit.frame
    visit.page.wait_for_timeout(1500)
    assert visit.frame == before
    assert visit.page.evaluate(CONTRAST) > 4.5
    visit.press("Step")
    visit.wait(lambda: visit.frame == before + 1)
    visit.page.wait_for_timeout(500)
    assert visit.frame == before + 1
    visit.page.mouse.click(300, 300)
    visit.page.keyboard.press("n")
    visit.wait(lambda: visit.frame == before + 2)
    visit.state("Paused")
    visit.page.get_by_role("button", name="Step", exact=True).focus()
    visit.page.keyboard.press("Space")
    visit.wait(lambda: visit.frame == before + 3)
    visit.page.wait_for_timeout(1000)
    assert visit.frame == before + 3, "space presses the button that has the focus and no more"
    visit.page.mouse.click(300, 300)
    visit.page.keyboard.press("Space")
    visit.wait(lambda: visit.frame > before + 5)
    visit.press("Pause")
    visit.state("Paused")


def test_hot_keys_work_wherever_the_focus_is_but_in_a_field(browser, tmp_path):
    dashboard = server.view([write_run(tmp_path / "run", 60)], port=0)
    visit = Visit(browser, dashboard)
    page, box = visit.page, visit.page.get_by_label("Keyframes", exact=True)

    def plays():
        dashboard.engine.submit(m.RunTo(20))
        visit.wait(lambda: visit.frame == 20)
        page.keyboard.press("n")
        visit.wait(lambda: visit.frame == 21)
        page.keyboard.press("Space")
        visit.wait(lambda: visit.frame > 22)

    try:
        for act in (
            lambda: visit.tab("Plots"),
            lambda: page.get_by_role("tab", name="Run").focus(),
            lambda: (visit.tab("View"), visit.tick("Keyframes")),
            lambda: [page.locator("label", has_text="Keyframes").click() for _ in range(2)],
            lambda: visit.choose("Mesh", "Normals"),
        ):
            act()
            plays()
        assert not box.is_checked(), "space has left alone what was clicked"
        dashboard.engine.submit(m.RunTo(20))
        box.focus()
        page.keyboard.press("n")
        visit.wait(lambda: visit.frame == 21)
        page.keyboard.press("Space")
        visit.wait(box.is_checked)
        visit.tab("Run")
        page.get_by_role("textbox").first.click()
        for key in ("n", "Space"):
            page.keyboard.press(key)
        page.wait_for_timeout(1000)
        assert visit.frame == 21
        page.keyboard.press("Enter")
        page.keyboard.press("n")
        visit.wait(lambda: visit.frame == 22)
    finally:
        page.close()
        dashboard.close()
    assert visit.errors == []


def test_switch_preset_and_start_over(live):
    engine, visit = live
    restart = visit.page.get_by_role("button", name="Restart", exact=True)
    restart.hover()
    shown = "e => getComputedStyle(e, '::after').content"
    visit.wait(lambda: "in a folder of its own" in restart.evaluate(shown))
    visit.page.mouse.move(300, 300)
    visit.wait(lambda: restart.evaluate(shown) == "none")
    visit.choose("Preset", "full")
    visit.press("Restart")
    visit.wait(lambda: m.Restart("synthetic/studio", "full", 0, "auto", False) in engine.log)
    visit.page.locator(".ec-name", has_text="full").wait_for()
    assert engine.latest().preset == "full"


def test_exports_arrive_in_the_browser(live, tmp_path):
    engine, visit = live
    visit.tab("Export")
    visit.download("Export mesh").save_as(tmp_path / "mesh.ply")
    mesh = trimesh.load_mesh(tmp_path / "mesh.ply", process=False)
    assert len(mesh.faces) > 1000
    assert len(np.unique(mesh.visual.vertex_colors, axis=0)) > 10
    visit.page.get_by_text(str(engine.run_folder)).first.wait_for()
    visit.download("Export trajectory").save_as(tmp_path / "poses.txt")
    assert len((tmp_path / "poses.txt").read_text().splitlines()) == visit.frame + 1
    visit.download("Save screenshot").save_as(tmp_path / "shot.png")
    assert np.asarray(Image.open(tmp_path / "shot.png")).std() > 10
    assert list((engine.run_folder / "exports").glob("screenshot-*.png"))


def test_html_replay_plays_by_itself(live, browser, tmp_path):
    _, visit = live
    visit.tab("Export")
    visit.download("Save HTML replay").save_as(tmp_path / "replay.html")
    page, errors = new_page(browser, 600, 400), []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(f"file://{tmp_path / 'replay.html'}")
    for _ in range(100):
        page.wait_for_timeout(1000)
        picture = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"), float)
        if hue_count(picture, 25) > 50:
            break
    page.close()
    assert hue_count(picture, 25) > 50
    assert errors == []


def test_click_on_a_keyframe_flies_there(live):
    engine, visit = live
    visit.tab("Pictures")
    visit.page.wait_for_timeout(800)
    before = visit.camera
    for keyframe in engine.latest().keyframes[3:8]:
        visit.page.mouse.click(*visit.pixel(keyframe.c2w[:3, 3] + 0.09 * keyframe.c2w[:3, 2]))
        visit.page.wait_for_timeout(1200)
        if np.linalg.norm(visit.camera - before) > 0.5:
            break
    assert np.linalg.norm(visit.camera - before) > 0.5
    assert visit.page.get_by_text(re.compile(r"^Keyframe \d+$")).count() == 1


def test_two_clicks_measure_the_room_and_dragging_still_turns_it(browser, tmp_path):
    dashboard = server.view([write_run(tmp_path / "run", 30)], port=0)
    visit = Visit(browser, dashboard)
    page, distances = visit.page, visit.page.locator(".ec td:first-child:visible")
    try:
        visit.tab("View")
        visit.press("Measure")
        page.get_by_text("click the first point").wait_for()
        bare, before = visit.pixels(), visit.camera
        visit.tick("Keyframes")
        page.mouse.click(*visit.pixel([1.0, -0.8, 0.0]))
        page.get_by_text("click the second point").wait_for()
        page.mouse.click(*visit.pixel([1.0, 1.2, 0.0]))
        visit.wait(lambda: distances.all_inner_texts() in (["1.99 m"], ["2.00 m"], ["2.01 m"]))
        visit.wait(lambda: hue_count(visit.pixels(), 262) > hue_count(bare, 262) + 100)
        assert np.allclose(visit.camera, before)
        page.mouse.move(300, 300)
        page.mouse.down()
        page.mouse.move(360, 300, steps=4)
        page.mouse.up()
        visit.wait(lambda: np.linalg.norm(visit.camera - before) > 0.3)
        page.get_by_text("click the first point").wait_for()
        page.mouse.click(8, 632)
        page.get_by_text("There is no surface where you clicked").wait_for()
        page.keyboard.press("m")
        visit.wait(lambda: page.get_by_text("click the first point").count() == 0)
        visit.press("Clear measurements")
        visit.wait(lambda: distances.count() == 0)
        visit.wait(lambda: hue_count(visit.pixels(), 262) <= hue_count(bare, 262) + 20)
        visit.press("Above")
        visit.wait(lambda: visit.axes[2, 2] < -0.999)
        visit.wait(lambda: np.abs(visit.axes[:, 0]).max() > 0.999)  # the walls stand along the edges of the page
        visit.press("Measure")
        page.get_by_text("click the first point").wait_for()
        page.mouse.click(*visit.pixel([1.0, -0.8, 0.0]))
        page.get_by_text("click the second point").wait_for()
        page.mouse.click(*visit.pixel([1.0, 1.2, 0.0]))
        visit.wait(lambda: distances.all_inner_texts() in (["1.99 m"], ["2.00 m"], ["2.01 m"]))
    finally:
        page.close()
        dashboard.close()
    assert visit.errors == []


def _rotation(wxyz):
    import viser.transforms as vt

    return vt.SO3(np.asarray(wxyz)).as_matrix()


def test_finished_run_is_scrubbed_and_its_loop_inspected(browser, tmp_path):
    dashboard = server.view([write_run(tmp_path / "lite", 60), write_run(tmp_path / "full", 60, drift=0.3)], port=0)
    visit = Visit(browser, dashboard)
    try:
        assert visit.frame == 59
        assert visit.page.get_by_text("ATE RMSE, cm").count() == 1
        slider = visit.page.get_by_role("slider").first
        slider.focus()
        for _ in range(12):
            visit.page.keyboard.press("ArrowLeft")
        visit.wait(lambda: visit.frame == 47)
        visit.press("Play")
        visit.wait(lambda: visit.frame == 59)
        before = visit.camera
        visit.tab("Loops")
        visit.press("Next event")
        visit.page.get_by_text("met keyframes").wait_for()
        visit.page.wait_for_timeout(1500)
        assert np.linalg.norm(visit.camera - before) > 0.3
        assert hue_count(visit.pixels(), 160) > 20, "the links are green"
        visit.tab("Plots")
        visit.page.locator(".u-over:visible").first.hover()
        shown = visit.page.locator(".u-legend:visible .u-value:visible")
        visit.wait(lambda: [float(text) > 0 for text in shown.all_inner_texts()[:2] if text != "--"] == [True, True])
    finally:
        visit.page.close()
        dashboard.close()
    assert visit.errors == []


def test_page_survives_a_lost_connection(live):
    _, visit = live
    visit.press("Resume")
    visit.dashboard.hub.server._websock_server.disconnect_all_clients()
    before = visit.frame
    visit.wait(lambda: visit.frame > before + 3)
    visit.errors.clear()  # the browser itself reports the lost socket


def test_page_comes_back_when_the_server_does(tmp_path, browser):
    engine = FakeEngine(tmp_path / "run", frames=400, period=0.25).skip_to(20).start()
    dashboard = server.start(engine, port=0)
    visit = Visit(browser, dashboard, 600, 400)
    dashboard.close()
    away = "document.documentElement.dataset.away || ''"
    visit.wait(lambda: visit.page.evaluate(away).startswith("No connection"))
    for _ in range(60):  # as many failures as a minute brings: from now on the browser holds each try back for seconds
        visit.page.evaluate("void new WebSocket(location.origin.replace('http', 'ws'))")
    visit.page.wait_for_timeout(8000)
    dashboard = server.start(engine, port=dashboard.port, token="a-token-of-some-length")
    visit.wait(lambda: "open the address" in visit.page.evaluate(away), 20)
    dashboard.close()
    engine.skip_to(30)
    dashboard = server.start(engine, port=dashboard.port)
    try:
        visit.wait(lambda: visit.frame == 30, 20)
        assert not visit.page.evaluate(away)
    finally:
        visit.page.close()
        dashboard.close()
        engine.stop()


def test_usable_on_a_phone(tmp_path, browser):
    engine = FakeEngine(tmp_path / "run", frames=2000, period=0.25).start()
    dashboard = server.start(engine, port=0, dark=True)
    visit = Visit(browser, dashboard, 390, 780)
    try:
        visit.press("Pause")
        visit.state("Paused")
        wide = visit.page.evaluate("document.documentElement.scrollWidth")
        card = visit.page.locator(".ec").first.bounding_box()
        assert wide <= 390
        assert card["x"] >= 0
        assert card["x"] + card["width"] <= 390
        assert card["width"] > 340
        assert card["height"] < 240, "it leaves room for the controls"
        assert visit.page.evaluate(CONTRAST) > 4.5
        visit.tab("View")
        visit.press("Measure")
        visit.page.get_by_text("click the first point").wait_for()
        before, mesh = visit.camera, dashboard.hub.scene.mesh
        a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(float) for k in range(3))
        front = (np.cross(b - a, c - a) * (before - a)).sum(1) > 0
        seen = [(x, y) for x, y in map(visit.pixel, a[front][::20]) if 40 < x < 350 and 120 < y < 340]
        visit.finger(seen[len(seen) // 2])
        visit.wait(lambda: visit.page.get_by_text("click the second point").count() == 1, 40)
        visit.finger((100, 200), (130, 205), (160, 210), (190, 215), (190, 500))
        visit.wait(lambda: np.linalg.norm(visit.camera - before) > 0.3)
        assert visit.page.get_by_text("click the second point").count() == 1, "turning the view is no tap"
    finally:
        visit.page.close()
        dashboard.close()
        engine.stop()
    assert visit.errors == []


def test_the_engine_proper_is_watched_paused_stepped_and_taken_away(browser, tmp_path):
    engine = Engine(load_preset("live"), open_sequence("synthetic/studio?size=160x120&frames=4000"), tmp_path / "run")
    dashboard = server.start(engine, port=0)
    engine.start()
    visit = Visit(browser, dashboard)
    try:
        visit.wait_or_reload(lambda: visit.frame > 2)
        visit.press("Pause")
        visit.state("Paused")
        before = visit.frame
        visit.press("Step")
        visit.wait(lambda: visit.frame == before + 1)
        visit.state("Paused")
        visit.tab("View")
        visit.choose("Mesh", "Off")
        visit.wait(lambda: not dashboard.hub.scene._mesh_handle.visible)
        bare = visit.pixels()
        visit.choose("Mesh", "Colour")
        visit.wait(lambda: (np.abs(visit.pixels() - bare).max(-1) > 25).mean() > 0.03)
        visit.tab("Export")
        visit.download("Export mesh").save_as(tmp_path / "mesh.ply")
        mesh = trimesh.load_mesh(tmp_path / "mesh.ply", process=False)
        assert len(mesh.faces) > 1000
        assert len(np.unique(mesh.visual.vertex_colors, axis=0)) > 100
        visit.download("Export trajectory").save_as(tmp_path / "poses.txt")
        assert len((tmp_path / "poses.txt").read_text().splitlines()) == before + 2 == visit.frame + 1
    finally:
        visit.page.close()
        engine.submit(m.Quit())
        engine.join()
        dashboard.close()
    assert engine.error is None
    assert visit.errors == []
