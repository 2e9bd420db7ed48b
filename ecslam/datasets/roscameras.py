"""The cameras of a recording of ROS, as CameraInfo or a file beside it tells: one for both images, or one for each."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..types import InputError, Intrinsics
from .reading import INTRINSICS_FILE, read_intrinsics, require_focal_lengths, same_shape
from .realsense import NUMBER, measures, stream_of
from .registration import Registration
from .rosmessages import CAMERA_INFO, Recording
from .rostopics import Pair, Topic

BROWN_CONRADY = "Brown Conrady", "Inverse Brown Conrady", "Modified Brown Conrady"
LENSES = {  # how many numbers they take, in OpenCV's order
    "plumb_bob": (4, 5),
    "rational_polynomial": (8,),
    **dict.fromkeys(BROWN_CONRADY, (5,)),  # what librealsense calls plumb_bob; it bends points as OpenCV does for all
}
NO_DISTORTION: tuple[float, ...] = ()
UNITS_PER_M = 1000.0  # of ROS


class Cameras(NamedTuple):
    """frames: the camera of the frames. registration: where colour is to be moved to depth. notes: what is odd."""

    frames: Intrinsics
    registration: Registration | None
    notes: tuple[str, ...]


def cameras_of(recording: Recording, pair: Pair) -> Cameras:
    """Of a registered pair at the size of depth, or of depth where colour is to be moved to it: then the file beside
    the recording tells depth's camera, and CameraInfo that of colour. Raises InputError."""
    if pair.depth_to_color is None:
        return _shared(recording, pair)
    return _apart(recording, pair, pair.depth_to_color)


def units_per_m(recording: Recording, depth: Topic) -> tuple[float, tuple[str, ...]]:
    """Of what 16 bits hold: ROS has millimetres, librealsense what it tells. And notes. Raises InputError."""
    stream = stream_of(depth.name)
    if not stream:
        return UNITS_PER_M, ()
    name = next((each for each in recording.of_type(NUMBER) if measures(each, stream)), None)
    if name is None:
        return UNITS_PER_M, ("no Depth_Units in it: depth is taken for millimetres",)
    metres = float(recording.message(name, recording.places[name][0]).data)
    if not 0 < metres < np.inf:
        raise InputError(f"{recording.path}: {name}: {metres:g} m is no unit of depth; record it again")
    return 1 / metres, ()


def _shared(recording: Recording, pair: Pair) -> Cameras:
    color, depth = pair.color, pair.depth
    same_shape(color.kind.size, depth.kind.size, recording.path)
    if recording.by_hand.is_file():
        note = f"the camera is that of {INTRINSICS_FILE}, without distortion"
        return Cameras(read_intrinsics(recording.by_hand, *depth.kind.size), None, (note,))
    told = recording.of_type(CAMERA_INFO)
    name = next((each for each in (color.info, depth.info) if each in told), None)
    if name is None:
        raise InputError(
            f"{recording.path}: no {color.info} in it (sensor_msgs/CameraInfo); record it, or write the camera's 3x3 "
            f"matrix to {recording.by_hand}"
        )
    place = f"{recording.path}: {name}"
    info = _info(recording, name)
    if color.rectified != depth.rectified and _distortion(info, place):
        raise InputError(f"{place}: only one of {color.name} and {depth.name} is rectified; record both so, or neither")
    camera = _camera(info, color, place).resized(*depth.kind.size)
    return Cameras(camera, None, () if name == color.info else (f"no {color.info}: the camera is that of {name}",))


def _apart(recording: Recording, pair: Pair, depth_to_color: NDArray[np.float64]) -> Cameras:
    by_hand = recording.by_hand.is_file()
    size = pair.depth.kind.size
    depth = read_intrinsics(recording.by_hand, *size) if by_hand else _own(recording, pair.depth)
    color = _own(recording, pair.color)
    for camera, place in ((depth, INTRINSICS_FILE if by_hand else pair.depth.info), (color, pair.color.info)):
        require_focal_lengths(camera, f"{recording.path}: {place}")
    try:
        registration = Registration(depth, color, depth_to_color)
    except InputError as error:
        raise InputError(f"{recording.path}: {pair.color.name} and {pair.depth.name}: {error}") from None
    notes = (f"depth's camera is that of {INTRINSICS_FILE}, without distortion",) if by_hand else ()
    return Cameras(registration.camera, registration, notes)


def _own(recording: Recording, topic: Topic) -> Intrinsics:
    """The camera of a topic's images."""
    info = _info(recording, topic.info)
    return _camera(info, topic, f"{recording.path}: {topic.info}").resized(*topic.kind.size)


def _info(recording: Recording, name: str) -> Any:
    return recording.message(name, recording.places[name][0])


def _camera(info: Any, topic: Topic, place: str) -> Intrinsics:
    """Of what is left when the images are undistorted as ``distortion`` tells: nothing is, where they are rectified."""
    lens, projection = (info.k, info.p) if hasattr(info, "k") else (info.K, info.P)
    matrix = projection.reshape(3, 4) if topic.rectified and np.any(projection) else lens.reshape(3, 3)
    distortion = NO_DISTORTION if topic.rectified else _distortion(info, place)
    if not (np.isfinite(matrix).all() and np.isfinite(distortion).all()):
        raise InputError(f"{place}: holds what is not a number; calibrate the camera and record it again")
    fx, fy, cx, cy = (float(matrix[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    width, height = (info.width, info.height) if info.width and info.height else topic.kind.size
    return Intrinsics(fx, fy, cx, cy, width, height, distortion)


def _distortion(info: Any, place: str) -> tuple[float, ...]:
    numbers = tuple(float(value) for value in (info.d if hasattr(info, "d") else info.D))
    if not any(numbers):
        return NO_DISTORTION
    if len(numbers) not in LENSES.get(info.distortion_model, ()):
        raise InputError(
            f"{place}: a lens {info.distortion_model!r} with {len(numbers)} numbers, which is not corrected; record "
            "rectified images"
        )
    return numbers
