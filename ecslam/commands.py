"""What the command line does, without its options: one function a command."""

from __future__ import annotations

import socket
import sys
import tempfile
import threading
import webbrowser
from pathlib import Path
from typing import Any

from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from . import config_files, datasets
from .atomic import write_named
from .config import Config
from .datasets.addresses import BUILT_IN
from .datasets.roots import sequences_under
from .messages import Notice, Quit, Snapshot
from .reports import Reports, console, finish_run
from .runtime.checkpoint import load_checkpoint
from .runtime.driven import estimate_mb, import_slam
from .runtime.engine import Engine
from .runtime.files import beside, require_place, to_json
from .runtime.judge import judge_run
from .runtime.mesh_files import mesh_bytes
from .runtime.meshjobs import MESH_POINTS, FrozenMap, build_mesh
from .runtime.runfolder import CAMERA, read_about
from .runtime.signals import quit_on_signals
from .types import InputError, Sequence

IN_A_TERMINAL = ("www-browser", "links", "elinks", "lynx", "w3m")


def open_sequence(address: str) -> Sequence:
    """The recording or built-in room at ``address``. Raises InputError."""
    return datasets.open_sequence(address)


def pick_device(name: str, config: Config | None = None) -> str:
    """``auto`` becomes cuda, or cpu where there is no GPU or too little free memory on it for ``config``. Raises
    InputError for a device that is not there."""
    if name == "cpu" or (name == "auto" and not _may_have_cuda()):
        return "cpu"
    import torch

    if name == "auto":
        return "cuda" if torch.cuda.is_available() and _room_on_gpu(config) else "cpu"
    try:
        device = torch.device(name)
    except RuntimeError:
        device = None
    if device is None or device.type not in ("cpu", "cuda"):
        raise InputError(f"--device {name}: no such device; use cpu, cuda or auto")
    if device.type == "cpu":
        return "cpu"
    if not torch.cuda.is_available():
        raise InputError(f"--device {name}: torch sees no CUDA GPU here; use --device cpu")
    if (device.index or 0) >= torch.cuda.device_count():
        last = torch.cuda.device_count() - 1
        raise InputError(f"--device {name}: no such GPU; the last one that torch sees here is cuda:{last}")
    return name


def _room_on_gpu(config: Config | None) -> bool:
    import torch

    needed_mb = estimate_mb(config or Config())
    try:
        free_mb = torch.cuda.mem_get_info()[0] / 1e6
    except RuntimeError as error:
        console.print(f"note: the GPU cannot be used ({str(error).splitlines()[0]}); using the CPU", soft_wrap=True)
        return False
    if free_mb < needed_mb:
        console.print(f"note: {free_mb:.0f} MB free on the GPU, about {needed_mb:.0f} MB needed; using the CPU")
    return free_mb >= needed_mb


def _may_have_cuda() -> bool:
    """False where no NVIDIA device can be, which saves the second that asking torch takes."""
    return sys.platform != "linux" or any(Path(name).exists() for name in ("/dev/nvidiactl", "/dev/dxg", "/dev/nvmap"))


def offered(roots: list[Path]) -> tuple[str, ...]:
    """The sequences that a dashboard offers: the built-in rooms and those below ``roots``. Raises InputError."""
    return (*BUILT_IN, *(address for root in roots for address in sequences_under(root)))


def unused(folder: Path) -> Path:
    """``folder``, or one beside it when there is something at that place."""
    return beside(folder) if folder.exists() else folder


def make_engine(
    config: Config, address: str, opened: Sequence, out: Path, device: str, frames: str, offers: tuple[str, ...]
) -> Engine:
    """An engine for ``opened``, which came from ``address``, writing to ``out``. offers: what a restart may choose."""
    address = datasets.lasting_address(address)

    def open_again(other: str) -> Sequence:
        return opened if other == address else datasets.open_sequence(other)

    return Engine(
        config, address, out, device=device, frames=frames, sequences=(address, *offers), open_sequence=open_again
    )


def resume_engine(folder: Path, device: str, sequence: str | None) -> Engine:
    """The engine of an interrupted run; ``sequence``: where that lies now, if it has moved. Raises InputError."""
    address = str(load_checkpoint(folder / "checkpoints").meta["sequence"])
    if (
        sequence is None
        and not address.startswith("synthetic/")
        and not Path(datasets.split_address(address)[0]).exists()
    ):
        raise InputError(f"{folder}: its sequence is no longer at {address}; say where it is with --sequence")
    moved = None if sequence is None else datasets.lasting_address(sequence)
    return Engine.resume(folder, device=device, sequences=BUILT_IN, sequence=moved)


