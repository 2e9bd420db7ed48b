"""How the scene is shown: mesh mode and detail, layers, follow, reset, light or dark."""

from __future__ import annotations

from functools import partial
from typing import Any

import viser

from ecslam.messages import RequestMesh

from ..glb import TRIANGLE_BUDGET
from ..hub import Hub
from ..panel import BasePanel
from ..scene import MESH_MODES

FOR_ALL = "For all who look at this run"


class Panel(BasePanel):
    """View options, shared by all viewers; the buttons move the view of who presses them."""

    tab, order = "View", 10

    def __init__(self, hub: Hub) -> None:
        super().__init__(hub)
        gui = hub.server.gui
        mode = gui.add_dropdown("Mesh", MESH_MODES, hint=FOR_ALL)
        hub.on(mode, lambda event: self._set_mode(mode.value))
        if hub.replay is None:
            detail = gui.add_slider(
                "Mesh detail (cm)",
                2.0,
                12.0,
                0.5,
                2.0,
                hint="Finest voxel of the live mesh; exports have their own",
            )
            hub.on(detail, lambda event: hub.submit(RequestMesh(detail.value / 100, TRIANGLE_BUDGET), event.client))
        for label, group in (("Ground truth", "trajectory/ground truth"), ("Keyframes", "keyframes")):
            layer = gui.add_checkbox(label, True, hint=FOR_ALL)
            hub.on(layer, partial(self._set_layer, group))
        dark = gui.add_checkbox("Dark", hub.dark, hint=FOR_ALL)
        hub.on(dark, lambda event: self._set_dark(bool(dark.value)))
        follow = gui.add_button(
            "Follow camera", icon=viser.Icon.VIDEO, color="gray", hint="For you alone, until you move the view"
        )
        hub.on(follow, lambda event: self._follow(event.client))
        reset = gui.add_button(
            "Reset view", icon=viser.Icon.FOCUS_CENTERED, color="gray", hint="For you alone: everything in sight"
        )
        hub.on(reset, lambda event: hub.views.show_all(event.client))
        straight = gui.add_button_group(
            "Look from",
            ("Above", "The side"),
            hint="For you alone: a floor plan, or straight at a wall; the grid has a line every half metre",
        )
        hub.on(straight, lambda event: hub.views.straight(event.client, straight.value == "Above"))

    def _set_layer(self, group: str, event: Any) -> None:
        self.hub.scene.set_visible(group, bool(event.target.value))

    def _set_mode(self, mode: str) -> None:
        self.hub.scene.set_mode(mode)

    def _follow(self, client: viser.ClientHandle) -> None:
        if self.hub.current is not None and len(self.hub.current.trajectory):
            self.hub.views.follow(client, self.hub.current.trajectory[-1])
        else:
            self.hub.toast("Not done", "there is no camera to follow before the first frame is done", "red", client)

    def _set_dark(self, on: bool) -> None:
        self.hub.dark = on
        self.hub.theme()
