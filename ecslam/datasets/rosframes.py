"""Frames of a recording of ROS: which hangs on which, and the transforms that lead from one to another."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..indices import evenly
from ..types import FrameError, InputError
from .realsense import TRANSFORM, motion_of
from .rosfiles import printable
from .rosmessages import OLD_TRANSFORMS, TRANSFORMS, Recording
from .tum import MAX_DIFFERENCE_S, interpolate_poses

Table = NDArray[np.float64]
Links = dict[str, tuple[str, Table]]
LOOKED_AT = 300  # messages that tell which frame hangs on which
FIXED = 1e-6  # how little a link moves that is known at all times


def links_of(recording: Recording, most: int | None) -> Links:
    """By child: its parent, "" for several, and time x y z qx qy qz qw [M, 8] at ascending distinct times. most:
    messages of a topic to look at, spread over it."""
    found: dict[str, tuple[str, list[list[float]]]] = {}
    for topic in recording.of_type(TRANSFORMS, OLD_TRANSFORMS):
        places = recording.places[topic]
        for i in evenly(len(places), most or len(places)):
            try:
                message = recording.message(topic, places[i])
            except FrameError:
                continue
            for each in message.transforms:
                told_by = each.header.frame_id.strip("/")
                parent, rows = found.setdefault(each.child_frame_id.strip("/"), (told_by, []))
                stamp = each.header.stamp
                if told_by != parent:
                    found[each.child_frame_id.strip("/")] = "", rows
                else:
                    rows.append([(10**9 * stamp.sec + stamp.nanosec) / 1e9, *_pose(each.transform)])
    tables = {child: (parent, _ascending(np.array(rows))) for child, (parent, rows) in found.items()}
    return {child: (parent, table) for child, (parent, table) in tables.items() if len(table)}


def stream_links(recording: Recording) -> Links:
    """The same of librealsense's streams: each hangs on the reference of its group."""
    from scipy.spatial.transform import Rotation

    links: Links = {}
    for topic in recording.of_type(TRANSFORM):
        names = motion_of(topic)
        try:
            message = recording.message(topic, recording.places[topic][0])
        except FrameError:
            continue
        table = _ascending(np.array([[0.0, *_pose(message)]]))
        if names is not None and len(table):
            reference, stream = names
            back = Rotation.from_quat(table[:, 4:]).inv()
            links[stream] = reference, np.column_stack([table[:, 0], -back.apply(table[:, 1:4]), back.as_quat()])
    return links


def chain(links: Links, frame: str) -> list[str]:
    """The frames from ``frame`` upwards."""
    frames = [frame]
    while frames[-1] in links and len(frames) <= len(links):
        frames.append(links[frames[-1]][0])
    return frames


def moves(table: Table) -> bool:
    """Whether a link does not always stay the same."""
    return bool(np.ptp(table[:, 1:], axis=0).max() >= FIXED)


def poses_at(links: Links, frames: list[str], times: NDArray[np.float64]) -> NDArray[np.float64]:
    """Poses [N, 4, 4] at ``times`` of the first of ``frames``, as ``chain`` has them, in the last one; NaN where one of
    the links between is not known."""
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    for child in frames[:-1]:
        poses = _at(links[child][1], times) @ poses
    return poses


def fixed_motion(links: Links, start: str, end: str) -> NDArray[np.float64]:
    """[4, 4] takes points from frame ``start`` to frame ``end``, over the first frame on which both hang. Raises
    InputError, with the reason alone, when nothing joins them, or it moves."""
    first, last = chain(links, start), chain(links, end)
    common = next((frame for frame in first if frame and frame in last), None)
    if common is None:
        raise InputError(f"no transforms in it join {start or 'an unnamed frame'} and {end or 'an unnamed frame'}")
    ways = first[: first.index(common) + 1], last[: last.index(common) + 1]
    loose = next((child for way in ways for child in way[:-1] if moves(links[child][1])), None)
    if loose is not None:
        raise InputError(f"{printable(loose)} moves against {printable(links[loose][0])}")
    from_start, from_end = (poses_at(links, way, np.zeros(1))[0] for way in ways)
    motion: NDArray[np.float64] = np.linalg.inv(from_end) @ from_start
    return motion


def _pose(transform: Any) -> list[float]:
    """x y z qx qy qz qw."""
    move, turn = transform.translation, transform.rotation
    return [move.x, move.y, move.z, turn.x, turn.y, turn.z, turn.w]


def _ascending(table: Table) -> Table:
    """The rows that are poses, by time."""
    table = table[np.isfinite(table).all(1) & (np.abs(np.linalg.norm(table[:, 4:], axis=1) - 1) < 0.1)]
    return table[np.unique(table[:, 0], return_index=True)[1]]


def _at(rows: Table, times: NDArray[np.float64]) -> NDArray[np.float64]:
    """A link's poses [N, 4, 4] at ``times``: the same where it never moves, else between those told nearby."""
    if not moves(rows):
        return interpolate_poses(rows[:1, 0], rows[:1, 1:], np.full(len(times), rows[0, 0]), MAX_DIFFERENCE_S)
    return interpolate_poses(rows[:, 0], rows[:, 1:], times, MAX_DIFFERENCE_S)
