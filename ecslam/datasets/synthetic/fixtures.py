"""What belongs to the building: walls with openings, windows, doors, pictures, kitchen and bath.

Pieces that hang on a wall have the wall's surface at y = 0, the room at y < 0, and x along the wall from the middle.
"""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence as Many
from dataclasses import dataclass, replace

import numpy as np

from .furniture import cupboard
from .shapes import Paint, Shape, Vec, ball, block, can, pillar, place, rod
from .things import BRASS, DARK, OAK, STEEL, WHITE, upright

SKIN_M = 0.06
DOOR_HEIGHT_M = 2.05


@dataclass(frozen=True)
class Opening:
    """A hole in a wall: from ``start`` to ``end`` metres along it, between two heights."""

    start: float
    end: float
    low: float = 0.0
    high: float = DOOR_HEIGHT_M


@dataclass(frozen=True)
class Walls:
    """Finish and openings of a room's four walls. Openings are measured along +x (north, south) or +y (east, west)."""

    north: Paint
    east: Paint
    south: Paint
    west: Paint
    openings: Mapping[str, tuple[Opening, ...]]


def shell(
    low: tuple[float, float], high: tuple[float, float], height: float, walls: Walls, floor: Paint
) -> list[Shape]:
    """Floor, ceiling, four walls and skirting of a rectangular room with the given inner corners."""
    (x0, y0), (x1, y1) = low, high
    t = SKIN_M
    parts = [
        block((x0 - t, y0 - t, -0.1), (x1 + t, y1 + t, 0), floor),
        block((x0 - t, y0 - t, height), (x1 + t, y1 + t, height + 0.1), Paint("plaster", (0.98, 0.97, 0.95), 2.0)),
    ]
    for side, paint in (("north", walls.north), ("south", walls.south), ("east", walls.east), ("west", walls.west)):
        openings = walls.openings.get(side, ())
        along_x = side in ("north", "south")
        a, b = (x0, x1) if along_x else (y0, y1)
        face = {"north": y1, "south": y0, "east": x1, "west": x0}[side]
        out = 1.0 if side in ("north", "east") else -1.0
        for start, end, bottom, top in _pieces(a - t, b + t, height, openings):
            parts.append(_slab(along_x, start, end, bottom, top, face, face + out * t, paint))
            if bottom == 0:
                skirting = _slab(along_x, max(start, a), min(end, b), 0, 0.07, face, face - out * 0.012, WHITE)
                parts.append(skirting)
    return parts


def _pieces(a: float, b: float, height: float, openings: Many[Opening]) -> list[tuple[float, float, float, float]]:
    """Rectangles (start, end, bottom, top) that make up a wall around its openings."""
    out, at = [], a
    for hole in sorted(openings, key=lambda o: o.start):
        out.append((at, hole.start, 0.0, height))
        if hole.low > 0:
            out.append((hole.start, hole.end, 0.0, hole.low))
        if hole.high < height:
            out.append((hole.start, hole.end, hole.high, height))
        at = hole.end
    out.append((at, b, 0.0, height))
    return [p for p in out if p[1] - p[0] > 1e-6]


def _slab(along_x: bool, a: float, b: float, z0: float, z1: float, face: float, back: float, paint: Paint) -> Shape:
    """A piece of wall whose texture continues across the pieces of the same wall."""
    low: Vec = (a, face, z0) if along_x else (face, a, z0)
    high: Vec = (b, back, z1) if along_x else (back, b, z1)
    if paint.repeat_m > 0:
        shift = ((a + b) / 2 / paint.repeat_m % 1, -(z0 + z1) / 2 / paint.repeat_m % 1)
        paint = replace(paint, shift=shift)
    return block(low, high, paint)


