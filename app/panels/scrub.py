"""Moving through a finished run: play, pause, step, and a slider over its frames."""

from __future__ import annotations

from ecslam.messages import Command, Pause, Resume, RunTo, Snapshot, SpeedLimit, Step

from ..hub import Hub
from ..panel import BasePanel, put

_VERBS: dict[str, Command] = {"Play": Resume(), "Pause": Pause(), "Step": Step()}


class Panel(BasePanel):
    """The time line of a replay."""

    tab, order = "Run", 10

    @classmethod
    def applies(cls, hub: Hub) -> bool:
        return hub.replay is not None

    def __init__(self, hub: Hub) -> None:
        super().__init__(hub)
        gui, last = hub.server.gui, hub.replay.run.last if hub.replay else 0
        self._slider = gui.add_slider("Frame", 0, max(last, 1), 1, last)
        self._asked: int | None = None
        hub.on(self._slider, lambda event: self._go_to(int(self._slider.value)))
        verbs = gui.add_button_group("Replay", tuple(_VERBS), hint="Space plays and pauses, n goes one step")
        hub.commands(verbs, lambda: _VERBS[verbs.value])
        speed = gui.add_slider("Frames/s", 1, 60, 1, 20)
        hub.on(speed, lambda event: hub.submit(SpeedLimit(float(speed.value)), event.client))

    def snapshot(self, s: Snapshot) -> None:
        if self._asked == s.frame:
            self._asked = None
        if self._asked is None and int(self._slider.value) != s.frame:
            put(self._slider, s.frame)

    def _go_to(self, frame: int) -> None:
        """Until the replay is at ``frame``, what it shows on the way must not move the slider under the hand."""
        self._asked = frame
        self.hub.submit(RunTo(frame))
