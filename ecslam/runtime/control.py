"""What the commands mean: the monitor between those who steer (any thread) and the one engine thread.

A command is checked, put into effect and acknowledged where it is submitted, under a lock that nobody holds for longer
than that takes, so the answer never waits for a mapping. Work (meshes, exports, tuning) is queued for the engine
thread, which takes it up at the next frame boundary; meshes also in the middle of a long mapping.
"""

from __future__ import annotations

import math
import sys
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from enum import Enum, auto
from time import monotonic

from .. import config_files
from ..config import Config
from ..messages import (
    Ack,
    Command,
    Export,
    LoadPreset,
    Pause,
    PauseOnLoop,
    RequestMesh,
    RequestPictures,
    Restart,
    Resume,
    RunTo,
    SpeedLimit,
    Step,
    Stop,
    Tune,
)
from ..types import InputError

MAX_WAITING = 16
ENDLESS = sys.maxsize  # frames, while a camera is on
GRACE_S = 1.5
MIN_VOXEL_M = 0.004
EXPORTS = {"mesh": ("ply", "glb", "obj"), "trajectory": ("tum", "kitti"), "keyframes": ("tum", "kitti")} | {
    "config": ("yaml",),
    "run": ("zip",),
}
LIVE_GROUPS = ("tracking", "mapping", "window")
NOT_LIVE = ("mapping.first_iterations", "mapping.every")


class Turn(Enum):
    """What the engine thread does next."""

    STEP = auto()
    WORK = auto()
    PAUSED = auto()
    STOP = auto()
    RESTART = auto()
    QUIT = auto()


