"""Recorded with ecslam: recording.yaml (the cameras), frames.txt (time and name of each), rgb/ (JPEG), depth/ (PNG).

Images are stored as the cameras gave them; colour is moved to depth on reading. groundtruth.txt, if there is one, is
as TUM's.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..atomic import write_named
from ..strict_yaml import is_number, parse_yaml
from ..types import InputError, Intrinsics
from .calibration import PINHOLE, SIZE
from .files import FileSequence
from .listing import read_rows, to_times
from .reading import common_size, read_text, rigid
from .registration import Registration
from .tum import ground_truth, with_both

FILE, TIMES = "recording.yaml", "frames.txt"
ABOUT = """\
# What recorded the images in rgb/ and depth/, whose times are in frames.txt. depth_scale: units of depth a metre;
# depth, color: the cameras, in pixels, distortion as OpenCV has it (k1 k2 p1 p2 k3); depth_to_color: takes points in
# metres from the first one's coordinates to the second one's, row by row.
"""


@dataclass(frozen=True, eq=False)
class Rig:
    """What records: a camera of depth and one of colour. name: shown to people. depth_scale: stored units per metre.
    depth_to_color: [4, 4] takes points in metres from the first one's coordinates to the second one's."""

    name: str
    depth_scale: float
    depth: Intrinsics
    color: Intrinsics
    depth_to_color: NDArray[np.float64]

    def registration(self) -> Registration | None:
        """What moves colour to depth; None where it lies there already. Raises InputError where the two hardly see the
        same."""
        same = replace(self.depth, readout_s=0.0) == replace(self.color, readout_s=0.0)
        if same and np.array_equal(self.depth_to_color, np.eye(4)):
            return None
        return Registration(self.depth, self.color, self.depth_to_color)


class Recording(FileSequence):
    """Frames that ``rig`` recorded at ``times`` [N] into ``folder``, by these names. See ``FileSequence``."""

    def __init__(
        self,
        folder: Path,
        rig: Rig,
        names: list[str],
        times: NDArray[np.float64],
        poses: NDArray[np.float64] | None = None,
        notes: tuple[str, ...] = (),
    ) -> None:
        registration = rig.registration()
        self.rig, self.folder = rig, folder
        super().__init__(
            name=folder.name,
            layout="recording",
            preset="live",
            intrinsics=registration.camera if registration else rig.depth,
            color_files=[color_file(folder, name) for name in names],
            depth_files=[depth_file(folder, name) for name in names],
            depth_scale=rig.depth_scale,
            times=times,
            poses=poses,
            color_size=(rig.color.width, rig.color.height),
            notes=notes,
            registration=registration,
        )

    def add_files(self, name: str) -> None:
        """One frame more lies, or will lie, on disk."""
        self.color_files.append(color_file(self.folder, name))
        self.depth_files.append(depth_file(self.folder, name))

    def _place(self) -> Path:
        return self.folder / FILE


def color_file(folder: Path, name: str) -> Path:
    """Where the colour of the frame ``name`` lies."""
    return folder / "rgb" / f"{name}.jpg"


def depth_file(folder: Path, name: str) -> Path:
    """Where the depth of the frame ``name`` lies."""
    return folder / "depth" / f"{name}.png"


def sniff(path: Path) -> bool:
    """Whether the folder has recording.yaml."""
    return (path / FILE).is_file()


def open(path: Path) -> Recording:
    """Open the folder. Raises InputError."""
    rig = read_rig(path / FILE)
    if not (path / TIMES).is_file():
        raise InputError(f"{path / TIMES}: is missing, and with it the times of all frames; put it back")
    rows = read_rows(path / TIMES, 2, may_break_off=True)
    times = to_times([row[0] for row in rows], path / TIMES)
    color, depth = ([place(path, row[1]) for row in rows] for place in (color_file, depth_file))
    kept, notes = with_both(path, color, depth)
    for files, camera in ((color, rig.color), (depth, rig.depth)):
        width, height = common_size([files[i] for i in kept])
        if (width, height) != (camera.width, camera.height):
            told = f"{FILE} says {camera.width}x{camera.height}"
            raise InputError(
                f"{path}: images such as {files[0].name} are {width}x{height}, but {told}; put back its own"
            )
    poses, pose_notes = ground_truth(path, None, times[kept])
    return Recording(path, rig, [rows[i][1] for i in kept], times[kept], poses, (*notes, *pose_notes))


def write_rig(path: Path, rig: Rig) -> None:
    """Write what ``read_rig`` reads back. Raises InputError when it cannot be written."""
    told = {
        "camera": rig.name,
        "depth_scale": float(rig.depth_scale),
        "depth": _written(rig.depth),
        "color": _written(rig.color),
        "depth_to_color": [float(value) for value in rig.depth_to_color.ravel()],
    }
    text = "".join(f"{key}: {json.dumps(value)}\n" for key, value in told.items())
    write_named(path, (ABOUT + text).encode())


def read_rig(path: Path) -> Rig:
    """The cameras in a ``recording.yaml``. Raises InputError, in one line that names the file."""
    given = parse_yaml(read_text(path), str(path))
    try:
        move = np.array(given["depth_to_color"], np.float64).reshape(4, 4)
        if np.isnan(rigid(move[None])[0]).any():
            raise ValueError("depth_to_color is no rigid motion")
        cameras = _camera(given["depth"]), _camera(given["color"])
        return Rig(str(given["camera"]), float(given["depth_scale"]), *cameras, move)
    except (KeyError, TypeError, ValueError) as error:
        wrong = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise InputError(
            f"{path}: does not say what recorded this ({wrong}); put the one back that was written"
        ) from None


def _written(camera: Intrinsics) -> dict[str, Any]:
    numbers: dict[str, Any] = {key: float(getattr(camera, key)) for key in (*PINHOLE, "readout_s")}
    numbers |= {key: int(getattr(camera, key)) for key in SIZE}
    return numbers | {"distortion": [float(value) for value in camera.distortion]}


def _camera(given: Mapping[str, Any]) -> Intrinsics:
    """Raises KeyError, TypeError, ValueError."""
    numbers = [*(given[key] for key in (*PINHOLE, *SIZE, "readout_s")), *given["distortion"]]
    if not all(is_number(value) for value in numbers):
        raise ValueError("a camera has something that is not a number")
    fx, fy, cx, cy, width, height, readout_s = numbers[:7]
    return Intrinsics(fx, fy, cx, cy, int(width), int(height), tuple(numbers[7:]), readout_s)
