"""A reader of an engine's feed that waits for what a test is about."""

from __future__ import annotations

import time
from contextlib import contextmanager
from pathlib import Path

from fake_slam import QUICK, Behaviour, FakeSequence, maker, open_fake

from ecslam.messages import Ack, Pause, Quit, RunTo, Snapshot, State
from ecslam.runtime.engine import Engine

PATIENCE_S = 20.0


class Watch:
    """Everything one subscription has handed out so far, in ``seen``."""

    def __init__(self, engine: Engine) -> None:
        self.engine, self.seen = engine, []
        self._subscription = engine.subscribe()

    def until(self, wanted, since: int = 0):
        """The first message from number ``since`` on for which ``wanted`` is true."""
        for message in self.seen[since:]:
            if wanted(message):
                return message
        deadline = time.monotonic() + PATIENCE_S
        while (left := deadline - time.monotonic()) > 0:
            message = self._subscription.get(left)
            if message is not None:
                self.seen.append(message)
                if wanted(message):
                    return message
        raise AssertionError(f"not seen: {[type(m).__name__ for m in self.seen[-20:]]}")

    def event(self, kind, since: int = 0):
        return self.until(lambda m: isinstance(m, kind), since)

    def state(self, state: State, since: int = 0) -> Snapshot:
        return self.until(lambda m: isinstance(m, Snapshot) and m.state is state, since)

    def ask(self, command) -> Ack:
        """Submit, wait for the acknowledgement, and return it."""
        since = len(self.seen)
        number = self.engine.submit(command)
        return self.until(lambda m: isinstance(m, Ack) and m.command_id == number, since)

    def go(self, command, state: State) -> Snapshot:
        """Submit and wait for the state it leads to."""
        since = len(self.seen)
        assert self.ask(command).error == ""
        return self.state(state, since)


@contextmanager
def running(out: Path, sequence=None, behaviour: Behaviour | None = None, paused_at: int | None = None, **options):
    """A started engine and its watch; with ``paused_at`` it waits before that frame."""
    make = maker(behaviour)
    config = options.pop("config", QUICK)
    engine = Engine(config, sequence or FakeSequence(), out, make=make, open_sequence=open_fake, **options)
    watch = Watch(engine)
    if paused_at is not None:
        engine.submit(Pause() if paused_at == 0 else RunTo(paused_at - 1))
    engine.start()
    try:
        if paused_at is not None:
            watch.state(State.PAUSED)
        yield engine, watch, make.made
    finally:
        engine.submit(Quit())
        assert engine.join(10), "the engine did not end"
