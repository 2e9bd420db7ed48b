"""The arguments and options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .runtime.files import require_place


def place(option: typer.CallbackParam, file: Path | None) -> Path | None:
    """What an option names, once it is sure that it can be written. Raises InputError."""
    if file is not None:
        require_place(file, f"--{option.name}")
    return file


SequenceArgument = Annotated[
    str,
    typer.Argument(
        help="A folder (7-Scenes, TUM RGB-D, Replica, ScanNet ..., recognised by itself), a file (.bag, .mcap, .db3, "
        ".sens, .r3d), a built-in room (synthetic/studio, synthetic/apartment, synthetic/corridor, synthetic/gallery) "
        "or, to run on, a camera that is plugged in: camera/realsense."
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
Json = Annotated[Path | None, typer.Option(callback=place, help="Write every figure to this file.")]
RunFolder = Annotated[Path, typer.Argument(help="A run folder, as `ecslam run` leaves it.")]
