"""The engine: takes commands, drives ``Slam`` over a sequence on one thread, and publishes what happens.

``run`` works in the calling thread and returns when the sequence is done; ``start`` works in a thread of its own, which
stays for exports and restarts until ``Quit``. One thread drives, one job thread makes meshes and exports, one writes
checkpoints; whoever steers only calls ``submit``.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from shlex import quote
from time import monotonic
from typing import Any

from .. import config_files, datasets
from ..config import Config
from ..messages import Command, Event, Export, LoadPreset, Notice, RequestMesh, Snapshot, State, Tune
from ..types import Frame, FrameError, InputError, Sequence, words
from .checkpoint import Checkpoint, load_checkpoint
from .control import Control, Turn
from .driven import Abandoned, SlamFactory, make_slam, out_of_memory
from .feed import Feed, FeedSubscription
from .files import beside
from .memory import keep_no_holes
from .plan import Plan
from .run import Run
from .runfolder import RunFolder
from .snapshots import state_of, take_snapshot
from .supply import frames_of
from .workshop import Workshop

CHECKPOINT_EVERY = 5
WATCHED_PERIOD_S, UNWATCHED_PERIOD_S = 1 / 30, 1 / 4
LONG_STEP_S = 0.5
PATIENCE_S = 5.0
PATIENCE_FOR_FRAME_S = 0.05  # then commands are looked at again
PREPARING = "Preparing: the first run on a machine compiles its kernels, which takes about a minute"

Items = datasets.Prefetch | datasets.KeepingUp


class Engine:
    """An ``EngineHandle`` that runs ``Slam``.

    sequence: an opened one or an address for ``open_sequence``, read ahead from here on; frames: ``A:B:STEP``, "" =
    all. out: the run folder. sequences: addresses that ``Restart`` may ask for. checkpoint_every: fewest frames between
    checkpoints; what a kill costs at most, see ``CheckpointWriter``. Raises InputError when the sequence cannot be
    opened or the folder not be written to.
    """

    def __init__(
        self,
        config: Config,
        sequence: Sequence | str,
        out: Path,
        *,
        device: str = "cpu",
        frames: str = "",
        sequences: tuple[str, ...] = (),
        checkpoint_every: int = CHECKPOINT_EVERY,
        open_sequence: Callable[[str], Sequence] = datasets.open_sequence,
        make: SlamFactory = make_slam,
        resumed: Checkpoint | None = None,
    ) -> None:
        keep_no_holes()
        address = sequence if isinstance(sequence, str) else sequence.name
        opened = open_sequence(sequence) if isinstance(sequence, str) else sequence
        plan = Plan(config, datasets.select_frames(opened, frames), address, frames, device, out)
        self._sequences = tuple(dict.fromkeys((address, *sequences)))
        self._given = {address: opened}
        self._open_sequence, self._make, self._checkpoint_every = open_sequence, make, checkpoint_every
        self._feed = Feed()
        self._next_snapshot = 0.0
        self._signs_of_life = 0
        self._progress: Callable[[Snapshot], None] = lambda snapshot: None
        self._tell: Callable[[Notice], None] = lambda notice: None
        self._thread: threading.Thread | None = None
        self.summary: dict[str, Any] | None = None
        self.error: Exception | None = None
        self._plan, self._run = plan, self._open_run(plan, resumed)
        self._workshop = workshop = Workshop(self._feed)
        self._control = Control(config, self._feed.publish, self._sequences, self.presets, lambda: workshop.waiting)
        self._control.begin(config, opened.layout, plan.total, self._run.tally.position)

    @classmethod
    def resume(cls, folder: Path, *, sequence: Sequence | str | None = None, **options: Any) -> Engine:
        """Go on with an interrupted run in ``folder``; ``options`` as for the class. sequence: where it has moved from
        the address in ``run.json``. Raises InputError."""
        checkpoint = load_checkpoint(folder / "checkpoints")
        if checkpoint.meta["finished"] and (folder / "summary.json").is_file():
            raise InputError(f"{folder}: this run is finished; look at it with: ecslam view {quote(str(folder))}")
        config = config_files.apply(Config(), checkpoint.meta["config"], str(folder))
        opened = sequence or checkpoint.meta["sequence"]
        return cls(config, opened, folder, frames=checkpoint.meta["frames"], resumed=checkpoint, **options)

    # ---- the handle: any thread -----------------------------------------------------------------------------------

    @property
    def sequences(self) -> tuple[str, ...]:
        """Addresses that ``Restart`` accepts."""
        return self._sequences

    @property
    def presets(self) -> tuple[str, ...]:
        """Names that ``Restart`` and ``LoadPreset`` accept."""
        return tuple(config_files.preset_names())

    @property
    def live(self) -> bool:
        """Whether its frames come from a camera that is on."""
        return self._plan.live is not None

    @property
    def run_folder(self) -> Path:
        """Where this run writes; a restart moves on to a new folder beside it."""
        return self._plan.out

    def submit(self, command: Command) -> int:
        """Take a command up and return its id; its ``Ack`` is published before this returns."""
        return self._control.submit(command)

    def latest(self) -> Snapshot | None:
        """The newest snapshot, or None before the first."""
        return self._feed.latest()

    def subscribe(self) -> FeedSubscription:
        """Start reading the feed from now on."""
        return self._feed.subscribe()

    # ---- life -----------------------------------------------------------------------------------------------------

    def run(
        self,
        progress: Callable[[Snapshot], None] | None = None,
        tell: Callable[[Notice], None] | None = None,
    ) -> dict[str, Any]:
        """Run to the end of the sequence (or ``Stop`` or ``Quit``) in this thread and return the summary.

        progress: called with every snapshot; tell: with every notice. Raises what stopped the run: InputError for what
        a user can mend.
        """
        self._progress, self._tell = progress or self._progress, tell or self._tell
        self._main(stay=False)
        if self.error is not None:
            raise self.error
        assert self.summary is not None
        return self.summary

    def start(self, progress: Callable[[Snapshot], None] | None = None) -> None:
        """Run in the background and stay until ``Quit``. See ``error`` and ``summary``."""
        self._progress = progress or self._progress
        self._thread = threading.Thread(target=self._main, args=(True,), name="engine", daemon=True)
        self._thread.start()

    def join(self, timeout_s: float | None = None) -> bool:
        """Wait until the background thread has ended; False on time-out."""
        if self._thread is not None:
            self._thread.join(timeout_s)
        return self._thread is None or not self._thread.is_alive()

    def _main(self, stay: bool) -> None:
        try:
            turn = self._one_run()
            while turn is Turn.RESTART or (stay and turn is not Turn.QUIT):
                if turn is Turn.RESTART:
                    turn = self._restart()
                else:
                    turn = self._control.next_turn(0.0)
                    if turn is Turn.WORK:
                        self._work(self._run)
        finally:
            self._control.quit()
            self._workshop.close()

    def _restart(self) -> Turn:
        command = self._control.take_restart()
        self._workshop.take_up(self._run, self._control.take_work((Export,)))
        plan = replace(self._plan, out=beside(self._plan.out))
        self.error = self.summary = None
        try:
            if command.sequence is not None and command.sequence != plan.address:
                opened = self._given.get(command.sequence) or self._open_sequence(command.sequence)
                plan = replace(plan, sequence=opened, address=command.sequence, frames="")
            plan = replace(plan, config=self._control.restart_config(command, plan.sequence.layout))
            if self._run.live is not None and plan.sequence is not self._plan.sequence:
                self._run.live.close()
            self._control.begin(plan.config, plan.sequence.layout, plan.total)
            self._plan, self._run = plan, self._open_run(plan)
        except (InputError, OSError) as error:
            self._control.begin(self._plan.config, self._plan.sequence.layout, 0)
            self._control.end()
            told = f"not restarted, so what is shown is still the run before: {words(error)}"
            self._failed(InputError(told))
            self._show(State.FAILED, told)
            return Turn.STOP
        return self._one_run()

    # ---- one run --------------------------------------------------------------------------------------------------

    def _open_run(self, plan: Plan, resumed: Checkpoint | None = None) -> Run:
        if resumed is None:
            folder = RunFolder.create(plan.out, self._not_saved)
        else:
            folder = RunFolder.reopen(plan.out, self._not_saved)
        run = Run(plan, folder, self._emit, self._make, self._checkpoint_every, resumed)
        self._ahead = frames_of(run)
        return run

    def _one_run(self) -> Turn:
        """From the first frame to the summary; what ended it."""
        run, turn = self._run, Turn.STOP
        self._workshop.begin(lambda: self._control.quitting)
        self._show(state_of(run))
        self._signs_of_life = 0
        patience = threading.Timer(PATIENCE_S, self._ask_for_patience)
        patience.daemon = True
        patience.start()
        try:
            with closing(self._ahead) as frames:
                turn = self._frames(run, frames)
        except Exception as error:
            self._failed(error)
        patience.cancel()
        if turn is not Turn.RESTART:
            run.end_live()
        self._control.end()
        try:
            self._finish(run, turn)
        except Exception as error:
            self._failed(error)
        if self.error is not None:
            self._show(State.FAILED, words(self.error))
        elif turn is Turn.STOP:
            self._show(State.FINISHED)
        return turn

    def _finish(self, run: Run, turn: Turn) -> None:
        """Final poses, mesh, summary; an incomplete run ends without the last mapping and without the mesh, one whose
        last mapping fails without the mesh."""
        complete, export_s = turn is Turn.STOP and self.error is None, 0.0
        try:
            run.end(complete, self._interrupt(run, lambda: self._control.leaving))
            if complete:
                began = monotonic()
                self._workshop.final(run, self._control)
                export_s = monotonic() - began
        except Exception as error:
            self._failed(error)
        self.summary = run.close(self._ended(run, turn), words(self.error) if self.error else "", export_s)

    def _ended(self, run: Run, turn: Turn) -> str:
        if self.error is not None:
            return "failed"
        if turn is Turn.STOP and run.live is None and run.tally.position < len(run.plan.sequence):
            return "stopped"
        return "finished" if turn is Turn.STOP and not run.torn else "interrupted"

    def _frames(self, run: Run, frames: Items) -> Turn:
        """Step through the frames as the commands want it; what ended that (STOP also at the sequence's end)."""
        interrupt, last_step = self._interrupt(run, lambda: self._control.leave_now), -1e9
        run.warm_up()
        while True:
            run.clock.pause()
            turn = self._control.next_turn(last_step)
            run.clock.resume()
            if turn is Turn.PAUSED:
                run.measure()
                self._workshop.live(run, at_once=True)
                self._show(State.PAUSED)
            elif turn is Turn.WORK:
                self._work(run)
            elif turn is not Turn.STEP:
                return turn
            elif not frames.ready(PATIENCE_FOR_FRAME_S):
                self._show_when_due(state_of(run))
            else:
                last_step = monotonic()
                item = next(frames, None)
                if item is None:
                    run.require_frames()
                    return Turn.STOP
                self._step(run, item, frames.peek(), interrupt)

    def _interrupt(self, run: Run, leave: Callable[[], bool]) -> Callable[[], None]:
        """What long loops of the engine proper call: it raises Abandoned when ``leave`` answers True."""
        from_here = threading.get_ident()

        def interrupt() -> None:
            if leave():
                raise Abandoned
            if threading.get_ident() == from_here:
                self._in_between(run)
                if monotonic() >= self._next_snapshot + LONG_STEP_S:
                    self._show(State.MAPPING if run.report else State.INITIALISING)

        return interrupt

    def _step(
        self, run: Run, item: tuple[int, Frame | FrameError], then: Frame | None, interrupt: Callable[[], None]
    ) -> None:
        if isinstance(item[1], Frame):
            self._workshop.first_look(run, item[1])
        try:
            report = run.feed(*item, interrupt, then)
        except Abandoned:
            return
        self._control.stepped(run.tally.position, report is not None and report.loop is not None)
        self._in_between(run)
        self._workshop.keep(run)
        self._show_when_due(state_of(run))

    def _ask_for_patience(self) -> None:
        """Before the second iteration of the first mapping, when all kernels that it takes have been compiled."""
        if self._signs_of_life < 2:
            self._emit(Notice("info", PREPARING))

    def _failed(self, error: Exception) -> None:
        error = out_of_memory(error, self._run.config, self._run.plan.device) or error
        self.error = self.error or error
        self._run.notice("error", words(error))

    def _show_when_due(self, state: State) -> None:
        if monotonic() >= self._next_snapshot:
            self._show(state)

    def _show(self, state: State, reason: str = "") -> None:
        self._next_snapshot = monotonic() + (WATCHED_PERIOD_S if self._feed.watched else UNWATCHED_PERIOD_S)
        snapshot = take_snapshot(self._run, state, reason)
        self._feed.publish(snapshot)
        self._progress(snapshot)

    def _work(self, run: Run) -> None:
        """Take up what waits, at a frame boundary."""
        orders = self._control.take_work()
        for _, command in orders:
            if isinstance(command, (Tune, LoadPreset)):
                run.configure(self._control.config)
                what = f"{command.key} = {command.value}" if isinstance(command, Tune) else f"preset {command.name}"
                run.notice("info", f"{what} from frame {run.tally.position} on", run.tally.position)
        self._workshop.take_up(run, orders)

    def _in_between(self, run: Run) -> None:
        """What can be done between frames and in the middle of a long mapping."""
        self._signs_of_life += 1
        self._workshop.take_up(run, self._control.take_work((RequestMesh,)))
        self._workshop.live(run)

    def _not_saved(self, text: str) -> None:
        self._emit(Notice("error", text))

    def _emit(self, event: Event) -> None:
        self._feed.publish(event)
        if isinstance(event, Notice):
            self._tell(event)
