"""The command ``ecslam``. Heavy imports wait until a command needs them, so ``--help`` is quick."""

from __future__ import annotations

import io
import sys
from pathlib import Path
from typing import Annotated

import typer

from . import config_files
from .bench_cli import bench
from .config import Config
from .options import (
    CameraArgument,
    ConfigFile,
    Data,
    Device,
    Frames,
    Headless,
    Host,
    NoBrowser,
    Out,
    Port,
    Preset,
    Realtime,
    Record,
    RunFolder,
    Schedule,
    Seed,
    SequenceArgument,
    Settings,
)
from .runtime.outlets import lasting_outputs
from .types import InputError, Sequence

app = typer.Typer(
    name="ecslam",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
    rich_markup_mode="rich",
)
app.add_typer(bench, name="bench")


def _say_version(wanted: bool) -> None:
    if wanted:
        from .commands import pick_device
        from .provenance import provenance

        for name, value in provenance(pick_device("auto")).items():
            print(f"{name:8} {value}")
        raise typer.Exit


@app.callback()
def ecslam(
    version: Annotated[
        bool, typer.Option("--version", callback=_say_version, is_eager=True, help="What is installed, and on what.")
    ] = False,
) -> None:
    """EC-SLAM: neural RGB-D SLAM that you watch live in a browser."""


@app.command()
def run(
    sequence: SequenceArgument,
    preset: Preset = None,
    config: ConfigFile = None,
    settings: Settings = None,
    frames: Frames = "",
    seed: Seed = None,
    device: Device = "auto",
    schedule: Schedule = None,
    realtime: Realtime = False,
    headless: Headless = False,
    out: Out = None,
    record: Record = None,
    data: Data = None,
    host: Host = "127.0.0.1",
    port: Port = 8080,
    no_browser: NoBrowser = False,
) -> None:
    """Run SLAM on a recording, a built-in room or a camera; watch it in the browser unless --headless."""
    from . import camera_commands, commands

    offered = commands.offered(data or [])
    with camera_commands.source(sequence, frames, record) as (address, opened):
        wanted = [*(settings or []), *(["realtime=true"] if realtime else [])]
        resolved = resolve_config(preset, opened, config, wanted, seed, schedule)
        folder = out or commands.unused(Path("runs") / f"{opened.name.replace('/', '-')}-{resolved.preset}")
        listener = None if headless else commands.listen(host, port)
        engine = commands.make_engine(
            resolved, address, opened, folder, commands.pick_device(device, resolved), frames, offered
        )
        commands.start(engine, listener, host, not no_browser)


@app.command()
def record(
    camera: CameraArgument = "camera/realsense",
    folder: Annotated[Path | None, typer.Argument(help="A new folder; default: recordings/CAMERA-TIME.")] = None,
    seconds: Annotated[float, typer.Option(min=0, help="How long; 0 = until Ctrl-C.")] = 0.0,
) -> None:
    """Record what a camera sees, for `ecslam run` later. `ecslam run camera/...` does so while it maps."""
    from . import camera_commands

    camera_commands.record(camera, folder, seconds)


@app.command()
def demo(
    headless: Headless = False,
    preset: Annotated[str, typer.Option(help="The preset to show.")] = "live",
    device: Device = "auto",
    frames: Frames = "",
    out: Annotated[
        Path | None, typer.Option(help="Run folder; a run in it is replaced. Default: a new one, runs/demo.")
    ] = None,
    data: Data = None,
    host: Host = "127.0.0.1",
    port: Port = 8080,
    no_browser: NoBrowser = False,
) -> None:
    """Run on the built-in studio and show the result."""
    from . import commands

    run(
        "synthetic/studio",
        preset=preset,
        device=device,
        frames=frames,
        headless=headless,
        out=out or commands.unused(Path("runs/demo")),
        data=data,
        host=host,
        port=port,
        no_browser=no_browser,
    )


@app.command()
def resume(
    folder: RunFolder,
    sequence: Annotated[str | None, typer.Option(help="Where the sequence lies now, if it has moved.")] = None,
    device: Device = "auto",
    headless: Headless = False,
    host: Host = "127.0.0.1",
    port: Port = 8080,
    no_browser: NoBrowser = False,
) -> None:
    """Go on with an interrupted run from its last checkpoint."""
    from . import commands

    listener = None if headless else commands.listen(host, port)
    engine = commands.resume_engine(folder, commands.pick_device(device), sequence)
    commands.start(engine, listener, host, not no_browser)