def listen(host: str, port: int) -> socket.socket:
    """The dashboard's socket, before a run folder is touched. Raises InputError when it cannot listen there."""
    from ecslam_app.listen import bind

    return bind(host, port)


def start(engine: Engine, listener: socket.socket | None, host: str, browser: bool) -> None:
    """Run to the end, under the dashboard where there is a ``listener`` (on ``host``) for it. The engine proper is
    imported while the first frames are read."""
    importing = threading.Thread(target=import_slam, name="import", daemon=True)
    importing.start()
    try:
        if listener is None:
            run_headless(engine)
        else:
            run_with_dashboard(engine, listener, host, browser)
    finally:
        importing.join()


def run_headless(engine: Engine) -> None:
    """Run to the end with a progress line, then say what came out and where it lies."""
    window = 0
    columns = (TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=console, refresh_per_second=4) as bar, quit_on_signals(engine) as signals:
        task = bar.add_task("starting", total=None)

        def show(s: Snapshot) -> None:
            nonlocal window
            window = len(s.window) or window
            bar.update(task, description=progress_line(s, window, wide=console.width >= 100))

        def tell(notice: Notice) -> None:
            if (notice.level != "info" or notice.frame is None) and engine.error is None:
                named = notice.frame is None or f"{notice.frame}" in notice.text
                where = "" if named else f"frame {notice.frame}: "
                bar.console.print(f"{notice.level}: {where}{notice.text}", soft_wrap=True)

        summary = engine.run(show, tell)
    finish_run(engine.run_folder, summary)
    _end(engine, signals)


def progress_line(s: Snapshot, window: int, wide: bool = True) -> str:
    """The state of a run in a line. window: keyframes in the last bundle adjustment. loss: objective of the last
    mapping; residual, where the line may be ``wide``: ``align_mm`` of the frame, see ``StepReport``."""
    figures = [f"{s.state.value} {s.frame + 1}/{s.frames_total}", f"{s.fps_wall:.1f} frames/s"]
    if s.dropped:
        figures.append(f"{s.dropped} left out")
    if s.map_loss is not None:
        figures.append(f"loss {s.map_loss:.3f}")
    if window:
        figures.append(f"window {window}")
    if s.ate_cm is not None:
        figures.append(f"ATE {s.ate_cm:.2f} cm")
    if wide and "align_mm" in s.losses:
        figures.append(f"residual {s.losses['align_mm']:.1f} mm")
    return "  ".join(figures)


def run_with_dashboard(engine: Engine, listener: socket.socket, host: str, browser: bool) -> None:
    """Run in the background under the dashboard until Ctrl-C; a finished run is reported while the page stays up."""
    from ecslam_app import server

    reports = Reports(engine)
    with quit_on_signals(engine) as signals:
        dashboard = server.start(engine, host, listener=listener)
        live = "the camera first, then the dashboard; " if engine.live else ""
        _announce(dashboard, browser, f"{live}everything but an unfinished run's mesh is saved first")
        engine.start(reports.watch)
        engine.join()
    dashboard.close()
    reports.close()
    if engine.error is not None:
        raise engine.error
    _end(engine, signals)


def _end(engine: Engine, signals: list[int]) -> None:
    """A run that a signal cut short has been saved, and yet its status is that of the signal."""
    ended = engine.summary["ended"] if engine.summary else "interrupted"
    whole = ended in ("finished", "stopped") and (engine.run_folder / "mesh.ply").is_file()
    if signals and not whole:
        sys.exit(128 + signals[0])


def view(folders: list[Path], host: str, port: int, browser: bool) -> None:
    """Serve finished runs until Ctrl-C."""
    from ecslam_app import server

    dashboard = server.view(folders, host, port)
    _announce(dashboard, browser, "the runs stay as they are")
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        dashboard.close()


def bench_viewers(address: str, preset: str, frames: str, viewers: int, pairs: int, device: str) -> dict[str, Any]:
    """Run under the dashboard in a temporary folder, in turn without viewers and with them. See ``bench.viewers``."""
    from ecslam_app import server
    from ecslam_app.readers import crowd

    from .bench.runs import preset_config
    from .bench.viewers import measure

    opened = open_sequence(address)
    with tempfile.TemporaryDirectory(prefix="ecslam-bench-") as parent:
        engine = Engine(preset_config(preset, opened), opened, Path(parent) / "run", device=device, frames=frames)
        dashboard = server.start(engine, port=0)
        try:
            return measure(engine, lambda: crowd(dashboard, viewers), viewers, pairs)
        finally:
            engine.submit(Quit())
            engine.join()
            dashboard.close()


