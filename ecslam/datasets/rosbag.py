"""ROS: a .bag, .mcap or .db3 file or a rosbag2 folder, with colour, depth and CameraInfo.

Of ROS 1 and 2. Depth that is registered to colour is taken as it is; where there is none, colour is moved to depth, by
the CameraInfo of both and the transforms between their frames. A pose belongs to the recording's ground truth only
where transforms lead from a frame called ``world`` to the camera; odometry is an estimate, and of another frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..types import InputError
from .files import FileSequence
from .roscameras import cameras_of, units_per_m
from .rosfiles import Place
from .rosimages import color_of, depth_of
from .rosmessages import Recording
from .rostopics import Topic, choose
from .rostruth import true_poses
from .tum import MAX_DIFFERENCE_S, associate

SUFFIXES = (".bag", ".mcap", ".db3")
OPTIONS = ("color", "depth")


def sniff(path: Path) -> bool:
    """Whether it is a file that ROS records, or a folder with metadata.yaml and such files."""
    if path.suffix.lower() in SUFFIXES and path.is_file():
        return True
    return (path / "metadata.yaml").is_file() and any(_is_part(each.name) for each in path.iterdir())


@dataclass(eq=False, kw_only=True)
class RosRecording(FileSequence):
    """color, depth: the topics; color_places, depth_places: where each frame's messages lie."""

    recording: Recording
    color: Topic
    depth: Topic
    color_places: list[Place]
    depth_places: list[Place]

    def _place(self) -> Path:
        return self.recording.path

    def _stored(self, index: int, size: tuple[int, int]) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        message = self.recording.message(self.color.name, self.color_places[index])
        color = color_of(message, self.color_size, f"{self.recording.path}: {self.color.name} of frame {index}")
        message = self.recording.message(self.depth.name, self.depth_places[index])
        place = f"{self.recording.path}: {self.depth.name} of frame {index}"
        return color, depth_of(message, size, self.depth_scale, place)


def open(path: Path, color: str = "", depth: str = "") -> RosRecording:
    """Open it. color, depth: topics, where it has several. Raises InputError."""
    recording = Recording(path, _parts(path))
    pair = choose(recording, color, depth)
    color_topic, depth_topic = pair.color, pair.depth
    cameras = cameras_of(recording, pair)
    scale, scale_notes = units_per_m(recording, depth_topic)
    color_places, depth_places = recording.places[color_topic.name], recording.places[depth_topic.name]
    color_times, depth_times = _times(color_places), _times(depth_places)
    pairs = associate(color_times, depth_times, MAX_DIFFERENCE_S)
    if len(pairs) == 0:
        raise InputError(
            f"{path}: no image of {color_topic.name} lies within 20 ms of one of {depth_topic.name}; "
            "are both stamped by one clock?"
        )
    times = depth_times[pairs[:, 1]]
    taken_by = color_topic if cameras.registration is None else depth_topic
    poses, pose_notes = true_poses(recording, taken_by.kind.frame, times)
    recording.places.clear()  # hundreds of bytes for each transform
    dropped = len(color_times) - len(pairs), len(depth_times) - len(pairs)
    unpaired = f"{dropped[0]} colour and {dropped[1]} depth images have no partner within 20 ms and are left out"
    return RosRecording(
        name=path.name if path.is_dir() else path.stem,
        layout="rosbag",
        preset="lite",
        intrinsics=cameras.frames,
        color_files=[],
        depth_files=[],
        depth_scale=scale,
        times=times,
        poses=poses,
        color_size=color_topic.kind.size,
        notes=(*recording.lost, *((unpaired,) if any(dropped) else ()), *cameras.notes, *scale_notes, *pose_notes),
        registration=cameras.registration,
        recording=recording,
        color=color_topic,
        depth=depth_topic,
        color_places=[color_places[i] for i in pairs[:, 0]],
        depth_places=[depth_places[i] for i in pairs[:, 1]],
    )


def _is_part(name: str) -> bool:
    return name[0] != "." and name.lower().removesuffix(".zstd").endswith((".mcap", ".db3"))


def _parts(path: Path) -> list[Path]:
    """The files of the recording."""
    if not path.is_dir():
        return [path]
    files = sorted((each for each in path.iterdir() if _is_part(each.name)), key=lambda file: (len(file.name), file))
    packed = next((file for file in files if file.suffix == ".zstd"), None)
    if packed is not None:
        raise InputError(f"{path}: {packed.name} is compressed as a whole; unpack it with `zstd -d --rm {packed.name}`")
    return files


def _times(places: list[Place]) -> NDArray[np.float64]:
    return np.array([place.time_ns for place in places], np.int64) / 1e9
