"""Which topics of a recording of ROS are colour, depth registered to it, and their camera."""

from __future__ import annotations

from itertools import product
from typing import Any, NamedTuple

import numpy as np

from ..types import FrameError, InputError, Intrinsics
from .reading import INTRINSICS_FILE, MAX_PIXELS, read_intrinsics
from .rosimages import GREY, ImageKind, kind_of
from .rosmessages import CAMERA_INFO, COMPRESSED, IMAGE, Recording

REGISTERED = ("aligned", "registered", "to_color", "to_rgb")  # in the name of a topic of depth
USUAL = ("image_raw", "image_color", "image_rect_color", "image_rect", "image", "depth_registered")
TRANSPORTS = ("/compressed", "/compressedDepth")
TRIES = 5
MOST_LISTED = 12
LENSES = {"plumb_bob": (4, 5), "rational_polynomial": (8,)}  # how many numbers they take, in OpenCV's order
NO_DISTORTION: tuple[float, ...] = ()
HOW_TO_CHOOSE = "say which with ?color=/TOPIC&depth=/TOPIC after the path"
HOW_TO_RECORD = "record with align_depth.enable:=true (RealSense) or depth_registration:=true (others)"


class Topic(NamedTuple):
    """A topic of images and what its first readable one says."""

    name: str
    kind: ImageKind

    @property
    def base(self) -> str:
        """Its name without the transport."""
        return next((self.name[: -len(end)] for end in TRANSPORTS if self.name.endswith(end)), self.name)

    @property
    def rectified(self) -> bool:
        """Whether the distortion of its lens has been removed."""
        return "_rect" in self.base

    @property
    def unusual(self) -> tuple[bool, bool, bool]:
        """The less it is like what a camera's driver publishes, the larger."""
        return self.kind.encoding in GREY, self.base.rpartition("/")[2] not in USUAL, self.kind.packed


def choose(recording: Recording, color: str, depth: str) -> tuple[Topic, Topic]:
    """The topics of colour and of depth registered to it. color, depth: as the user says, or "". Raises InputError."""
    topics, unreadable = _image_topics(recording)
    colors = _candidates(recording, "colour", color, [t for t in topics if t.kind.is_color], topics, unreadable)
    distances = [t for t in topics if t.kind.is_depth and (t.name == depth or not _infrared(t))]
    depths = _candidates(recording, "depth", depth, distances, topics, unreadable)
    pairs = list(product(colors, depths))
    if not (color and depth):
        pairs = _registered(pairs)
    if not pairs:
        a, b = min(colors, key=lambda t: t.unusual), min(depths, key=lambda t: t.unusual)
        raise InputError(
            f"{recording.path}: depth ({b.name}, seen from {b.kind.frame or 'an unnamed frame'}) is not registered to "
            f"colour ({a.name}, seen from {a.kind.frame or 'an unnamed frame'}): {HOW_TO_RECORD}, or where it is, "
            f"{HOW_TO_CHOOSE}"
        )
    return _best(pairs, recording)


def _candidates(
    recording: Recording, what: str, asked: str, fit: list[Topic], topics: list[Topic], unreadable: dict[str, str]
) -> list[Topic]:
    """Of the topics that ``fit``, the one asked for, or all. Raises InputError when there is none."""
    found = [topic for topic in fit if asked in ("", topic.name)]
    if found:
        return found
    there = f"its topics of images {_listed(topics)}"
    if asked in unreadable:
        reason = unreadable[asked]
    elif asked:
        reason = f"{asked} is no topic with {what} images; {there}"
    else:
        reason = "; ".join([f"no {what} images: {there}", *[*recording.lost, *unreadable.values()][:1]])
    raise InputError(f"{recording.path}: {reason}; choose another, or record it again")