def window(width: float, height: float, sill: float, curtains: Paint | None) -> list[Shape]:
    """Panes with the view outside, a frame with a cross, a sill and curtains on a rail."""
    x, top = width / 2, sill + height
    bar = 0.045
    parts = [
        block((-x, 0.045, sill), (x, SKIN_M, top), Paint("outdoors", repeat_m=0.0, glow=1.0)),
        block((-x - 0.06, -0.14, sill - 0.03), (x + 0.06, 0.05, sill), WHITE, 0.01),
        block((-bar / 2, 0.02, sill), (bar / 2, 0.05, top), WHITE),
        block((-x, 0.02, sill + height * 0.62), (x, 0.05, sill + height * 0.62 + bar), WHITE),
    ]
    for s in (-1, 1):
        parts.append(block((s * x, -0.015, sill), (s * (x - bar), 0.05, top), WHITE))
        parts.append(block((-x, -0.015, top if s > 0 else sill + bar), (x, 0.05, top - bar if s > 0 else sill), WHITE))
    if curtains is not None:
        parts.append(pillar((-x - 0.45, -0.09, top + 0.13), (x + 0.45, -0.09, top + 0.13), 0.012, BRASS))
        for s in (-1, 1):
            for k in range(6):
                at = s * (x - 0.02 + k * 0.075)
                depth = -0.075 - 0.03 * (k % 2)
                parts.append(rod((at, depth, 0.09), (at, depth, top + 0.07), 0.048, curtains))
    return parts


def door(width: float, paint: Paint) -> list[Shape]:
    """A closed door in its frame, with a handle."""
    x, h = width / 2, DOOR_HEIGHT_M
    return [
        block((-x, -0.025, 0), (x, 0, h), paint),
        *door_frame(width, 0.0),
        rod((x - 0.10, -0.03, 1.02), (x - 0.10, -0.07, 1.02), 0.01, STEEL),
        rod((x - 0.10, -0.07, 1.02), (x - 0.22, -0.07, 1.02), 0.01, STEEL),
    ]


def door_frame(width: float, depth: float) -> list[Shape]:
    """Architrave around an opening; it lines the wall to ``depth`` metres behind the surface."""
    x, h = width / 2, DOOR_HEIGHT_M
    parts = [block((s * x, -0.035, 0), (s * (x + 0.08), depth, h + 0.08), WHITE) for s in (-1, 1)]
    return [*parts, block((-x, -0.035, h), (x, depth, h + 0.08), WHITE)]


def picture(name: str, width: float, height: float, middle: float = 1.55, frame: Paint = DARK) -> list[Shape]:
    """A framed picture with a white mat; ``middle`` is the height of its centre."""
    x, z = width / 2, height / 2
    return [
        block((-x, -0.022, middle - z), (x, 0, middle + z), frame),
        block((-x + 0.015, -0.025, middle - z + 0.015), (x - 0.015, -0.02, middle + z - 0.015), WHITE),
        block((-x + 0.05, -0.028, middle - z + 0.05), (x - 0.05, -0.024, middle + z - 0.05), Paint(name, repeat_m=0.0)),
    ]


def wall_shelf(width: float, height: float, things: Many[Shape], wood: Paint = OAK) -> list[Shape]:
    """A board on two brackets at ``height`` with things standing on it."""
    x = width / 2
    brackets = [
        block((s * x * 0.7 - 0.012, -0.18, height - 0.09), (s * x * 0.7 + 0.012, 0, height), DARK) for s in (-1, 1)
    ]
    return [block((-x, -0.22, height), (x, 0, height + 0.025), wood), *brackets, *place(things, 0, 0, height + 0.025)]


def clock(height: float) -> list[Shape]:
    """A round wall clock."""
    return [
        pillar((0, -0.035, height), (0, 0, height), 0.16, Paint("metal", (0.3, 0.3, 0.33))),
        pillar((0, -0.038, height), (0, -0.03, height), 0.145, Paint("dial", repeat_m=0.0)),
    ]


def radiator(width: float) -> list[Shape]:
    """A column radiator under a window."""
    count = max(3, round(width / 0.09))
    at = [(k - (count - 1) / 2) * width / count for k in range(count)]
    bars = [block((x - 0.032, -0.14, 0.12), (x + 0.032, -0.04, 0.68), WHITE, 0.03) for x in at]
    return [*bars, block((-width / 2, -0.11, 0.16), (width / 2, -0.07, 0.20), WHITE)]


