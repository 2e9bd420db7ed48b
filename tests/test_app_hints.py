"""Buttons say what they do, though viser would not show it."""

from __future__ import annotations

import json
from html import unescape
from types import SimpleNamespace

import viser
from ecslam_app import hints, server
from ecslam_app.page import index_page
from websockets.datastructures import Headers

from tests.fake_engine import FakeEngine
from tests.test_app_security import control


def test_the_page_knows_the_hint_of_every_button(tmp_path, monkeypatch):
    engine, handed = FakeEngine(tmp_path / "run"), []
    monkeypatch.setattr(viser.GuiApi, "add_html", lambda gui, html, **_: handed.append(html) or SimpleNamespace())
    page = server.start(engine, port=0)
    try:
        (html,) = (html for html in handed if "data-hints" in html)
        told = json.loads(unescape(html.split('"')[1]))
        for label in ("Restart", "Go on with this preset", "Follow camera", "Measure", "Export run as zip"):
            uuid, button = control(page, label)
            assert told[uuid] == button.hint, label
        assert control(page, "Run")[0] not in told, "a group of buttons shows its hint itself"
    finally:
        page.close()
        engine.stop()


def test_the_page_shows_hints_of_buttons():
    body = index_page(Headers()).body.decode()
    assert hints.SCRIPT in body
    assert hints.STYLE in body
