"""What the command line does with cameras that are on."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import closing, contextmanager
from datetime import datetime
from pathlib import Path
from shlex import quote
from time import monotonic

from rich.progress import Progress, TextColumn, TimeElapsedColumn

from .cameras import LiveRecording, is_camera, open_camera, recording_name
from .commands import open_sequence, unused
from .reports import console
from .runtime.driven import import_slam
from .types import InputError, Sequence


@contextmanager
def source(address: str, frames: str, record: Path | None) -> Iterator[tuple[str, Sequence]]:
    """What a run is to be on and its address: the recording or room at ``address``, or what the camera there records
    into the folder ``record`` within the block. Raises InputError."""
    if is_camera(address):
        if frames.strip():
            raise InputError(f"--frames {frames}: is for recordings; a camera's are taken as they come")
        with console.status("loading"):
            import_slam()  # both cores are busy with that, and a camera waits for nobody
        with closing(_switched_on(address, record)) as live:
            yield str(live.folder), live
    elif record is not None:
        raise InputError(f"--record {record}: is for a camera; {address} is recorded already")
    else:
        yield address, open_sequence(address)


def _switched_on(address: str, folder: Path | None) -> LiveRecording:
    folder = (folder or unused(Path("recordings") / recording_name(address, datetime.now()))).absolute()
    camera = open_camera(address)
    try:
        live = LiveRecording(camera, folder)
    except InputError:
        camera.close()
        raise
    console.print(f"{live.rig.name}: recording into {live.folder}", soft_wrap=True)
    return live


def record(address: str, folder: Path | None, seconds: float) -> None:
    """Record what a camera sees, for so many seconds or until Ctrl-C. Raises InputError."""
    if not is_camera(address):
        raise InputError(f"{address}: no camera; give one as in camera/realsense")
    end = monotonic() + seconds if seconds else math.inf
    columns = (TextColumn("{task.description}"), TimeElapsedColumn())
    with closing(_switched_on(address, folder)) as live, Progress(*columns, console=console) as bar:
        task = bar.add_task("recording")
        try:
            while not live.wait(min(0.25, max(end - monotonic(), 0))) and monotonic() < end:
                bar.update(task, description=f"recording  {len(live)} frames  {live.bytes / 1e6:.0f} MB")
        except KeyboardInterrupt:
            pass
    console.print(f"{len(live)} frames; run them with: ecslam run {quote(str(live.folder))}", soft_wrap=True)
    if live.trouble:
        raise InputError(live.trouble)