def kitchen(width: float, seed: int) -> list[Shape]:
    """A kitchen line: base units, worktop with sink, hob and things, tiled back, wall units, extractor."""
    rng = np.random.default_rng(seed)
    x = width / 2
    units = max(2, round(width / 0.6))
    parts = cupboard(width, 0.88, 0.58, units, 1, WHITE, (0.36, 0.50, 0.52))
    parts += [
        block((-x, -0.63, 0.88), (x, 0, 0.92), Paint("marble", (0.95, 0.93, 0.9), 0.9)),
        block((-x, -0.008, 0.92), (x, 0, 1.45), Paint("tiles", (0.93, 0.95, 0.93), 0.5)),
        block((-x + 0.35, -0.52, 0.92), (-x + 0.95, -0.1, 0.925), Paint("metal", (0.6, 0.62, 0.65))),
        rod((-x + 0.65, -0.08, 0.92), (-x + 0.65, -0.08, 1.18), 0.013, STEEL),
        rod((-x + 0.65, -0.08, 1.18), (-x + 0.65, -0.26, 1.16), 0.011, STEEL),
        block((x - 1.0, -0.56, 0.92), (x - 0.4, -0.06, 0.928), DARK),
        *(
            pillar(
                (x - 0.84 + a * 0.28, -0.42 + b * 0.22, 0.926),
                (x - 0.84 + a * 0.28, -0.42 + b * 0.22, 0.931),
                0.085,
                Paint("metal", (0.35, 0.33, 0.33)),
            )
            for a in (0, 1)
            for b in (0, 1)
        ),
        can((x - 0.84, -0.2, 0.93), 0.10, 0.11, 0.13, Paint("metal", (0.85, 0.4, 0.3))),
        block((x - 1.0, -0.36, 1.55), (x - 0.4, 0, 1.66), STEEL),
        block((x - 0.82, -0.26, 1.66), (x - 0.58, 0, 2.25), STEEL),
        block((-0.18, -0.42, 0.92), (0.12, -0.18, 0.94), Paint("wood", (0.8, 0.6, 0.4), 0.4), 0.008),
    ]
    parts += place(cupboard(width - 1.1, 0.80, 0.34, max(2, units - 2), 1, WHITE, (0.90, 0.88, 0.83)), -0.53, 0, 1.45)
    for k in range(5):
        tint = (float(rng.uniform(0.5, 1)), float(rng.uniform(0.4, 0.9)), float(rng.uniform(0.3, 0.8)))
        r, h = float(rng.uniform(0.035, 0.055)), float(rng.uniform(0.10, 0.24))
        parts.append(can((-0.18 + 0.12 * k, -0.09, 0.92), r, r * 0.9, h, Paint("marble", tint, 0.2)))
    for k in range(3):
        parts.append(
            ball(
                (-0.1 + 0.07 * k, -0.3 + 0.03 * k, 0.972),
                (0.034, 0.034, 0.034),
                Paint("cork", (0.9, 0.3 + 0.2 * k, 0.2), 0.2),
            )
        )
    return parts


def fridge() -> list[Shape]:
    """A tall fridge with notes on its door."""
    notes = [
        block((-0.2, -0.667, 1.25), (0.02, -0.66, 1.55), Paint("atlas", repeat_m=0.0)),
        block((0.06, -0.667, 1.32), (0.2, -0.66, 1.50), Paint("circles", repeat_m=0.0)),
    ]
    return [
        block((-0.3, -0.62, 0.03), (0.3, 0, 1.85), Paint("metal", (0.75, 0.8, 0.82), 0.8), 0.012),
        block((-0.3, -0.66, 0.05), (0.3, -0.62, 0.70), Paint("metal", (0.85, 0.88, 0.9), 0.8), 0.012),
        block((-0.3, -0.66, 0.71), (0.3, -0.62, 1.84), Paint("metal", (0.85, 0.88, 0.9), 0.8), 0.012),
        rod((0.25, -0.69, 0.80), (0.25, -0.69, 1.15), 0.012, STEEL),
        rod((0.25, -0.69, 0.40), (0.25, -0.69, 0.62), 0.012, STEEL),
        *notes,
    ]


