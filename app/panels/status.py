"""What is going on, in plain words and figures; always in sight above the tabs."""

from __future__ import annotations

from html import escape

from ecslam.messages import Ack, Command, LoadPreset, Pause, Restart, Resume, RunTo, Snapshot, State, Step, Stop

from .. import theme
from ..hub import Hub
from ..panel import BasePanel

WORDS = {
    State.IDLE: "Ready to start",
    State.INITIALISING: "Initialising the map",
    State.TRACKING: "Tracking",
    State.MAPPING: "Mapping",
    State.LOST: "Lost",
    State.RELOCALISING: "Relocalising",
    State.PAUSED: "Paused",
    State.FINISHED: "Finished",
    State.FAILED: "Failed",
}
_REPLAYED = {State.TRACKING: "Playing", State.FINISHED: "At the end"}
_LINES = {
    "estimate": theme.ESTIMATE,
    "ground truth": theme.TRUTH,
    "keyframe": theme.KEYFRAME,
    "window": theme.WINDOW,
    "loop": theme.LOOP,
}
_COMING = {
    Pause: "Pausing …",
    Stop: "Stopping …",
    Step: "One step …",
    Resume: "Resuming …",
    RunTo: "Running on …",
    Restart: "Restarting …",
    LoadPreset: "Changing preset …",
}
_SETTLED = (State.PAUSED, State.FINISHED, State.FAILED)


class Panel(BasePanel):
    """State, progress, rates, times, error, memory, keyframes, window, loops."""

    tab, order = "", 0

    def __init__(self, hub: Hub) -> None:
        super().__init__(hub)
        self._halting: Command | None = None
        self._html = hub.server.gui.add_html(render(None, ""))

    def snapshot(self, s: Snapshot) -> None:
        if s.state in _SETTLED:
            self._halting = None
        replayed = _REPLAYED.get(s.state, "") if self.hub.replay is not None else ""
        self._html.content = render(s, _COMING[type(self._halting)] if self._halting else replayed)

    def ack(self, ack: Ack) -> None:
        """Answer at once; a halt that waits for the frame at work keeps its word until it has come about. A replay has
        done what it acknowledges."""
        if ack.error or type(ack.command) not in _COMING or self.hub.replay is not None:
            return
        halts = isinstance(ack.command, (Pause, Stop))
        if halts and self.hub.current is not None and self.hub.current.state in _SETTLED:
            return
        self._halting = ack.command if halts else None
        self._html.content = render(self.hub.current, _COMING[type(ack.command)])


def render(s: Snapshot | None, coming: str) -> str:
    """The status card as HTML; ``coming`` replaces the state while a command is being carried out, and in a replay."""
    if s is None:
        waiting = theme.chip("Waiting for the first frame", theme.KEYFRAME)
        return f'<div class="ec"><div class="ec-head">{waiting}</div></div>'
    color = theme.STATE_COLORS[s.state.value]
    done, behind = 100 * (s.frame + 1) / max(s.frames_total, 1), s.frames_total - s.frame - 1
    progress = f"{s.frame + 1} of {s.frames_total}, {done:.0f} %"
    if s.live:
        progress = f"camera on, {behind} behind"
    cells = [
        theme.cell(theme.number(s.fps_wall or None, 1), "/s", "frames, wall clock"),
        theme.cell(theme.number(s.fps_engine or None, 1), "/s", "frames, engine"),
        theme.cell(theme.number(s.ate_cm), "cm", "ATE so far"),
        theme.cell(theme.number(s.track_ms or None, 0), "ms", "tracking"),
        theme.cell(theme.number(s.map_ms or None, 0), "ms", "mapping"),
        theme.cell(theme.number(s.memory_mb or None, 0), "MB", "memory"),
        theme.cell(str(len(s.keyframes)), "", "keyframes"),
        theme.cell(str(len(s.window)), "", "in BA window"),
        theme.cell(str(len(s.loops)), "", "loops closed"),
    ]
    lines = [line for line in _LINES.items() if line[0] != "ground truth" or s.trajectory_gt is not None]
    name = escape(" · ".join(filter(None, (s.sequence, s.preset))))
    notes = [theme.note(s.reason, color)] if s.reason else []
    counts = (s.dropped, "left out to keep up"), (s.skipped, "skipped"), (s.lost_frames, "lost")
    missed = [_count(n, what) for n, what in counts if n]
    if missed:
        notes.append(theme.note(", ".join(missed), theme.ESTIMATE))
    return (
        f'<div class="ec"><div class="ec-head">{theme.chip(coming or WORDS[s.state], color)}'
        f'<span class="ec-name dim" title="{name}">{name}</span></div>'
        f'<div class="ec-row"><span>Frame <b>{s.frame}</b></span><span class="dim">{progress}</span></div>'
        f'<div class="ec-bar"><i style="width:{done:.1f}%"></i></div>'
        f'<div class="ec-grid">{"".join(cells)}</div>{theme.legend(lines)}{"".join(notes)}</div>'
    )


def _count(frames: int, what: str) -> str:
    return f"{frames} frame{'s' * (frames > 1)} {what}"
