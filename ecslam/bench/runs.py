"""What every benchmark of whole runs needs: a process of its own, a bar, and the configuration of a preset."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from ..config import Config
from ..config_files import for_layout, load_config, load_preset
from ..messages import Snapshot
from ..types import InputError, Sequence, words

Figures = dict[str, Any]


def preset_config(preset: str, sequence: Sequence) -> Config:
    """What ``ecslam run`` would use: with --config for a YAML file, else with --preset. Raises InputError."""
    if preset.endswith((".yaml", ".yml")):
        base = for_layout(load_preset(sequence.preset), sequence.layout)
        return load_config(Path(preset), base, sequence.layout)
    return for_layout(load_preset(preset), sequence.layout)


def in_own_process(job: Callable[..., Figures], arguments: tuple[Any, ...]) -> Figures:
    """``job(*arguments)`` in a fresh process, so that memory and thread pools are its own; ``error`` when it failed."""
    try:
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            return pool.submit(job, *arguments).result()
    except BrokenProcessPool:
        return {"error": "its process was killed, perhaps for lack of memory"}
    except Exception as error:
        return {"error": words(error)}


@contextmanager
def progress(name: str) -> Iterator[Callable[[Snapshot], None]]:
    """What to call with every snapshot of a run, for a bar on stderr."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True, refresh_per_second=2) as bar:
        task = bar.add_task(name, total=None)
        yield lambda s: bar.update(task, completed=s.frame + 1, total=s.frames_total)


def say(text: str) -> None:
    """A line on stderr."""
    Console(stderr=True).print(text, highlight=False)


def on_frames(sequence: str, frames: str) -> str:
    """What was run, for the title of a table."""
    return f"{sequence} {frames}".rstrip()


def errors(runs: dict[str, list[Figures]]) -> dict[str, list[str]]:
    """What ended the runs of each name that failed."""
    return {name: [run["error"] for run in found if "error" in run] for name, found in runs.items()}


def print_failures(console: Console, errors: dict[str, list[str]], runs: int) -> None:
    """A line for each name of whose ``runs`` some failed."""
    for name, found in errors.items():
        if found:
            text = f"{name}: {len(found)} of {runs} runs failed, the first because: {found[0]}"
            console.print(text, soft_wrap=True, markup=False)


def require_a_run(errors: list[list[str]], runs: int) -> None:
    """Raises InputError when there are no figures: all ``runs`` of everything ended in ``errors``."""
    if all(len(found) == runs for found in errors):
        raise InputError("every run failed, so there is nothing to compare; the lines above say why")
