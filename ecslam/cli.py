"""The command ``ecslam``. Heavy imports wait until a command needs them, so ``--help`` is quick."""

from __future__ import annotations

import io
import sys
from pathlib import Path
from typing import Annotated

import typer

from . import config_files
from .config import Config
from .runtime.files import require_place
from .runtime.outlets import lasting_outputs
from .types import InputError, Sequence

app = typer.Typer(
    name="ecslam",
    help="EC-SLAM: neural RGB-D SLAM that you watch live in a browser.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
    rich_markup_mode="rich",
)
bench = typer.Typer(help="Measure: back ends against each other, speed, accuracy.", no_args_is_help=True)
app.add_typer(bench, name="bench")


def _place(option: typer.CallbackParam, file: Path | None) -> Path | None:
    """What an option names, once it is sure that it can be written. Raises InputError."""
    if file is not None:
        require_place(file, f"--{option.name}")
    return file


SequenceArgument = Annotated[
    str,
    typer.Argument(
        help="A folder (7-Scenes, TUM RGB-D, Replica, ScanNet ..., recognised by itself), a file (.bag, .mcap, .db3, "
        ".sens, .r3d), a built-in room (synthetic/studio, synthetic/apartment, synthetic/corridor) or, to run on, "
        "a camera that is plugged in: camera/realsense."
    ),
]
Preset = Annotated[str | None, typer.Option(help="lite, full, live, scannet or tum; default: what suits the layout.")]
ConfigFile = Annotated[
    Path | None, typer.Option("--config", help="A YAML file laid over the preset; it may name that.")
]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="One setting, e.g. mapping.iterations=20; may be repeated."),
]
Frames = Annotated[str, typer.Option(metavar="A:B:STEP", help="Which frames, as a Python slice; default: all.")]
Seed = Annotated[int | None, typer.Option(min=0, help="Random seed; default: the configuration's (0).")]
Device = Annotated[str, typer.Option(help="cpu, cuda, cuda:1 ... or auto: a CUDA GPU where there is one.")]
Schedule = Annotated[
    str | None,
    typer.Option(help="strict (deterministic on a CPU), overlap (maps while it tracks) or auto (overlap on a GPU)."),
]
Realtime = Annotated[
    bool, typer.Option("--realtime", help="As from a camera: no faster than recorded, frames are left out to keep up.")
]
Record = Annotated[
    Path | None, typer.Option(help="Where a camera's images go, a new folder; default: recordings/CAMERA-TIME.")
]
CameraArgument = Annotated[
    str, typer.Argument(help="A camera that is plugged in, as in 'camera/realsense?size=640x480&fps=30'.")
]
Headless = Annotated[bool, typer.Option("--headless", help="No dashboard: run, write the run folder, end.")]
Out = Annotated[
    Path | None, typer.Option(help="Run folder; a run in it is replaced. Default: a new one, runs/SEQUENCE-PRESET.")
]
Data = Annotated[
    list[Path] | None,
    typer.Option(metavar="FOLDER", help="A folder with sequences that the dashboard offers too; may be repeated."),
]
Host = Annotated[str, typer.Option(help="Where the dashboard listens; any but 127.0.0.1 needs the token it prints.")]
Port = Annotated[int, typer.Option(min=0, max=65535, help="Port of the dashboard; 0 = any free one.")]
NoBrowser = Annotated[bool, typer.Option("--no-browser", help="Do not open a browser; the address is printed.")]
Json = Annotated[Path | None, typer.Option(callback=_place, help="Write every figure to this file.")]
RunFolder = Annotated[Path, typer.Argument(help="A run folder, as `ecslam run` leaves it.")]


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
    name: Annotated[str, typer.Argument(help="synthetic/studio, synthetic/apartment or synthetic/corridor.")],
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


@bench.command(name="kernels")
def bench_kernels(
    rays: Annotated[int, typer.Option(min=1, help="Rays; 43 samples each.")] = 1000,
    repeats: Annotated[int, typer.Option(min=3, help="Runs of each; medians are printed.")] = 5,
    json: Json = None,
) -> None:
    """Time the fast back ends against the plain torch reference, in turn, on one mapping and one tracking step."""
    from . import commands
    from .bench.kernels import bench_kernels, print_table

    result = bench_kernels(rays, repeats)
    print_table(result)
    commands.write_json(json, result)


@bench.command(name="speed")
def bench_speed(
    sequence: SequenceArgument = "synthetic/studio",
    presets: Annotated[str, typer.Option(help="Presets to run, separated by commas.")] = "live,lite",
    frames: Frames = "0:200",
    repeats: Annotated[int, typer.Option(min=1, help="Runs of each; medians are printed.")] = 3,
    device: Device = "auto",
    peer: Annotated[bool, typer.Option("--peer", help="Also run Open3D's dense SLAM, if it is installed.")] = False,
    json: Json = None,
    plot: Annotated[
        Path | None, typer.Option(callback=_place, help="Write a plot of the cost per frame to this PNG file.")
    ] = None,
) -> None:
    """Frames per second, all included; time per stage; growth of cost and memory; a rival beside it."""
    from . import commands
    from .bench.runs import require_a_run
    from .bench.speed import bench_speed, plot_speed, print_table

    names = [name.strip() for name in presets.split(",")]
    result = bench_speed(sequence, names, frames, repeats, commands.pick_device(device), peer)
    print_table(result)
    commands.write_json(json, result)
    require_a_run([result["errors"][name] for name in names], repeats)
    if plot is not None:
        plot_speed(result, plot)


@bench.command(name="viewers")
def bench_viewers(
    sequence: SequenceArgument = "synthetic/studio",
    preset: Annotated[str, typer.Option(help="Preset, or a YAML file.")] = "live",
    frames: Frames = "",
    viewers: Annotated[int, typer.Option(min=1, max=200, help="How many pages are open at once.")] = 20,
    pairs: Annotated[int, typer.Option(min=1, help="Comparisons at most; the median is printed.")] = 5,
    device: Device = "auto",
    json: Json = None,
) -> None:
    """Frames per second with many open pages against none, in turn within one run."""
    from . import commands
    from .bench.viewers import print_result

    result = commands.bench_viewers(sequence, preset, frames, viewers, pairs, commands.pick_device(device))
    print_result(result)
    commands.write_json(json, result)


@bench.command(name="accuracy")
def bench_accuracy(
    sequence: SequenceArgument = "synthetic/studio",
    presets: Annotated[str, typer.Option(help="Presets to run, separated by commas.")] = "lite",
    frames: Frames = "",
    seeds: Annotated[int, typer.Option(min=1, help="Runs of each, with seeds 0, 1, ...")] = 3,
    ablate: Annotated[bool, typer.Option("--ablate", help="Also without FUS, without EBA, without both.")] = False,
    no_surface: Annotated[bool, typer.Option("--no-surface", help="Trajectories only: saves minutes a run.")] = False,
    settings: Settings = None,
    device: Device = "auto",
    json: Json = None,
) -> None:
    """Trajectory and surface against the ground truth, mean and deviation over seeds; the paper's ablation."""
    from . import commands
    from .bench.accuracy import bench_accuracy, print_table
    from .bench.runs import errors, require_a_run

    names = [name.strip() for name in presets.split(",")]
    result = bench_accuracy(
        sequence,
        names,
        frames,
        seeds,
        commands.pick_device(device),
        ablate=ablate,
        surface=not no_surface,
        settings=settings or [],
    )
    print_table(result)
    commands.write_json(json, result)
    require_a_run(list(errors(result["variants"]).values()), seeds)


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
