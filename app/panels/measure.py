"""Measuring in the map: two clicks on the mesh give a distance, with its horizontal and vertical part."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from .. import theme
from ..geometry import level
from ..hub import Hub
from ..panel import BasePanel
from ..ruler import Hit, Measurement, first_hit, in_words, metres

MOST = 5
LINE_PX, RING_PX, LEG_PX = 4.0, 4.0, 2.0
HOW = "Click two points on the mesh. Press Measure, or M, again to stop."
FIRST, SECOND = "Measuring: click the first point on the mesh.", "Measuring: click the second point."
NO_UP = "– where the map shows too little floor to tell which way is up."


class _Measurer:
    """A viewer whose clicks measure. start: the first of two points; this viewer alone sees it and what to do next."""

    def __init__(self, client: viser.ClientHandle, clicked: Any) -> None:
        self.client, self.busy = client, False
        self.start: Hit | None = None
        self._clicked = clicked
        self._ring = _lines(client.scene, "start", RING_PX)
        self._next = client.gui.add_html("")
        self.set_start(None)
        self._said = client.add_notification("Measuring", HOW, auto_close_seconds=8.0, color="violet")
        client.scene.on_click()(clicked)

    def set_start(self, start: Hit | None) -> None:
        """Show the first point, or take it away."""
        self.start = start
        self._ring.points = _segments([] if start is None else start.ring())
        self._next.content = theme.card(theme.note(FIRST if start is None else SECOND, theme.MEASURE))

    def refuse(self, why: str) -> None:
        """Say why a click measures nothing, in the place of what was said before."""
        self._said.remove()
        self._said = self.client.add_notification("Nothing measured", why, auto_close_seconds=8.0, color="yellow")

    def stop(self) -> None:
        """Give the viewer its clicks back."""
        self.client.scene.remove_click_callback(self._clicked)
        for shown in (self._ring, self._next, self._said):
            shown.remove()


class Panel(BasePanel):
    """Who measures is up to each viewer; what has been measured is there for all."""

    tab, order = "View", 20

    def __init__(self, hub: Hub) -> None:
        super().__init__(hub)
        gui, scene = hub.server.gui, hub.server.scene
        self._measurers: dict[int, _Measurer] = {}
        self._done: deque[Measurement] = deque(maxlen=MOST)
        hint = "For you alone: click two points on the mesh; press again, or M, to stop"
        hub.on(gui.add_button("Measure", icon=viser.Icon.RULER_MEASURE, color="gray", hint=hint), self._toggle)
        self._html = gui.add_html("", visible=False)
        self._clear = gui.add_button("Clear measurements", icon=viser.Icon.ERASER, color="gray", visible=False)
        hub.on(self._clear, lambda event: self._forget())
        key = gui.add_command("Measure", hotkey="M", description="Click two points on the mesh; again to stop")

        @key.on_trigger
        async def _(event: Any) -> None:
            hub.post(partial(self._toggle, event))

        self._lines = _lines(scene, "lines", LINE_PX)
        self._legs = _lines(scene, "legs", LEG_PX)
        self._rings = _lines(scene, "rings", RING_PX)
        self._labels = [
            scene.add_label(f"/measurements/{k}", "", visible=False, anchor="bottom-center") for k in range(MOST)
        ]

    def begin(self) -> None:
        """What has been measured, or half measured, is in a world that is gone."""
        for measurer in self._measurers.values():
            measurer.set_start(None)
        self._forget()

    def takes_clicks(self, client: viser.ClientHandle) -> bool:
        return client.client_id in self._measurers

    def _forget(self) -> None:
        self._done.clear()
        self._show()

    def _toggle(self, event: Any) -> None:
        client, connected = event.client, self.hub.server.get_clients()
        self._measurers = {number: m for number, m in self._measurers.items() if number in connected}
        measurer = self._measurers.pop(client.client_id, None)
        if measurer is not None:
            measurer.stop()
        elif client.client_id in connected:
            self._measurers[client.client_id] = _Measurer(client, self._clicked)

    async def _clicked(self, event: viser.SceneClickEvent) -> None:
        """On the event loop; who clicks faster than the hub answers is not heard."""
        measurer = self._measurers.get(event.client_id)
        if measurer is not None and not measurer.busy:
            measurer.busy = True
            self.hub.post(partial(self._measure, measurer, event))

    def _measure(self, measurer: _Measurer, event: viser.SceneClickEvent) -> None:
        measurer.busy = False
        if self._measurers.get(event.client_id) is not measurer:
            return
        scene = self.hub.scene
        if scene.surface is None:
            measurer.refuse("There is no mesh on show to measure on.")
            return
        hit = first_hit(scene.surface, np.array(event.ray_origin), np.array(event.ray_direction))
        if hit is None:
            measurer.refuse("There is no surface where you clicked.")
        elif measurer.start is None:
            measurer.set_start(hit)
        else:
            self._done.append(Measurement(measurer.start, hit, level(scene.surface, scene.up)))
            measurer.set_start(None)
            self._show()

    def _show(self) -> None:
        done = list(self._done)
        with self.hub.server.atomic():
            self._lines.points = _segments([[m.start.lifted, m.end.lifted] for m in done])
            self._legs.points = _segments([leg for m in done for leg in m.legs()])
            self._rings.points = _segments([side for m in done for hit in (m.start, m.end) for side in hit.ring()])
            for label, m in zip(self._labels, done, strict=False):
                label.text = in_words(m) if m is done[-1] else metres(m.distance)
                label.position = (m.start.lifted + m.end.lifted) / 2
            for k, label in enumerate(self._labels):
                label.visible = k < len(done)
        self._html.content = table(done)
        self._html.visible = self._clear.visible = bool(done)


def table(done: Sequence[Measurement]) -> str:
    """Measurements as an HTML table, the newest first."""
    rows = "".join(
        "<tr>"
        + "".join(f"<td>{'–' if part is None else metres(part)}</td>" for part in (m.distance, m.width, m.height))
        + "</tr>"
        for m in reversed(done)
    )
    unknown = f'<span class="dim">{NO_UP}</span>' if any(m.up is None for m in done) else ""
    return theme.card(f"<table><tr><th>distance</th><th>horizontal</th><th>vertical</th></tr>{rows}</table>{unknown}")


def _lines(scene: viser.SceneApi, name: str, width: float) -> viser.LineSegmentsHandle:
    return scene.add_line_segments(
        f"/measurements/{name}", _segments([]), theme.MEASURE, thickness=width, thickness_units="screen"
    )


def _segments(segments: Any) -> NDArray[np.float32]:
    return np.asarray(segments, np.float32).reshape(-1, 2, 3)
