"""Whole runs, timed: what `ecslam bench speed` prints. Every run has a process of its own, so memory is its own too."""

from __future__ import annotations

import json
import statistics
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from ..datasets import open_sequence, select_frames
from ..messages import Snapshot
from ..provenance import machine
from ..runtime.checkpoint import load_checkpoint
from ..runtime.engine import Engine
from ..runtime.memory import resident_mb
from .peer import measure_open3d, open3d_missing
from .runs import Figures, errors, in_own_process, on_frames, preset_config, print_failures, progress, say

SPAN = 200
SMOOTH = 25
PEER = "Open3D"
ROWS = {
    "fps_wall": "frames/s, all included",
    "fps_engine": "frames/s, engine alone",
    "ate_rmse_cm": "ATE RMSE (cm)",
    "first_map_ms": "first mapping (ms)",
    "track_ms": "tracking (ms a frame)",
    "map_ms": "mapping (ms a frame)",
    "cost_growth": f"cost, last {SPAN} over {SPAN}-{2 * SPAN}",
    "peak_memory_mb": "peak memory (MB)",
    "stored_keyframes_mb": "stored keyframes (MB)",
    "memory_growth_mb": f"memory grown since {SPAN}-{2 * SPAN} (MB)",
    "keyframe_growth_mb": "keyframes stored since (MB)",
    "other_growth_mb": "grown beyond them (MB)",
}


def bench_speed(
    sequence: str, presets: list[str], frames: str, repeats: int, device: str, peer: bool = False
) -> Figures:
    """Run each preset ``repeats`` times on the same frames, taking turns, and compare medians.

    presets: names of presets, or YAML files. Returns plain values: the machine; under ``presets`` for each one the
    medians of what ``measure`` gives, of the runs that did not fail, if any; under ``errors`` what ended the others;
    under ``peer`` the rival's (None without it, ``peer_note`` says why); under ``ratio`` wall-clock frames/s over the
    rival's. Raises InputError for a preset or a sequence that cannot be used.
    """
    opened = select_frames(open_sequence(sequence), frames)
    for preset in presets:
        preset_config(preset, opened)
    note = open3d_missing() if peer else ""
    jobs: dict[str, tuple[Callable[..., Figures], tuple[str, ...]]] = {
        preset: (measure, (sequence, preset, frames, device)) for preset in presets
    }
    if peer and not note:
        jobs[PEER] = (measure_open3d, (sequence, frames, device))
    runs: dict[str, list[Figures]] = {name: [] for name in jobs}
    for turn in range(repeats):
        for name, (job, arguments) in jobs.items():
            figures = in_own_process(job, arguments)
            runs[name].append(figures)
            rate = figures.get("error") or f"{figures['fps_wall']:.2f} frames/s"
            say(f"{name}, run {turn + 1} of {repeats}: {rate}")
    good = {name: [run for run in found if "error" not in run] for name, found in runs.items()}
    medians = {name: _medians(found) for name, found in good.items() if found}
    rival = medians.pop(PEER, None)
    return {
        "sequence": sequence,
        "frames": frames,
        "device": device,
        "machine": machine(device),
        "threads": torch.get_num_threads(),
        "repeats": repeats,
        "presets": medians,
        "errors": errors(runs),
        "peer": rival,
        "peer_note": note,
        "ratio": {name: m["fps_wall"] / rival["fps_wall"] for name, m in medians.items()} if rival else {},
    }


def measure(sequence: str, preset: str, frames: str, device: str) -> Figures:
    """One headless run in a temporary folder.

    frames_done; fps_wall (everything), fps_engine (tracking and mapping after the first frame), ate_rmse_cm;
    first_map_ms; track_ms and map_ms, means over the frames after the first; cost_ms, their sum for each frame, the
    first left out; peak_memory_mb, stored_keyframes_mb; memory_mb, resident memory at some of the frames, which are in
    memory_frame. Growth from frames 200-400 to the last 200, None under 600 frames: cost_growth (a ratio of means),
    memory_growth_mb (of the median resident memory: checkpoints come and go), keyframe_growth_mb (what the keyframes
    stored in between weigh) and other_growth_mb, the difference of the two. Raises InputError.
    """
    memory: dict[int, float] = {}
    opened = open_sequence(sequence)
    with tempfile.TemporaryDirectory(prefix="ecslam-bench-") as parent:
        folder = Path(parent) / "run"
        engine = Engine(preset_config(preset, opened), opened, folder, device=device, frames=frames)
        with progress(preset) as show:

            def watch(snapshot: Snapshot) -> None:
                memory[snapshot.frame] = resident_mb()
                show(snapshot)

            summary = engine.run(watch)
        lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
        arrays = load_checkpoint(folder / "checkpoints").arrays
    stored_mb = sum(a.nbytes for name, a in arrays.items() if name.startswith("keyframes.")) / 1e6
    track, mapped = (np.array([line[key] for line in lines[1:]]) for key in ("track_ms", "map_ms"))
    chosen = ("fps_wall", "fps_engine", "ate_rmse_cm", "peak_memory_mb")
    return {
        "frames_done": summary["frames"],
        **{name: summary[name] for name in chosen},
        "first_map_ms": lines[0]["map_ms"],
        "track_ms": float(track.mean()) if len(track) else 0.0,
        "map_ms": float(mapped.mean()) if len(mapped) else 0.0,
        "stored_keyframes_mb": stored_mb,
        **_growth(track + mapped, memory, np.array([i for i, line in enumerate(lines) if line["keyframe"]]), stored_mb),
        "cost_ms": (track + mapped).tolist(),
        "memory_frame": list(memory),
        "memory_mb": list(memory.values()),
    }