def evaluate(folder: Path) -> None:
    """Fill ``summary.json`` with the figures that need ground truth, and print them."""
    with _progress() as bar:
        task = bar.add_task("comparing with the ground truth", total=1.0)
        notes: list[str] = []
        figures = judge_run(folder, lambda done: bar.update(task, completed=done), tell=notes.append)
        bar.update(task, completed=1.0)
    for name, value in figures.items():
        console.print(f"  {name:18} {value:.3f}")
    for note in notes:
        console.print(f"  note: {note}", soft_wrap=True)


def remesh(folder: Path, voxel_m: float, out: Path) -> None:
    """Mesh the map in a run's last checkpoint. Raises InputError for an ending that is no mesh format, and for a folder
    without a run."""
    from .slam import Slam
    from .types import Intrinsics

    if out.suffix not in (".ply", ".glb", ".obj"):
        raise InputError(f"--out {out}: end the name in .ply, .glb or .obj")
    checkpoint = load_checkpoint(folder / "checkpoints")
    require_place(out, "--out")
    config = config_files.apply(Config(), checkpoint.meta["config"], str(folder))
    about = read_about(folder)
    camera = Intrinsics(**{name: about[name] for name in CAMERA})
    slam = Slam.restore(config, camera, checkpoint.arrays)
    sdf, color = slam.query()
    with console.status("meshing"):
        made = build_mesh(FrozenMap(len(slam.trajectory) - 1, sdf, color, slam.surface_points(MESH_POINTS)), voxel_m)
    write_named(out, mesh_bytes(made.mesh, out.suffix[1:]))
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
    readout_s = sequence.intrinsics.readout_s
    told = f"; the layout cannot tell its shutter, so open it as {folder}?readout={readout_s:g}" if readout_s else ""
    console.print(f"{folder}: {len(sequence)} frames in the Replica layout{told}", soft_wrap=True)


def calibrate(address: str, frames: str, out: Path | None) -> None:
    """Say what a recording tells of its camera, and write it to ``out``, by default where the recording finds it, if
    that differs from what the recording itself says, or the calibration that ``address`` names. Raises InputError."""
    from .datasets.calibration import write_calibration
    from .selfcalibration import self_calibrate
    from .selfcalibration.report import sentences, table

    place = out or datasets.calibration_place(address)
    require_place(place, "--out")
    opened = open_sequence(datasets.named_calibration_only(address))
    config = config_files.for_layout(config_files.load_preset("live"), opened.layout)
    with _progress() as bar:
        tasks: dict[str, TaskID] = {}

        def watch(what: str, done: int, total: int) -> None:
            if what not in tasks:
                tasks[what] = bar.add_task(what)
            bar.update(tasks[what], completed=done, total=total)

        found = self_calibrate(datasets.select_frames(opened, frames), config, watch)
    console.print(table(found))
    for line in sentences(found):
        console.print(line, soft_wrap=True)
    if found.verdict.wrong.any():
        write_calibration(place, found.found)
        used = "" if out is None else f"; open the recording as '{datasets.calibrated_address(address, place)}'"
        console.print(f"{place}: written{used}", soft_wrap=True)
    elif out is None and place.exists():
        console.print(f"{place}: says otherwise; remove it if this recording is better", soft_wrap=True)


def write_json(path: Path | None, result: dict[str, Any], device: str) -> None:
    """Write figures that were measured on ``device`` to a file, when one is wanted, with what made them. Raises
    InputError."""
    if path is not None:
        from .provenance import provenance

        write_named(path, to_json({**result, "made_by": provenance(device)}).encode())


def _progress() -> Progress:
    columns = (TextColumn("{task.description}"), BarColumn(bar_width=24), TimeElapsedColumn())
    return Progress(*columns, console=console, refresh_per_second=4)


def _announce(dashboard: Any, browser: bool, at_the_end: str) -> None:
    console.print(f"Dashboard: {dashboard.url}", soft_wrap=True)
    ways = "\nor: ".join((*dashboard.elsewhere, dashboard.ssh_hint))
    console.print(f"From another machine: {ways}", soft_wrap=True)
    console.print(f"Ctrl-C ends it; {at_the_end}.")
    if browser:
        _open(dashboard.url)


def _open(url: str) -> None:
    """Show a page in the person's browser, unless that runs in the terminal, and wait for nothing."""
    try:
        shown_by = webbrowser.get()
    except webbrowser.Error:
        return
    if Path(getattr(shown_by, "name", "")).name not in IN_A_TERMINAL:
        threading.Thread(target=shown_by.open, args=(url,), name="browser", daemon=True).start()
