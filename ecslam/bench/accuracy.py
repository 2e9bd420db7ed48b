"""Accuracy over several seeds, and the paper's ablation: what `ecslam bench accuracy` prints."""

from __future__ import annotations

import statistics
import tempfile
from pathlib import Path

from rich.console import Console
from rich.table import Table

from ..config import Config
from ..config_files import apply_settings
from ..datasets import open_sequence, select_frames
from ..runtime.engine import Engine
from ..runtime.judge import judge_run
from ..types import InputError
from .runs import Figures, errors, in_own_process, on_frames, preset_config, print_failures, progress, say

ABLATED: dict[str, tuple[str, ...]] = {
    "": (),
    " without FUS": ("fus=false",),
    " without EBA": ("eba=false",),
    " without both": ("fus=false", "eba=false"),
}
ROWS = {
    "ate_rmse_cm": "ATE RMSE (cm)",
    "ate_mean_cm": "ATE mean (cm)",
    "ate_max_cm": "ATE maximum (cm)",
    "depth_l1_cm": "Depth L1 (cm)",
    "accuracy_cm": "Accuracy (cm)",
    "completion_cm": "Completion (cm)",
    "completion_ratio": "Completion ratio (%)",
    "loop_closures": "loop closures",
    "lost_frames": "lost frames",
    "fps_wall": "frames/s, all included",
}


def bench_accuracy(
    sequence: str,
    presets: list[str],
    frames: str,
    seeds: int,
    device: str,
    *,
    ablate: bool,
    surface: bool,
    settings: list[str],
) -> Figures:
    """Run every preset with seeds 0, 1 ... ``seeds`` - 1, with ``ablate`` also without FUS, EBA and both.

    surface: whether to compare meshes too, minutes for each run. settings: ``key=value``, laid over every preset.
    Returns plain values: under ``variants`` for each column a list of what ``measure`` gave, one for each seed. A run
    that fails is counted there by its ``error`` and never averaged away. Raises InputError for a preset, a setting or a
    sequence that cannot be used.
    """
    opened = select_frames(open_sequence(sequence), frames)
    if opened.poses_gt() is None:
        raise InputError(f"{sequence}: has no ground truth, so there is nothing to compare with")
    variants = {
        preset + name: (preset, [*settings, *changes])
        for preset in presets
        for name, changes in ABLATED.items()
        if ablate or not name
    }
    for preset, changes in variants.values():
        apply_settings(preset_config(preset, opened), changes)
    found: dict[str, list[Figures]] = {name: [] for name in variants}
    for seed in range(seeds):
        for name, (preset, changes) in variants.items():
            figures = in_own_process(measure, (sequence, preset, changes, frames, seed, device, surface))
            found[name].append(figures)
            say(f"{name}, seed {seed}: {figures.get('error') or _cell([figures['ate_rmse_cm']]) + ' cm'}")
    return {"sequence": sequence, "frames": frames, "settings": settings, "seeds": seeds, "variants": found}


def measure(
    sequence: str, preset: str, settings: list[str], frames: str, seed: int, device: str, surface: bool
) -> Figures:
    """One headless run in a temporary folder and its comparison with the ground truth."""
    opened = open_sequence(sequence)
    config: Config = apply_settings(preset_config(preset, opened), [*settings, f"seed={seed}"])
    with tempfile.TemporaryDirectory(prefix="ecslam-bench-") as parent, progress(preset) as show:
        folder = Path(parent) / "run"
        summary = Engine(config, sequence, folder, device=device, frames=frames).run(show)
        return summary | judge_run(folder, surface=surface)


def print_table(result: Figures, console: Console | None = None) -> None:
    """A column for each variant, a line for each figure: mean and, of several seeds, standard deviation; below it what
    failed."""
    console = console or Console()
    settings = "".join(f", {setting}" for setting in result["settings"])
    table = Table(title=f"{on_frames(result['sequence'], result['frames'])}{settings}, seeds: {result['seeds']}")
    table.add_column("")
    for name in result["variants"]:
        table.add_column(name, justify="right", overflow="fold")
    for key, label in ROWS.items():
        cells = [_cell([run.get(key) for run in runs]) for runs in result["variants"].values()]
        if any(cells):
            table.add_row(label, *cells)
    failed = errors(result["variants"])
    if any(failed.values()):
        table.add_row("failed runs", *(str(len(found)) for found in failed.values()))
    if any(len(found) < result["seeds"] for found in failed.values()):
        console.print(table)
    print_failures(console, failed, result["seeds"])


def _cell(values: list[float | None]) -> str:
    known = [value for value in values if value is not None]
    if not known:
        return ""
    spread = f" ± {statistics.stdev(known):.2f}" if len(known) > 1 else ""
    return f"{statistics.mean(known):.2f}{spread}"
