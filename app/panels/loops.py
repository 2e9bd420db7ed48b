"""The loop-closure inspector: a timeline of the error with a marker per event; choosing one flies there."""

from __future__ import annotations

from typing import Any

import numpy as np

from ecslam.messages import LoopEvent, PauseOnLoop, Snapshot

from .. import theme
from ..history import discrepancy
from ..hub import Hub
from ..panel import BasePanel, put
from .plots import Chart

NONE = "None"
AROUND = 1.6


class Panel(BasePanel):
    """Timeline, choice of an event, its figures."""

    tab, order = "Loops", 10

    def __init__(self, hub: Hub) -> None:
        super().__init__(hub)
        gui = hub.server.gui
        self._events: tuple[LoopEvent, ...] = ()
        self._inspected: LoopEvent | None = None
        self._chart = Chart(hub, "Rotation error (°)", markers=True)
        self._choice = gui.add_dropdown("Loop event", (NONE,), initial_value=NONE, visible=False)
        hub.on(self._choice, lambda event: self._inspect(event.client))
        self._steps = gui.add_button_group("Go to", ("Previous event", "Next event"), visible=False)
        hub.on(self._steps, lambda event: self._move(-1 if event.target.value.startswith("Prev") else 1, event.client))
        self._html = gui.add_html(_intro(()))
        colors = [("links", theme.LOOP), ("before", theme.BEFORE), ("after", theme.ESTIMATE), ("window", theme.WINDOW)]
        self._legend = gui.add_html(theme.card(theme.legend(colors)), visible=False)
        if hub.replay is None:
            pause = gui.add_checkbox("Pause on loops", False, hint="Pause whenever a loop has closed")
            hub.on(pause, lambda event: hub.submit(PauseOnLoop(bool(pause.value)), event.client))

    def snapshot(self, s: Snapshot) -> None:
        names = (NONE, *map(_name, s.loops))
        if names != self._choice.options:
            self._events, self._choice.options = s.loops, names
            for control in (self._choice, self._steps, self._legend):
                control.visible = bool(s.loops)
            if self._inspected is None:
                self._html.content = _intro(s.loops)
            if self._inspected is not None and _name(self._inspected) not in names:
                self._inspect(None)
        title, frames, values = discrepancy(s)
        marks = np.full(len(frames), np.nan)
        for event in s.loops:
            at = int(np.argmin(np.abs(frames - event.frame)))
            marks[at] = np.nan_to_num(values[at])
        self._chart.entitle(title)
        self._chart.show([title, "loop closed"], (frames, values, marks), s.frame)

    def _move(self, step: int, client: Any) -> None:
        if self._events:
            options = list(self._choice.options)
            at = options.index(self._choice.value) + step
            put(self._choice, options[(at - 1) % (len(options) - 1) + 1])
            self._inspect(client)

    def _inspect(self, client: Any) -> None:
        event = next((e for e in self._events if _name(e) == self._choice.value), None)
        self._inspected, s = event, self.hub.current
        self.hub.scene.inspect(event, self.hub.history.window_at(event.frame) if event else ())
        self._html.content = _intro(self._events) if event is None else _figures(event)
        if s is None:
            return
        self.hub.scene.update(s)
        if event is not None and event.frame < len(s.trajectory) and client is not None:
            path = np.concatenate([s.trajectory[: event.frame + 1, :3, 3], event.trajectory_before])
            self.hub.views.show(client, path.mean(0) + AROUND * (path - path.mean(0)))


def _name(event: LoopEvent) -> str:
    return f"Frame {event.frame}: {event.correction_cm:.2f} cm"


def _intro(events: tuple[LoopEvent, ...]) -> str:
    next_step = (
        "Choose an event to see the links and the path before and after." if events else "None has closed so far."
    )
    return theme.card(
        '<span class="dim">When old keyframes come back into the window, the joint optimisation closes the loop. '
        f"{next_step}</span>"
    )


def _figures(e: LoopEvent) -> str:
    rows = [
        ("Weighted loss", e.loss_before, e.loss_after, 3),
        ("Position error, cm", e.error_before_cm, e.error_after_cm, 2),
        ("Rotation error, °", e.rotation_error_before_deg, e.rotation_error_after_deg, 2),
    ]
    body = "".join(
        f"<tr><td>{name}</td><td>{theme.number(before, digits)}</td><td><b>{theme.number(after, digits)}</b></td></tr>"
        for name, before, after, digits in rows
        if before is not None
    )
    old = f"keyframe{'s' * (len(e.keyframes) > 1)} {', '.join(map(str, e.keyframes))}"
    return (
        f'<div class="ec"><b>Frame {e.frame} met {old}</b><br>The pose moved by '
        f"<b>{e.correction_cm:.2f} cm</b> and <b>{e.correction_deg:.2f}°</b>."
        f"<table><tr><th></th><th>before</th><th>after</th></tr>{body}</table></div>"
    )