@app.command()
def view(
    folders: Annotated[list[Path], typer.Argument(help="One run folder, or two to compare.", metavar="RUN [RUN]")],
    host: Host = "127.0.0.1",
    port: Port = 8080,
    no_browser: NoBrowser = False,
) -> None:
    """Open finished runs in the browser: scrub through one, or compare two."""
    from . import commands

    commands.view(folders, host, port, not no_browser)


@app.command(name="eval")
def evaluate(folder: RunFolder) -> None:
    """Compare a run with its sequence's ground truth: trajectory, Depth L1, Accuracy, Completion, Completion Ratio.

    The surface takes some minutes: Depth L1 is the mean over 1,000 views.
    """
    from . import commands

    commands.evaluate(folder)


@app.command()
def mesh(
    folder: RunFolder,
    voxel: Annotated[float, typer.Option(min=0.002, max=1.0, help="Voxel size in metres.")] = 0.02,
    out: Annotated[Path | None, typer.Option(help="File to write: .ply, .glb or .obj; default: RUN/mesh.ply.")] = None,
) -> None:
    """Make the mesh of a run again from its map, at any voxel size."""
    from . import commands

    commands.remesh(folder, voxel, out or folder / "mesh.ply")


@app.command()
def synth(
    name: Annotated[
        str, typer.Argument(help="synthetic/studio, synthetic/apartment, synthetic/corridor or synthetic/gallery.")
    ],
    folder: Annotated[Path, typer.Argument(help="Folder to write, in the Replica layout.")],
    frames: Frames = "",
) -> None:
    """Write a built-in room to disk: images, poses, camera and exact mesh in the Replica layout."""
    from . import commands

    commands.write_synthetic(name, folder, frames)


@app.command()
def check(sequence: SequenceArgument) -> None:
    """Say what a recording is and what looks odd about it, before a run. Fails where no frame can be read."""
    from .datasets import open_sequence
    from .datasets.check import check_sequence, format_report

    opened = open_sequence(sequence)
    config = resolve_config(None, opened, None, None, None, None)
    report = check_sequence(opened, config=config)
    print(format_report(report))
    if report.hopeless:
        raise InputError(f"{sequence}: none of the {report.frames_read} frames tried can be read; the report says why")


@app.command()
def calibrate(
    sequence: SequenceArgument,
    frames: Annotated[
        str, typer.Option(metavar="A:B:STEP", help="Which frames, as a Python slice; default: the first 600.")
    ] = "0:600",
    out: Annotated[
        Path | None, typer.Option(help="File to write; default: where the recording finds it by itself.")
    ] = None,
) -> None:
    """Find out from a recording what its depth camera is really like, and keep it beside the recording.

    Focal length, centre, radial bend and an error of inverse depth: what makes surfaces coincide that were seen from
    several places. Best from a minute in which the camera turns around in a furnished room.
    """
    from . import commands

    commands.calibrate(sequence, frames, out)


def resolve_config(
    preset: str | None,
    sequence: Sequence,
    file: Path | None,
    settings: list[str] | None,
    seed: int | None,
    schedule: str | None,
) -> Config:
    """Preset (the command's, the file's or the sequence's), what the layout asks for, then file, then single settings,
    then seed and schedule. Raises InputError."""
    resolved = config_files.for_layout(config_files.load_preset(preset or sequence.preset), sequence.layout)
    if file is not None:
        resolved = config_files.load_config(file, resolved, sequence.layout)
        if preset not in (None, resolved.preset):
            raise InputError(f"{file}: is for preset {resolved.preset}, not {preset}; leave --preset out, or change it")
    resolved = config_files.apply_settings(resolved, settings or [])
    for key, value in (("seed", seed), ("schedule", schedule)):
        if value is not None:
            resolved = config_files.apply(resolved, {key: value}, f"--{key}")
    return resolved


def main() -> None:
    """A wrong input is one line on stderr and exit code 2, without a traceback. What the output does not take is left
    out, and is exit code 1 unless its reader has gone."""
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="backslashreplace")  # names that the terminal's encoding lacks
    code: str | int | None = 0
    with lasting_outputs() as refused:
        try:
            app()
        except InputError as error:
            print(f"error: {error}", file=sys.stderr)
            code = 2
        except SystemExit as end:
            code = end.code
    sys.exit(code or int(any(not isinstance(error, BrokenPipeError) for error in refused)))
