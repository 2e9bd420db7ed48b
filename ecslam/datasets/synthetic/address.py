"""Addresses of the built-in rooms, e.g. ``synthetic/studio?noise=1&frames=300&size=1200x680``."""

from __future__ import annotations

import difflib
from dataclasses import dataclass, replace

from ...types import InputError
from ..addresses import BUILT_IN, ROOMS, SYNTHETIC, parse_options

MAX_SIDE, MAX_FRAMES = 4096, 100_000
MOST_READOUT_S, MOST_EXPOSURE = 1 / 30, 0.9
SWITCH = {"0": False, "1": True}
FORMS = "noise=0|1, frames=N, size=WxH, seed=N, readout=SECONDS, visitor=0|1, exposure=SHARE, calibration=FILE"


@dataclass(frozen=True)
class Address:
    """Which room to render and how. frames: None for one round of the room's path. width, height: pixels. readout:
    seconds from an image's first row to its last (a rolling shutter). visitor: whether somebody walks through.
    exposure: by which share of it brightness swings, as that of a camera that exposes by itself. calibration: the
    file of the camera that it is taken to be seen by, though it is not."""

    room: str
    width: int = 640
    height: int = 480
    frames: int | None = None
    noise: bool = False
    seed: int = 0
    readout: float = 0.0
    visitor: bool = False
    exposure: float = 0.0
    calibration: str | None = None


def parse_address(address: str, defaults: Address | None = None) -> Address:
    """Read a room's name, with or without ``synthetic/`` and with options after ``?`` that override ``defaults``.

    The options are in ``FORMS``. Raises InputError for an unknown room, an unknown option or a value out of range.
    """
    name, _, query = address.removeprefix(SYNTHETIC).partition("?")
    if name not in ROOMS:
        near = difflib.get_close_matches(name, ROOMS, 1, 0.4)
        hint = f"did you mean {SYNTHETIC}{near[0]}?" if near else f"choose from {', '.join(BUILT_IN)}"
        raise InputError(f"{SYNTHETIC}{name}: no such built-in room; {hint}")
    out = replace(defaults or Address(name), room=name)
    for key, value in parse_options(query):
        out = _apply(out, key, value, address)
    return check(out)


def check(address: Address) -> Address:
    """The address itself. Raises InputError where image size, number of frames or seed cannot be used."""
    where = SYNTHETIC + address.room
    if not (16 <= address.width <= MAX_SIDE and 16 <= address.height <= MAX_SIDE):
        raise InputError(
            f"{where}: size {address.width}x{address.height} is out of range; use 16 to {MAX_SIDE} pixels a side"
        )
    if address.frames is not None and not 1 <= address.frames <= MAX_FRAMES:
        raise InputError(f"{where}: frames={address.frames} is out of range; use 1 to {MAX_FRAMES}")
    if address.seed < 0:
        raise InputError(f"{where}: seed={address.seed} is negative; use 0 or more")
    if not 0 <= address.readout <= MOST_READOUT_S:
        raise InputError(f"{where}: readout={address.readout:g} is out of range; use 0 to {MOST_READOUT_S:g} seconds")
    if not 0 <= address.exposure <= MOST_EXPOSURE:
        raise InputError(f"{where}: exposure={address.exposure:g} is out of range; use 0 to {MOST_EXPOSURE:g}")
    return address


def _apply(address: Address, key: str, value: str, source: str) -> Address:
    try:
        if key == "noise":
            return replace(address, noise=SWITCH[value])
        if key == "visitor":
            return replace(address, visitor=SWITCH[value])
        if key == "frames":
            return replace(address, frames=int(value))
        if key == "seed":
            return replace(address, seed=int(value))
        if key == "readout":
            return replace(address, readout=float(value))
        if key == "exposure":
            return replace(address, exposure=float(value))
        if key == "calibration":
            return replace(address, calibration=value)
        if key == "size":
            width, height = value.split("x")
            return replace(address, width=int(width), height=int(height))
    except (ValueError, KeyError):
        raise InputError(f"{source}: cannot read {key}={value}; write {FORMS}") from None
    raise InputError(f"{source}: unknown option {key!r}; the options are {FORMS}")
