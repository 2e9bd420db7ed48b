"""Steering a live run: pause, resume, step, run to, start over, live parameters; and stop, which asks first."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from ecslam.config import Config
from ecslam.config_files import load_config, load_preset
from ecslam.messages import (
    Ack,
    Command,
    LoadPreset,
    Pause,
    Restart,
    Resume,
    RunTo,
    Snapshot,
    SpeedLimit,
    State,
    Step,
    Stop,
    Tune,
)
from ecslam.types import InputError

from .. import theme
from ..hub import Hub
from ..panel import BasePanel, put

SCHEDULES = ("auto", "strict", "overlap")
OVER = (State.FINISHED, State.FAILED)
_VERBS: dict[str, Command] = {"Pause": Pause(), "Resume": Resume(), "Step": Step()}
STOP, REALLY, CANCEL = "Stop", "Stop for good", "Cancel"
FOR_GOOD = (
    "Stop ends this run for good: what it has so far is finished and saved, and it cannot go on. Pause instead to look "
    "around, or to go on later."
)
RESTART = "A new run in a folder of its own; ecslam resume can go on with the one that ends here"


class Panel(BasePanel):
    """Run controls for a live engine."""

    tab, order = "Run", 10

    @classmethod
    def applies(cls, hub: Hub) -> bool:
        return hub.replay is None

    def __init__(self, hub: Hub) -> None:
        super().__init__(hub)
        self._shown: tuple[Path | None, str] = None, ""
        gui = hub.server.gui
        self._ending = False
        self._verbs = gui.add_button_group(
            "Run",
            (*_VERBS, STOP),
            hint="Space pauses and resumes, n goes one step; Stop ends the run for good, and asks first",
        )
        self._verbs.on_click(self._steer)
        self._sure = gui.add_button_group("Stop?", (REALLY, CANCEL), visible=False)
        self._warning = gui.add_html(theme.card(theme.note(FOR_GOOD, theme.BEFORE)), visible=False)
        hub.on(self._sure, lambda event: self._answer(event.target.value == REALLY, event.client))
        self._until = gui.add_number(
            "Frame", 0, min=0, max=1_000_000, step=1, hint="Go on until this frame is done, then pause"
        )
        self._run_to = gui.add_button("Run to frame", color="gray")
        hub.commands(self._run_to, lambda: RunTo(int(self._until.value)))
        self._limit = gui.add_slider("Limit (frames/s)", 0, 60, 1, 0, hint="The most the run may make; 0 is no limit")
        hub.on(self._limit, lambda event: hub.submit(SpeedLimit(float(self._limit.value)), event.client))
        self._start_over()
        self._live_parameters()

    def snapshot(self, s: Snapshot) -> None:
        if self._until.max != s.frames_total - 1:
            self._until.max = s.frames_total - 1
            put(self._until, s.frames_total // 2)
        if (self.hub.engine.run_folder, s.preset) != self._shown:
            self._show_settings(self.hub.engine.run_folder, s.preset)
        self._offer(s.state not in OVER)
        if s.state in OVER:
            self._ask(False)

    def ack(self, ack: Ack) -> None:
        """The preset that is in force already takes back what was tuned."""
        if isinstance(ack.command, LoadPreset) and not ack.error:
            self._shown = self._shown[0], ""

    def begin(self) -> None:
        """What was asked about the run before is settled."""
        self._ending = False
        self._ask(False)

    async def _steer(self, event: Any) -> None:
        """On the event loop, so that a verb never waits. A run that ends anyway is stopped without a question."""
        verb, s = event.target.value, self.hub.current
        if verb in _VERBS:
            self.hub.submit(_VERBS[verb], event.client)
        elif self._ending or (s is not None and not s.live and s.frame + 1 >= s.frames_total):
            self.hub.submit(Stop(), event.client)
        else:
            self.hub.post(lambda: self._ask(True))

    def _ask(self, on: bool) -> None:
        self._warning.visible = self._sure.visible = on

    def _answer(self, really: bool, client: Any) -> None:
        self._ask(False)
        if really:
            self._ending = True
            self.hub.submit(Stop(), client)

    def _offer(self, steering: bool) -> None:
        """Show what steers a run as usable or not; viser cannot disable a group of buttons, so that one goes."""
        self._verbs.visible = steering
        for control in (self._until, self._run_to, self._go_on, *self._iterations.values()):
            control.disabled = not steering

    def _start_over(self) -> None:
        gui, engine = self.hub.server.gui, self.hub.engine
        current, given = engine.latest(), self._given()
        sequences = engine.sequences or ("synthetic/studio",)
        presets = engine.presets or ("lite",)
        with gui.add_folder("Start over"):
            self._sequence = gui.add_dropdown("Sequence", sequences)
            self._preset = gui.add_dropdown(
                "Preset", presets, initial_value=_choose(current.preset if current else "lite", presets)
            )
            self._seed = gui.add_number("Seed", given.seed, min=0, max=2**31 - 1, step=1)
            self._schedule = gui.add_dropdown(
                "Schedule",
                SCHEDULES,
                initial_value=given.schedule,
                hint="strict: repeatable on a CPU; overlap: mapping in parallel; auto: overlap on a GPU, else strict",
            )
            self._realtime = gui.add_checkbox(
                "Real time", given.realtime, hint="As from a camera: frames are left out to keep up with the recording"
            )
            self.hub.commands(
                gui.add_button("Restart", color="orange", hint=RESTART),
                self._restart,
            )
            self._go_on = gui.add_button(
                "Go on with this preset", color="gray", hint="Its tracking and mapping settings from here"
            )
            self.hub.commands(self._go_on, lambda: LoadPreset(self._preset.value))

    def _restart(self) -> Restart:
        seed, schedule = int(self._seed.value), self._schedule.value
        return Restart(self._sequence.value, self._preset.value, seed, schedule, self._realtime.value)

    def _live_parameters(self) -> None:
        gui = self.hub.server.gui
        with gui.add_folder("Iterations", expand_by_default=False):
            self._iterations = {
                key: gui.add_slider(label, fewest, 60, 1, 10, hint=hint)
                for key, label, fewest, hint in (
                    ("tracking.iterations", "Tracking", 0, "Of each frame's pose, from the next frame on"),
                    ("mapping.iterations", "Mapping", 1, "Of each mapping, from the next one on"),
                )
            }
        for key, slider in self._iterations.items():
            self.hub.on(slider, partial(self._tune, key))

    def _tune(self, key: str, event: Any) -> None:
        self.hub.submit(Tune(key, int(event.target.value)), event.client)

    def _show_settings(self, folder: Path, preset: str) -> None:
        """The settings in force: what a run was given when it began, or those of the preset it went on with."""
        if preset in self._preset.options:
            put(self._preset, preset)
        config = self._given() if folder != self._shown[0] else _preset(preset)
        self._shown = folder, preset
        for key, slider in self._iterations.items():
            iterations = getattr(config, key.split(".")[0]).iterations
            put(slider, min(max(iterations, int(slider.min)), int(slider.max)))

    def _given(self) -> Config:
        """What the run was started with: its preset and whatever was laid over it."""
        try:
            return load_config(self.hub.engine.run_folder / "config.yaml")
        except InputError:
            return Config()


def _preset(name: str) -> Config:
    try:
        return load_preset(name)
    except InputError:
        return Config()


def _choose(wanted: str, options: tuple[str, ...]) -> str:
    return wanted if wanted in options else options[0]
