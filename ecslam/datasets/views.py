"""A part of a sequence, and what is odd about its time stamps."""

from __future__ import annotations

import dataclasses
from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..types import Frame, InputError, Intrinsics, Mesh, Sequence

GAP_S, LEAST_IN_ORDER = 1.0, 0.8
UNITS = ((5e6, "nanoseconds"), (5e3, "microseconds"), (5.0, "milliseconds"))  # from which median step on, in seconds


@dataclass(eq=False)
class SequenceView:
    """Some frames of another sequence, renumbered from 0. frames: [N] positions in ``base``."""

    base: Sequence
    frames: NDArray[np.int64]

    def __post_init__(self) -> None:
        self.name: str = self.base.name
        self.layout: str = self.base.layout
        self.preset: str = self.base.preset
        self.intrinsics: Intrinsics = self.base.intrinsics
        self.bounds: NDArray[np.float64] | None = self.base.bounds
        self.notes: tuple[str, ...] = getattr(self.base, "notes", ())

    def __len__(self) -> int:
        return len(self.frames)

    def __iter__(self) -> Iterator[Frame]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, index: int) -> Frame:
        """Read frame ``index`` of the view. Raises FrameError, and IndexError outside 0 .. len - 1."""
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        return dataclasses.replace(self.base[int(self.frames[index])], index=index)

    def timestamps(self) -> NDArray[np.float64]:
        """[N] seconds."""
        return self.base.timestamps()[self.frames]

    def poses_gt(self) -> NDArray[np.float64] | None:
        """[N, 4, 4] camera-to-world, NaN-filled where a frame has none, or None."""
        poses = self.base.poses_gt()
        return None if poses is None else poses[self.frames]

    def reference_mesh(self) -> Mesh | None:
        """The ground-truth surface of the whole sequence, or None."""
        return self.base.reference_mesh()


def with_readout(sequence: Sequence, readout_s: float) -> Sequence:
    """The same sequence, whose camera takes ``readout_s`` seconds from the first row of depth to the last."""
    view = SequenceView(sequence, np.arange(len(sequence)))
    view.intrinsics = dataclasses.replace(sequence.intrinsics, readout_s=readout_s)
    return view


def select_frames(sequence: Sequence, spec: str) -> Sequence:
    """The frames ``A:B:STEP`` with the meaning of a Python slice, as a view; an empty ``spec`` is the whole sequence.

    Raises InputError when ``spec`` is no slice, goes backwards or selects nothing.
    """
    if not spec.strip():
        return sequence
    parts = spec.split(":")
    try:
        if not 2 <= len(parts) <= 3:
            raise ValueError
        start, stop, step = (int(p) if p.strip() else None for p in [*parts, ""][:3])
    except ValueError:
        raise InputError(
            f"--frames {spec[:80]}: write it as A:B or A:B:STEP with whole numbers, e.g. 0:200 or ::2"
        ) from None
    if step is not None and step < 1:
        raise InputError(f"--frames {spec}: STEP must be 1 or more, for time runs forwards")
    chosen = range(len(sequence))[start:stop:step]
    if not chosen:
        raise InputError(
            f"--frames {spec}: selects nothing of {sequence.name}, which has frames 0 .. {len(sequence) - 1}"
        )
    return SequenceView(sequence, np.array(chosen, np.int64))


def in_order(timestamps: NDArray[np.float64]) -> NDArray[np.bool_]:
    """bool [N]: the frames to keep so that time always moves on and as few as possible are left out.

    A longest rising subsequence (Schensted 1961), so that one stamp far in the future costs one frame. Of frames with
    the same time the first stays.
    """
    ends: list[int] = []
    times: list[float] = []
    before = np.full(len(timestamps), -1)
    for index, time in enumerate(timestamps.tolist()):
        place = bisect_left(times, time)
        if place < len(times) and times[place] == time:
            continue
        before[index] = ends[place - 1] if place else -1
        ends[place : place + 1], times[place : place + 1] = [index], [time]
    kept = np.zeros(len(timestamps), bool)
    last = ends[-1] if ends else -1
    while last >= 0:
        kept[last], last = True, int(before[last])
    return kept


def problems(sequence: Sequence) -> list[str]:
    """What is odd about a sequence without reading its images, in plain words: loader's notes, time, missing poses."""
    found = list(getattr(sequence, "notes", ()))
    steps = np.diff(sequence.timestamps())
    forward = steps[steps > 0]
    usual = float(np.median(forward)) if len(forward) else 0.0
    unit = next((unit for least, unit in UNITS if usual >= least), None)
    if unit is not None:
        found.append(f"frames seem {usual:.3g} s apart: time stamps are read as seconds, these look like {unit}")
    counts = {
        "frames repeat the time of the one before": int((steps == 0).sum()),
        "frames go backwards in time": int((steps < 0).sum()),
        f"gaps of more than {GAP_S:g} s between frames": 0 if unit else int((steps > GAP_S).sum()),
    }
    found += [f"{count} {what}" for what, count in counts.items() if count]
    kept = int(in_order(sequence.timestamps()).sum())
    if kept < LEAST_IN_ORDER * len(sequence):
        found.append(f"only {kept} of {len(sequence)} frames are of use, for time must move on from one to the next")
    return found
