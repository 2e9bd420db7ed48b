"""What the command line does, without its options: one function a command."""

from __future__ import annotations

import json
import webbrowser
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from . import datasets
from .config import Config
from .evaluation.report import evaluate_run
from .evaluation.trajectory import absolute_error, relative_error
from .evaluation.trajectory_io import read_tum
from .messages import Snapshot
from .runtime.checkpoint import load_checkpoint
from .runtime.engine import Engine
from .runtime.files import to_json, write_atomic
from .runtime.mesh_files import mesh_bytes
from .runtime.meshjobs import FrozenMap, build_mesh
from .runtime.signals import quit_on_signals
from .types import InputError, Mesh, Sequence

console = Console()
BUILT_IN = ("synthetic/studio", "synthetic/apartment", "synthetic/corridor")


def open_sequence(address: str) -> Sequence:
    """The recording or built-in room at ``address``. Raises InputError."""
    return datasets.open_sequence(address)


def pick_device(name: str) -> str:
    """``auto`` becomes cuda or cpu. Raises InputError for a device that is not there."""
    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        kind = torch.device(name).type
    except RuntimeError:
        raise InputError(f"--device {name}: no such device; use cpu, cuda or auto") from None
    if kind == "cuda" and not torch.cuda.is_available():
        raise InputError(f"--device {name}: torch sees no CUDA GPU here; use --device cpu")
    return name


def make_engine(config: Config, address: str, opened: Sequence, out: Path, device: str, frames: str) -> Engine:
    """An engine for ``opened``, which came from ``address``, writing to ``out``."""

    def open_again(other: str) -> Sequence:
        return opened if other == address else datasets.open_sequence(other)

    return Engine(
        config, address, out, device=device, frames=frames, sequences=(address, *BUILT_IN), open_sequence=open_again
    )


def resume_engine(folder: Path, device: str) -> Engine:
    """The engine of an interrupted run. Raises InputError."""
    return Engine.resume(folder, device=device, sequences=BUILT_IN)


def run_headless(engine: Engine) -> None:
    """Run to the end with a progress line, then say what came out and where it lies."""
    with _progress() as bar, quit_on_signals(engine):
        task = bar.add_task("starting", total=None)

        def show(s: Snapshot) -> None:
            ate = "" if s.ate_cm is None else f"  ATE {s.ate_cm:.2f} cm"
            text = (
                f"frame {s.frame + 1}/{s.frames_total}  {s.fps_wall:.1f} frames/s  loss {sum(s.losses.values()):.3f}"
                f"{ate}  window {len(s.window)}"
            )
            bar.update(task, description=f"{s.state.value}: {text}", completed=s.frame + 1, total=s.frames_total)

        summary = engine.run(show)
    finish_run(engine, summary)


def run_with_dashboard(engine: Engine, host: str, port: int, browser: bool) -> None:
    """Run in the background under the dashboard until Ctrl-C."""
    from ecslam_app import server

    with quit_on_signals(engine):
        dashboard = server.start(engine, host, port)
        _announce(dashboard, browser)
        engine.start()
        engine.join()
    dashboard.close()
    if engine.summary is not None:
        finish_run(engine, engine.summary)
    if engine.error is not None:
        raise engine.error


def view(folders: list[Path], host: str, port: int, browser: bool) -> None:
    """Serve finished runs until Ctrl-C."""
    import threading

    from ecslam_app import server

    dashboard = server.view(folders, host, port)
    _announce(dashboard, browser)
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        dashboard.close()


def finish_run(engine: Engine, summary: dict[str, Any]) -> None:
    """Draw the picture of the run, print its figures and where they lie."""
    folder = engine.run_folder
    picture = draw_picture(folder)
    for name in ("sequence", "preset", "kernels", "frames", "fps_wall", "ate_rmse_cm", "loop_closures", "lost_frames"):
        value = summary[name]
        console.print(f"  {name:15} {value:.3f}" if isinstance(value, float) else f"  {name:15} {value}")
    if summary["kernels_note"]:
        console.print(f"  note: {summary['kernels_note']}")
    console.print(
        f"  mesh            {folder / 'mesh.ply'}\n  summary         {folder / 'summary.json'}", soft_wrap=True
    )
    if picture is not None:
        console.print(f"  picture         {picture}", soft_wrap=True)


def draw_picture(folder: Path) -> Path | None:
    """``picture.png``: mesh and trajectories of a run folder; None when it has no mesh, or an empty one."""
    from .evaluation.plots import plot_run

    try:
        mesh = read_mesh(folder / "mesh.ply")
    except InputError:
        return None
    times, poses = read_tum(folder / "trajectory.txt")
    truth = read_truth(folder, times)
    summary = json.loads((folder / "summary.json").read_text())
    plot_run(folder / "picture.png", mesh, poses, truth, title=_title(summary))
    return folder / "picture.png"


def _title(summary: dict[str, Any]) -> str:
    ate = summary["ate_rmse_cm"]
    accuracy = "" if ate is None else f", ATE RMSE {ate:.2f} cm"
    return f"{summary['sequence']}, {summary['preset']}: {summary['fps_wall']:.1f} frames/s{accuracy}"


