"""The commands ``ecslam bench``. Heavy imports wait until one runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .options import Device, Frames, Json, SequenceArgument, Settings, place

bench = typer.Typer(help="Measure: back ends against each other, speed, accuracy, many viewers.", no_args_is_help=True)


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
    commands.write_json(json, result, result["device"])


@bench.command(name="speed")
def bench_speed(
    sequence: SequenceArgument = "synthetic/studio",
    presets: Annotated[str, typer.Option(help="Presets or YAML files, separated by commas.")] = "live,lite",
    frames: Annotated[str, typer.Option(metavar="A:B:STEP", help="Which frames, as a Python slice.")] = "0:200",
    repeats: Annotated[int, typer.Option(min=1, help="Runs of each; medians are printed.")] = 3,
    device: Device = "auto",
    peer: Annotated[bool, typer.Option("--peer", help="Also run Open3D's dense SLAM, if it is installed.")] = False,
    json: Json = None,
    plot: Annotated[
        Path | None, typer.Option(callback=place, help="Write a plot of the cost per frame to this PNG file.")
    ] = None,
) -> None:
    """Frames per second, all included; time per stage; growth of cost and memory; a rival beside it."""
    from . import commands
    from .bench.runs import require_a_run
    from .bench.speed import bench_speed, plot_speed, print_table

    device = commands.pick_device(device)
    names = [name.strip() for name in presets.split(",")]
    result = bench_speed(sequence, names, frames, repeats, device, peer)
    print_table(result)
    commands.write_json(json, result, device)
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

    device = commands.pick_device(device)
    result = commands.bench_viewers(sequence, preset, frames, viewers, pairs, device)
    print_result(result)
    commands.write_json(json, result, device)


@bench.command(name="accuracy")
def bench_accuracy(
    sequence: SequenceArgument = "synthetic/studio",
    presets: Annotated[str, typer.Option(help="Presets or YAML files, separated by commas.")] = "lite",
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

    device = commands.pick_device(device)
    names = [name.strip() for name in presets.split(",")]
    result = bench_accuracy(
        sequence,
        names,
        frames,
        seeds,
        device,
        ablate=ablate,
        surface=not no_surface,
        settings=settings or [],
    )
    print_table(result)
    commands.write_json(json, result, device)
    require_a_run(list(errors(result["variants"]).values()), seeds)
