"""Hot keys: space goes on or pauses, n goes one step, in a live run and in a replay alike."""

from __future__ import annotations

from typing import Any

from ecslam.messages import Pause, Resume, State, Step

from ..hub import Hub
from ..panel import BasePanel

HALTED = (State.PAUSED, State.FINISHED, State.FAILED)


class Panel(BasePanel):
    """Nothing to see: two commands with keys."""

    tab, order = "", 10

    def __init__(self, hub: Hub) -> None:
        super().__init__(hub)
        gui = hub.server.gui
        toggle = gui.add_command("Pause or go on", hotkey="space", description="Stop after this frame, or go on")
        step = gui.add_command("Step one frame", hotkey="N", description="One frame, then pause")

        @toggle.on_trigger
        async def _(event: Any) -> None:
            halted = hub.current is not None and hub.current.state in HALTED
            hub.submit(Resume() if halted else Pause(), event.client)

        @step.on_trigger
        async def _(event: Any) -> None:
            hub.submit(Step(), event.client)
