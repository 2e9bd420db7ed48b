"""Which topics of a recording of ROS are colour and depth that go together."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..types import FrameError, InputError
from .reading import MAX_PIXELS
from .realsense import info_of, stream_of
from .rosframes import FIXED, LOOKED_AT, Links, fixed_motion, links_of, stream_links
from .rosimages import GREY, ImageKind, kind_of
from .rosmessages import CAMERA_INFO, COMPRESSED, IMAGE, Recording

REGISTERED = ("aligned", "registered", "to_color", "to_rgb")  # in the name of a topic of depth
USUAL = ("image_raw", "image_color", "image_rect_color", "image_rect", "image", "depth_registered")
TRANSPORTS = ("/compressed", "/compressedDepth")
TRIES = 5
MOST_LISTED = 12
HOW_TO_CHOOSE = "say which with ?color=/TOPIC&depth=/TOPIC after the path"
HOW_TO_RECORD = (
    "record the camera_info of both and /tf_static as well, or registered depth: align_depth.enable:=true (RealSense), "
    "depth_registration:=true (others)"
)


class Topic(NamedTuple):
    """A topic of images and what its first readable one says."""

    name: str
    kind: ImageKind

    @property
    def base(self) -> str:
        """Its name without the transport."""
        return next((self.name[: -len(end)] for end in TRANSPORTS if self.name.endswith(end)), self.name)

    @property
    def info(self) -> str:
        """The topic of its camera."""
        stream = stream_of(self.name)
        return info_of(stream) if stream else f"{self.base.rpartition('/')[0]}/camera_info"

    @property
    def rectified(self) -> bool:
        """Whether the distortion of its lens has been removed."""
        return "_rect" in self.base

    @property
    def unusual(self) -> tuple[bool, bool, bool]:
        """The less it is like what a camera's driver publishes, the larger."""
        return self.kind.encoding in GREY, self.base.rpartition("/")[2] not in USUAL, self.kind.packed


class Pair(NamedTuple):
    """Topics that go together. depth_to_color: [4, 4] takes points in metres from the frame of depth to that of colour;
    None where depth is registered to it."""

    color: Topic
    depth: Topic
    depth_to_color: NDArray[np.float64] | None = None

    @property
    def apart_m(self) -> float:
        """How far apart the two cameras are."""
        return 0.0 if self.depth_to_color is None else float(np.linalg.norm(self.depth_to_color[:3, 3]))


def choose(recording: Recording, color: str, depth: str) -> Pair:
    """The topics of colour and of depth registered to it; where there are none, two whose cameras are known and joined.
    color, depth: as the user says, or ""; both named and not joined, they are taken for registered. Raises
    InputError."""
    topics, unreadable = _image_topics(recording)
    colors = _candidates(recording, "colour", color, [t for t in topics if t.kind.is_color], topics, unreadable)
    distances = [t for t in topics if t.kind.is_depth and (t.name == depth or not _infrared(t))]
    depths = _candidates(recording, "depth", depth, distances, topics, unreadable)
    pairs = [Pair(*both) for both in product(colors, depths)]
    found, why = _registered(pairs), ""
    if not found:
        found, why = _joined(recording, pairs)
    if not found and color and depth:
        found = pairs
    if not found:
        raise InputError(f"{recording.path}: {why}")
    return _best(found, recording)


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
                topics.append(Topic(name, replace(kind, frame=kind.frame or stream_of(name))))
                unreadable.pop(name, None)
                break
            unreadable[name] = f"{name} has images of {kind.width}x{kind.height} pixels; 1 to {MAX_PIXELS} are read"
    return topics, unreadable


def _infrared(topic: Topic) -> bool:
    """16-bit brightness."""
    return (topic.kind.encoding == "mono16" or stream_of(topic.name) != "") and "depth" not in topic.name.lower()


def _registered(pairs: list[Pair]) -> list[Pair]:
    """Those that one camera sees, else those where depth says so in its name."""
    same = [pair for pair in pairs if pair.color.kind.frame and pair.color.kind.frame == pair.depth.kind.frame]
    named = [pair for pair in pairs if any(word in pair.depth.name for word in REGISTERED)]
    return same or named


def _joined(recording: Recording, pairs: list[Pair]) -> tuple[list[Pair], str]:
    """Those whose cameras are known and do not move against each other, or why the most usual is not among them. No
    infrared takes the place of colour that there is."""
    why = ""
    pairs = [pair for pair in pairs if pair.color.kind.encoding not in GREY] or pairs
    for most in (LOOKED_AT, None):  # few transforms tell of cameras that are joined, all that they are not
        links = links_of(recording, most) | stream_links(recording)
        found = []
        for pair in sorted(pairs, key=_unusual, reverse=True):
            try:
                found.append(_join(recording, links, pair))
            except InputError as error:
                why = _why_not(pair, error)
        if found:
            break
    return found, why


def _join(recording: Recording, links: Links, pair: Pair) -> Pair:
    """The pair with the way from depth to colour. Raises InputError, with the reason alone."""
    told = recording.of_type(CAMERA_INFO)
    for topic in (pair.color,) if recording.by_hand.is_file() else (pair.color, pair.depth):
        if topic.info not in told:
            raise InputError(f"there is no {topic.info} in it")
    return pair._replace(depth_to_color=fixed_motion(links, pair.depth.kind.frame, pair.color.kind.frame))


def _why_not(pair: Pair, error: InputError) -> str:
    color, depth = ((each.name, each.kind.frame or "an unnamed frame") for each in (pair.color, pair.depth))
    return (
        f"depth ({depth[0]}, seen from {depth[1]}) is not registered to colour ({color[0]}, seen from {color[1]}), and "
        f"{error}: {HOW_TO_RECORD}; where it is registered, {HOW_TO_CHOOSE}"
    )


def _unusual(pair: Pair) -> tuple[Any, ...]:
    return pair.color.unusual, pair.depth.unusual, pair.color.rectified != pair.depth.rectified


def _best(pairs: list[Pair], recording: Recording) -> Pair:
    """The most usual, and of several cameras those beside each other."""
    least = min(map(_unusual, pairs))
    usual = [pair for pair in pairs if _unusual(pair) == least]
    best = [pair for pair in usual if pair.apart_m <= _nearest_m(pair, usual) + FIXED]
    if len(best) > 1:
        names = sorted({topic.name for pair in best for topic in pair[:2]})
        raise InputError(f"{recording.path}: several cameras or images: {', '.join(names)}; {HOW_TO_CHOOSE}")
    return best[0]


def _nearest_m(pair: Pair, pairs: list[Pair]) -> float:
    """How far apart the nearest are among those that share colour or depth with ``pair``."""
    return min(each.apart_m for each in pairs if each.color is pair.color or each.depth is pair.depth)


def _listed(topics: list[Topic]) -> str:
    names = [f"{topic.name} {topic.kind.encoding}" for topic in topics]
    more = f" and {len(names) - MOST_LISTED} more" if len(names) > MOST_LISTED else ""
    return f"are {', '.join(names[:MOST_LISTED])}{more}" if names else "are none"