def print_table(result: Figures, console: Console | None = None) -> None:
    """A column for each preset and for the rival, a line for each figure; below it what failed."""
    console = console or Console()
    title = f"{on_frames(result['sequence'], result['frames'])}, {result['machine']}, medians of {result['repeats']}"
    columns = result["presets"] | ({PEER: result["peer"]} if result["peer"] else {})
    table = Table(title=title)
    table.add_column("")
    for name in columns:
        table.add_column(name, justify="right", overflow="fold")
    for key, label in ROWS.items():
        cells = [_cell(m.get(key)) for m in columns.values()]
        if any(cells):
            table.add_row(label, *cells)
    if result["ratio"]:
        table.add_row("times the rival's frames/s", *(_cell(result["ratio"].get(name)) for name in columns))
    if columns:
        console.print(table)
    print_failures(console, result["errors"], result["repeats"])
    if result["peer_note"]:
        console.print(result["peer_note"])


def plot_speed(result: Figures, path: Path) -> None:
    """Write a PNG, a line a preset over the frames: milliseconds per frame, smoothed, the rival's mean dashed; below
    it resident memory."""
    figure = Figure(figsize=(9, 7), dpi=120, layout="constrained")
    axes, memory = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    for name, m in result["presets"].items():
        width = min(SMOOTH, len(m["cost_ms"]))
        if width:
            smooth = np.convolve(m["cost_ms"], np.full(width, 1 / width), "valid")
            axes.plot(np.arange(len(smooth)) + 1 + width // 2, smooth, label=f"{name}: {m['fps_wall']:.1f} frames/s")
        memory.plot(m["memory_frame"], m["memory_mb"])
    if result["peer"]:
        fps = result["peer"]["fps_wall"]
        axes.axhline(1e3 / fps, color="grey", linestyle="--", label=f"{PEER}: {fps:.1f} frames/s, all included")
    axes.set(title=f"{result['sequence']} on {result['machine']}", ylabel="tracking + mapping (ms)")
    memory.set(xlabel="frame", ylabel="memory (MB)")
    for each in (axes, memory):
        each.set_ylim(bottom=0)
    axes.legend(frameon=False)
    figure.savefig(path, format="png")


def _medians(runs: list[Figures]) -> Figures:
    """Key by key; frame by frame where there is a list; None where there is nothing to compare."""
    out: Figures = {}
    for key, first in runs[0].items():
        values = [run[key] for run in runs]
        if first is None:
            out[key] = None
        elif isinstance(first, list):
            out[key] = [statistics.median(v) for v in zip(*values, strict=False)]
        else:
            out[key] = statistics.median(values)
    return out


def _growth(
    cost_ms: np.ndarray[Any, Any], memory: dict[int, float], keyframes: np.ndarray[Any, Any], stored_mb: float
) -> Figures:
    """See ``measure``. memory: resident megabytes by frame; keyframes: [k] their frames."""
    count = len(cost_ms) + 1
    if count < 3 * SPAN:
        return dict.fromkeys(("cost_growth", "memory_growth_mb", "keyframe_growth_mb", "other_growth_mb"))
    early, late = range(SPAN, 2 * SPAN), range(count - SPAN, count)
    resident = [statistics.median([mb for frame, mb in memory.items() if frame in span]) for span in (early, late)]
    grown_mb = float(resident[1] - resident[0])
    between_mb = float(stored_mb * ((keyframes >= 1.5 * SPAN) & (keyframes < count - SPAN / 2)).mean())
    return {
        "cost_growth": float(cost_ms[-SPAN:].mean() / cost_ms[SPAN - 1 : 2 * SPAN - 1].mean()),
        "memory_growth_mb": grown_mb,
        "keyframe_growth_mb": between_mb,
        "other_growth_mb": grown_mb - between_mb,
    }


def _cell(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"