def read_truth(folder: Path, times: Any) -> Any:
    """Ground-truth poses [N, 4, 4] at ``times``, NaN where there is none; None without ground truth."""
    import numpy as np

    path = folder / "groundtruth.txt"
    if not path.is_file():
        return None
    found_times, found = read_tum(path)
    truth = np.full((len(times), 4, 4), np.nan)
    at = np.searchsorted(times, found_times).clip(0, len(times) - 1)
    truth[at] = found
    return truth


def read_mesh(path: Path) -> Mesh:
    """A mesh file of ours. Raises InputError."""
    from .datasets.meshes import load_mesh

    if not path.is_file():
        raise InputError(f"{path}: no mesh here; make it with: ecslam mesh {path.parent}")
    return load_mesh(path)


def evaluate(folder: Path) -> None:
    """Fill ``summary.json`` with the figures that need ground truth, and print them."""
    summary_path, about_path = folder / "summary.json", folder / "run.json"
    if not summary_path.is_file() or not about_path.is_file():
        raise InputError(f"{folder}: no finished run here; give the folder that `ecslam run --out` wrote")
    summary, about = json.loads(summary_path.read_text()), json.loads(about_path.read_text())
    times, poses = read_tum(folder / "trajectory.txt")
    truth = read_truth(folder, times)
    if truth is None:
        raise InputError(f"{folder}: the sequence has no ground truth, so there is nothing to compare with")
    sequence = datasets.select_frames(open_sequence(about["sequence"]), about["frames"])
    ate, rpe = absolute_error(poses, truth), relative_error(poses, truth)
    if ate is not None:
        summary |= {"ate_rmse_cm": ate.cm.rmse, "ate_mean_cm": ate.cm.mean, "ate_max_cm": ate.cm.max}
        summary["ate_median_cm"] = ate.cm.median
    if rpe is not None:
        summary |= {"rpe_cm": rpe.cm.rmse, "rpe_deg": rpe.deg.rmse}
    reference = sequence.reference_mesh()
    if reference is None:
        console.print("no reference mesh in this sequence: the trajectory's figures only")
    else:
        with _progress() as bar:
            task = bar.add_task("comparing meshes", total=1.0)
            figures = evaluate_run(
                read_mesh(folder / "mesh.ply"),
                reference,
                sequence.intrinsics,
                truth,
                progress=lambda done: bar.update(task, completed=done),
            )
        summary |= figures
    write_atomic(summary_path, json.dumps(summary, indent=2).encode())
    for name, value in summary.items():
        if name.startswith(("ate_", "rpe_", "depth_l1", "accuracy", "completion")) and value is not None:
            console.print(f"  {name:18} {value:.3f}")


def remesh(folder: Path, voxel_m: float, out: Path) -> None:
    """Mesh the map in a run's last checkpoint. Raises InputError for an ending that is no mesh format."""
    from .slam import Slam
    from .types import Intrinsics

    if out.suffix not in (".ply", ".glb", ".obj"):
        raise InputError(f"--out {out}: end the name in .ply, .glb or .obj")
    checkpoint = load_checkpoint(folder / "checkpoints")
    from . import config as configuration

    config = configuration.apply(Config(), checkpoint.meta["config"], str(folder))
    about = json.loads((folder / "run.json").read_text())
    camera = Intrinsics(*(about[k] for k in ("fx", "fy", "cx", "cy", "width", "height")))
    slam = Slam.restore(config, camera, checkpoint.arrays)
    sdf, color = slam.query()
    with console.status("meshing"):
        made = build_mesh(FrozenMap(len(slam.trajectory) - 1, sdf, color, slam.surface_points()), voxel_m)
    write_atomic(out, mesh_bytes(made.mesh, out.suffix[1:]))
    console.print(f"{out}: {len(made.mesh.vertices)} vertices, {len(made.mesh.faces)} triangles", soft_wrap=True)


def write_synthetic(name: str, folder: Path, frames: str) -> None:
    """Write a built-in room in the Replica layout. Raises InputError."""
    from .datasets.synthetic import write_replica

    if not name.startswith("synthetic/"):
        raise InputError(f"{name}: not a built-in room; there are {', '.join(BUILT_IN)}")
    sequence = datasets.select_frames(open_sequence(name), frames)
    with _progress() as bar:
        task = bar.add_task(f"writing {name}", total=len(sequence))
        write_replica(sequence, folder, lambda done, total: bar.update(task, completed=done, total=total))
    console.print(f"{folder}: {len(sequence)} frames in the Replica layout", soft_wrap=True)


def write_json(path: Path | None, result: dict[str, Any]) -> None:
    """Write figures to a file, when one is wanted."""
    if path is not None:
        write_atomic(path, to_json(result).encode())


def _progress() -> Progress:
    columns = (TextColumn("{task.description}"), BarColumn(bar_width=24), TimeElapsedColumn())
    return Progress(*columns, console=console, refresh_per_second=4)


def _announce(dashboard: Any, browser: bool) -> None:
    console.print(f"Dashboard: {dashboard.url}", soft_wrap=True)
    console.print(f"From another machine: {dashboard.ssh_hint}, then open the same address there", soft_wrap=True)
    console.print("Ctrl-C ends it; everything is saved first.")
    if browser:
        webbrowser.open(dashboard.url)