class Control:
    """The state that commands change. config: the wanted configuration; position: frames of the sequence done."""

    def __init__(
        self,
        config: Config,
        publish: Callable[[Ack], None],
        sequences: tuple[str, ...],
        presets: tuple[str, ...],
        jobs_waiting: Callable[[], int] = lambda: 0,
    ) -> None:
        self._changed = threading.Condition()
        self._publish = publish
        self._sequences, self._presets = sequences, presets
        self._jobs_waiting = jobs_waiting
        self._last_id = 0
        self._work: deque[tuple[int, Command]] = deque()
        self._layout = ""
        self._frames_per_s = 0.0
        self._pause_on_loop = False
        self.config = self._started_with = config
        self.position = self._total = 0
        self.quitting = self.over = self._stop = False
        self._paused = self._announced = False
        self._pause_at: int | None = None
        self._stepping = False
        self._restart: Restart | None = None
        self._leave_at = math.inf

    # ---- for those who steer: any thread --------------------------------------------------------------------------

    def submit(self, command: Command) -> int:
        """Take a command up, publish its ``Ack`` and return its id."""
        with self._changed:
            self._last_id += 1
            command_id, error = self._last_id, ""
            try:
                self._take(command_id, command)
            except InputError as problem:
                error = str(problem)
            self._changed.notify_all()
        self._publish(Ack(command_id, command, error))
        return command_id

    def _take(self, command_id: int, command: Command) -> None:
        if self.quitting:
            raise InputError("the engine has ended; start it again")
        if isinstance(command, (Pause, Resume, Step, RunTo, Stop)):
            self._steer(command)
        elif isinstance(command, Restart):
            self.restart_config(command, self._layout)
            self._restart = command
            self._leave_at = 0.0
        elif isinstance(command, (LoadPreset, Tune)):
            self._require_run()
            self.config = self._tuned(command)
            self._work.append((command_id, command))
            self._announced = self._announced and isinstance(command, Tune)
        elif isinstance(command, SpeedLimit):
            if not 0 <= command.frames_per_s < math.inf:
                raise InputError(
                    f"a speed limit of {command.frames_per_s} frames/s; give a positive number, or 0 for none"
                )
            self._frames_per_s = float(command.frames_per_s)
        elif isinstance(command, PauseOnLoop):
            self._pause_on_loop = bool(command.on)
        elif isinstance(command, (RequestMesh, RequestPictures, Export)):
            self._enqueue(command_id, command)
        else:
            self.quit()

    def quit(self) -> None:
        """The engine ends: now, or after a grace for the frame at work."""
        with self._changed:
            self.quitting = True
            self._leave_at = min(self._leave_at, monotonic() + GRACE_S)
            self._changed.notify_all()

    def _steer(self, command: Pause | Resume | Step | RunTo | Stop) -> None:
        if isinstance(command, Stop):
            self._stop = True
            self._leave_at = min(self._leave_at, monotonic() + GRACE_S)
            return
        self._require_run()
        if isinstance(command, RunTo):
            if not self.position <= command.frame < self._total:
                raise InputError(f"cannot run to frame {command.frame}; {self._ahead()}")
            self._paused, self._pause_at = False, command.frame + 1
        else:
            self._paused = isinstance(command, Pause)
            ahead = self._pause_at if self._stepping and self._pause_at is not None else self.position
            self._pause_at = ahead + 1 if isinstance(command, Step) else None
        self._stepping = isinstance(command, Step)
        self._announced = self._announced and self._paused

    def _require_run(self) -> None:
        if self.over:
            raise InputError("the run is over; restart it")

    def _ahead(self) -> str:
        """Which frames are to come."""
        if self._total == ENDLESS:
            return f"those from {self.position} on lie ahead"
        return f"{self.position} .. {self._total - 1} lie ahead" if self.position < self._total else "none lies ahead"

    def _enqueue(self, command_id: int, command: RequestMesh | RequestPictures | Export) -> None:
        if isinstance(command, Export) and command.format not in ("", *EXPORTS.get(command.kind, ())):
            raise InputError(f"cannot export {command.kind} as {command.format or 'a file'}; {_exports()}")
        if isinstance(command, Export) and command.kind not in EXPORTS:
            raise InputError(f"cannot export {command.kind!r}; {_exports()}")
        if isinstance(command, (RequestMesh, Export)) and not MIN_VOXEL_M <= command.voxel_m <= 1:
            raise InputError(f"a voxel size of {command.voxel_m} m; it must lie in {MIN_VOXEL_M} .. 1")
        if isinstance(command, RequestPictures):
            self._work = deque(item for item in self._work if not isinstance(item[1], RequestPictures))
        if len(self._work) + self._jobs_waiting() >= MAX_WAITING:
            raise InputError(f"{MAX_WAITING} requests are waiting already; try again when they are done")
        self._work.append((command_id, command))

    def _tuned(self, command: LoadPreset | Tune) -> Config:
        if isinstance(command, LoadPreset):
            other = config_files.for_layout(config_files.load_preset(command.name), self._layout)
            return replace(
                self.config,
                preset=command.name,
                tracking=other.tracking,
                mapping=replace(other.mapping, every=self.config.mapping.every),
                window=other.window,
            )
        group, _, name = command.key.partition(".")
        if group not in LIVE_GROUPS or command.key in NOT_LIVE:
            raise InputError(f"{command.key} has no effect in a running engine; restart with it")
        nested: object = command.value
        for part in reversed(name.split(".")):
            nested = {part: nested}
        return config_files.apply(self.config, {group: nested}, "tune")

    def restart_config(self, command: Restart, layout: str) -> Config:
        """The configuration of the run that ``command`` asks for, on a sequence of ``layout``. Raises InputError."""
        if command.sequence is not None and command.sequence not in self._sequences:
            raise InputError(
                f"sequence {command.sequence!r} is not on offer; name a folder above it with --data at the start"
            )
        if command.preset is not None and command.preset not in self._presets:
            raise InputError(f"preset {command.preset!r} is not on offer; there are: {', '.join(self._presets)}")
        wanted = self._started_with
        if command.preset not in (None, wanted.preset):
            other = config_files.for_layout(config_files.load_preset(command.preset), layout)
            wanted = replace(other, seed=wanted.seed, schedule=wanted.schedule, realtime=wanted.realtime)
        elif layout != self._layout:
            preset = config_files.load_preset(wanted.preset)
            before, after = (config_files.for_layout(preset, name) for name in (self._layout, layout))
            wanted = config_files.apply(after, config_files.changes(before, wanted), "restart")
        given = {"seed": command.seed, "schedule": command.schedule, "realtime": command.realtime}
        return config_files.apply(wanted, {k: v for k, v in given.items() if v is not None}, "restart")

    # ---- for the engine thread ------------------------------------------------------------------------------------

    def begin(self, config: Config, layout: str, total: int, position: int = 0) -> None:
        """A run over ``total`` frames of a ``layout`` is about to start at ``position``; its commands are taken now,
        and those that came since ``take_restart`` are its own."""
        with self._changed:
            self._layout = layout
            self.config = self._started_with = config
            self.position, self._total = position, total
            self.over = self._paused = self._announced = False
            self._pause_at = None

    def next_turn(self, last_step: float) -> Turn:
        """Wait for something to do. last_step: ``monotonic()`` when the last frame was begun, for the speed limit."""
        with self._changed:
            while True:
                if self.quitting:
                    return Turn.QUIT
                if self._restart is not None:
                    return Turn.RESTART
                if self._work:
                    return Turn.WORK
                if self._stop and not self.over:
                    return Turn.STOP
                waiting = None
                if not self.over and self._paused and not self._announced:
                    self._announced = True
                    return Turn.PAUSED
                if not (self.over or self._paused):
                    pause = 1 / self._frames_per_s if self._frames_per_s else 0.0
                    waiting = last_step + pause - monotonic()
                    if waiting <= 0:
                        return Turn.STEP
                self._changed.wait(waiting)

    def wait_for(self, done: Callable[[], bool]) -> bool:
        """Wait until ``done`` answers True; False when a restart or the end of the engine comes first. See ``wake``."""
        with self._changed:
            self._changed.wait_for(lambda: done() or self.quitting or self._restart is not None)
            return done()

    def wake(self) -> None:
        """Tell ``wait_for``, from any thread, to ask again."""
        with self._changed:
            self._changed.notify_all()

    def stepped(self, position: int, loop: bool) -> None:
        """A frame is done; ``loop`` says whether a loop closed in it."""
        with self._changed:
            self.position = position
            reached = self._pause_at is not None and position >= self._pause_at
            if (reached or (loop and self._pause_on_loop)) and position < self._total:
                self._paused, self._pause_at = True, None

    def end(self) -> None:
        """The run is over; commands that need one are refused from now on."""
        with self._changed:
            self.over, self._stop = True, False

    def take_restart(self) -> Restart:
        """The restart that was asked for; what else was asked of the run before is dropped, exports excepted."""
        with self._changed:
            restart, self._restart = self._restart, None
            assert restart is not None
            self._work = deque(item for item in self._work if isinstance(item[1], Export))
            self._stop = False
            if not self.quitting:
                self._leave_at = math.inf
            return restart

    def take_work(self, kinds: tuple[type, ...] = ()) -> list[tuple[int, Command]]:
        """Waiting work with command ids, oldest first; only commands of ``kinds`` where given."""
        with self._changed:
            taken = [item for item in self._work if not kinds or isinstance(item[1], kinds)]
            self._work = deque(item for item in self._work if item not in taken)
            return taken

    @property
    def leaving(self) -> bool:
        """Whether the run's last mapping is to be left out: a restart or the end of the engine waits for it, or it has
        been stopped itself."""
        return self.quitting or self._restart is not None or (self.over and self._stop)

    @property
    def leave_now(self) -> bool:
        """Whether the frame at work is to be abandoned: a restart at once, stop and quit after a grace."""
        return monotonic() >= self._leave_at


def _exports() -> str:
    return "there are: " + "; ".join(f"{kind} ({', '.join(formats)})" for kind, formats in EXPORTS.items())