def bathtub(width: float = 1.7) -> list[Shape]:
    """A built-in bath with water and a towel over its side."""
    x = width / 2
    return [
        block((-x, -0.75, 0), (x, -0.68, 0.58), WHITE, 0.02),
        block((-x, -0.07, 0), (x, 0, 0.58), WHITE, 0.02),
        block((-x, -0.75, 0), (-x + 0.08, 0, 0.58), WHITE, 0.02),
        block((x - 0.08, -0.75, 0), (x, 0, 0.58), WHITE, 0.02),
        block((-x, -0.75, 0), (x, 0, 0.30), Paint("marble", (0.62, 0.85, 0.88), 0.9)),
        rod((x - 0.12, -0.3, 0.75), (x - 0.3, -0.3, 0.72), 0.016, STEEL),
        rod((x - 0.04, -0.3, 0.58), (x - 0.12, -0.3, 0.75), 0.016, STEEL),
        block((-0.3, -0.775, 0.18), (0.15, -0.66, 0.60), Paint("stripes", (0.55, 0.75, 0.85), 0.5), 0.012),
    ]


def basin() -> list[Shape]:
    """A washbasin on a cabinet, with tap, bottles and a mirror."""
    return [
        *cupboard(0.7, 0.78, 0.44, 2, 1, OAK, (0.85, 0.72, 0.55)),
        block((-0.36, -0.48, 0.78), (0.36, 0, 0.86), WHITE, 0.03),
        ball((0, -0.26, 0.862), (0.22, 0.15, 0.012), Paint("marble", (0.75, 0.85, 0.88), 0.4)),
        rod((0, -0.06, 0.86), (0, -0.06, 1.0), 0.014, STEEL),
        rod((0, -0.06, 1.0), (0, -0.18, 0.99), 0.012, STEEL),
        can((0.27, -0.1, 0.86), 0.03, 0.03, 0.13, Paint("stripes", (0.9, 0.6, 0.4), 0.2)),
        can((-0.28, -0.1, 0.86), 0.035, 0.025, 0.16, Paint("marble", (0.5, 0.75, 0.6), 0.2)),
        *picture("waves", 0.75, 0.8, 1.55, STEEL),
    ]


def toilet() -> list[Shape]:
    """A toilet with a cistern."""
    return [
        block((-0.19, -0.18, 0.38), (0.19, 0, 0.80), WHITE, 0.03),
        can((0, -0.42, 0), 0.13, 0.19, 0.38, WHITE),
        ball((0, -0.43, 0.40), (0.2, 0.26, 0.03), Paint("plain", (0.55, 0.42, 0.34), 0.4)),
    ]


def coats(colors: Many[Vec]) -> list[Shape]:
    """A board with hooks, hanging coats and shoes below."""
    width = 0.26 * len(colors)
    parts = [block((-width / 2, -0.025, 1.62), (width / 2, 0, 1.74), upright(OAK))]
    for k, tint in enumerate(colors):
        x = (k - (len(colors) - 1) / 2) * 0.26
        low = 0.72 + 0.12 * (k % 3)
        parts.append(rod((x, -0.02, 1.68), (x, -0.08, 1.69), 0.012, BRASS))
        parts.append(block((x - 0.115, -0.20, low), (x + 0.115, -0.03, 1.64), Paint("fabric", tint, 0.4), 0.07))
        for s in (-1, 1):
            shoe = Paint("fabric", (tint[2] * 0.6, tint[1] * 0.5, tint[0] * 0.5), 0.2)
            parts.append(block((x + s * 0.055 - 0.042, -0.32, 0.0), (x + s * 0.055 + 0.042, -0.05, 0.10), shoe, 0.04))
    return parts


def bench(width: float, cushion: Paint) -> list[Shape]:
    """A bench with a cushion and baskets below."""
    x = width / 2
    parts = [
        block((-x, -0.38, 0.38), (x, 0, 0.42), OAK),
        block((-x + 0.02, -0.37, 0.42), (x - 0.02, -0.02, 0.48), cushion, 0.028),
        *(block((s * x, -0.36, 0), (s * (x - 0.04), -0.02, 0.38), upright(OAK)) for s in (-1, 1)),
    ]
    count = max(1, int((width - 0.1) / 0.42))
    for k in range(count):
        at = (k - (count - 1) / 2) * (width - 0.1) / count
        parts.append(block((at - 0.17, -0.34, 0), (at + 0.17, -0.04, 0.28), Paint("wicker", repeat_m=0.3), 0.02))
    return parts