def camera_of(recording: Recording, color: Topic, depth: Topic) -> tuple[Intrinsics, tuple[str, ...]]:
    """The camera of the images at the size of depth, and notes. Raises InputError."""
    folder = recording.path if recording.path.is_dir() else recording.path.parent
    if (folder / INTRINSICS_FILE).is_file():
        note = f"the camera is that of {INTRINSICS_FILE}, without distortion"
        return read_intrinsics(folder / INTRINSICS_FILE, *depth.kind.size), (note,)
    infos = recording.of_type(CAMERA_INFO)
    wanted = [f"{topic.base.rpartition('/')[0]}/camera_info" for topic in (color, depth)]
    name = next((each for each in wanted if each in infos), None)
    if name is None:
        raise InputError(
            f"{recording.path}: no {wanted[0]} in it (sensor_msgs/CameraInfo); record it, or write the camera's 3x3 "
            f"matrix to {folder / INTRINSICS_FILE}"
        )
    camera = _camera(recording.message(name, recording.places[name][0]), color, depth, f"{recording.path}: {name}")
    return camera, () if name == wanted[0] else (f"no {wanted[0]}: the camera is that of {name}",)


def _image_topics(recording: Recording) -> tuple[list[Topic], dict[str, str]]:
    """Those of which an image can be read, and why not of the others, by name."""
    topics, unreadable = [], {}
    for name in recording.of_type(IMAGE, COMPRESSED):
        for place in recording.places[name][:TRIES]:
            try:
                kind = kind_of(recording.message(name, place), f"{recording.path}: {name}")
            except FrameError as error:
                unreadable[name] = str(error).removeprefix(f"{recording.path}: ")
                continue
            if 0 < kind.width * kind.height <= MAX_PIXELS:
                topics.append(Topic(name, kind))
                unreadable.pop(name, None)
                break
            unreadable[name] = f"{name} has images of {kind.width}x{kind.height} pixels; 1 to {MAX_PIXELS} are read"
    return topics, unreadable


def _infrared(topic: Topic) -> bool:
    """16-bit brightness."""
    return topic.kind.encoding == "mono16" and "depth" not in topic.name


def _registered(pairs: list[tuple[Topic, Topic]]) -> list[tuple[Topic, Topic]]:
    """Those that one camera sees, else those where depth says so in its name."""
    same = [(c, d) for c, d in pairs if c.kind.frame and c.kind.frame == d.kind.frame]
    named = [(c, d) for c, d in pairs if any(word in d.name for word in REGISTERED)]
    return same or named


def _best(pairs: list[tuple[Topic, Topic]], recording: Recording) -> tuple[Topic, Topic]:
    def unusual(pair: tuple[Topic, Topic]) -> tuple[Any, ...]:
        color, depth = pair
        return color.unusual, depth.unusual, color.rectified != depth.rectified

    least = min(map(unusual, pairs))
    best = [pair for pair in pairs if unusual(pair) == least]
    if len(best) > 1:
        names = sorted({topic.name for pair in best for topic in pair})
        raise InputError(f"{recording.path}: several cameras or images: {', '.join(names)}; {HOW_TO_CHOOSE}")
    return best[0]


def _listed(topics: list[Topic]) -> str:
    names = [f"{topic.name} {topic.kind.encoding}" for topic in topics]
    more = f" and {len(names) - MOST_LISTED} more" if len(names) > MOST_LISTED else ""
    return f"are {', '.join(names[:MOST_LISTED])}{more}" if names else "are none"


def _camera(info: Any, color: Topic, depth: Topic, place: str) -> Intrinsics:
    """Of what is left when the images are undistorted as ``distortion`` tells: nothing is, where they are rectified."""
    lens, projection = (info.k, info.p) if hasattr(info, "k") else (info.K, info.P)
    matrix = projection.reshape(3, 4) if color.rectified and np.any(projection) else lens.reshape(3, 3)
    distortion = NO_DISTORTION if color.rectified and depth.rectified else _distortion(info, place)
    if distortion and color.rectified != depth.rectified:
        raise InputError(f"{place}: only one of {color.name} and {depth.name} is rectified; record both so, or neither")
    if not (np.isfinite(matrix).all() and np.isfinite(distortion).all()):
        raise InputError(f"{place}: holds what is not a number; calibrate the camera and record it again")
    fx, fy, cx, cy = (float(matrix[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    width, height = (info.width, info.height) if info.width and info.height else color.kind.size
    return Intrinsics(fx, fy, cx, cy, width, height, distortion).resized(*depth.kind.size)


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
