"""The studio flat: one room of 6 x 5 x 2.7 m to sleep, read, work and sit in."""

from __future__ import annotations

import numpy as np

from . import fixtures as fix
from . import furniture as fur
from . import things
from .path import Waypoint
from .rooms import Room, box, daylight, lamp
from .shapes import Paint, Shape, block, place

WIDTH, DEPTH, HEIGHT = 6.0, 5.0, 2.7
FRAMES = 300
LINEN = Paint("fabric", (0.96, 0.94, 0.90), 0.4)


def build() -> Room:
    """Bed and window in the east, desk and bookcase in the north, sofa in the south, wardrobe and door in the west."""
    reach = box((0, 0, 0), (WIDTH, DEPTH, HEIGHT))
    lights = (
        daylight((WIDTH - 0.05, 2.3, 1.55), (-1, 0, 0), 1.7, 1.35, 7.0, reach),
        daylight((2.1, DEPTH - 0.03, 1.6), (0, -1, 0), 1.1, 1.2, 3.5, reach),
        lamp((2.9, 2.4, 2.25), 2.2, reach, 0.2),
        lamp((0.45, 0.5, 1.46), 0.7, reach, 0.1),
        lamp((4.76, 4.8, 0.83), 0.3, reach, 0.06),
    )
    interior = np.array([[-0.055, -0.055, -0.05], [WIDTH + 0.05, DEPTH + 0.05, HEIGHT + 0.05]])
    shapes = (*_shell(), *_north(), *_east(), *_south(), *_west(), *_middle())
    return Room(shapes, lights, interior, _path(), FRAMES)


def _shell() -> list[Shape]:
    holes = {
        "east": (fix.Opening(1.45, 3.15, 0.88, 2.22),),
        "north": (fix.Opening(1.5, 2.7, 1.0, 2.2),),
    }
    sage = Paint("plaster", (0.80, 0.88, 0.82), 1.6)
    walls = fix.Walls(
        north=Paint("plaster", (0.97, 0.93, 0.86), 1.6),
        east=Paint("foliage", (0.97, 0.98, 0.95), 1.1),
        south=Paint("bricks", (0.98, 0.93, 0.90), 1.15),
        west=sage,
        openings=holes,
    )
    return fix.shell((0, 0), (WIDTH, DEPTH), HEIGHT, walls, Paint("planks", (0.88, 0.66, 0.46), 1.9))


def _north() -> list[Shape]:
    curtains = Paint("curtain", (0.92, 0.80, 0.58), 0.6)
    return [
        *place(fix.window(1.2, 1.2, 1.0, curtains), 2.1, DEPTH),
        *place(fur.desk(4), 2.1, DEPTH - 0.16),
        *place(fur.office_chair(Paint("fabric", (0.72, 0.36, 0.28), 0.4)), 2.0, DEPTH - 0.95, 0, 200),
        *place(fur.bookcase(3, 6, 11), 3.83, DEPTH),
        *place(fix.picture("botanic", 0.5, 0.66, 1.6), 0.75, DEPTH),
        *place(fur.cupboard(0.9, 0.8, 0.42, 2, 2, things.OAK, (0.80, 0.55, 0.36)), 0.62, DEPTH),
        *place(things.ornament(0, np.random.default_rng(1)), 0.35, DEPTH - 0.2, 0.8),
        *place(things.ornament(1, np.random.default_rng(2)), 0.62, DEPTH - 0.22, 0.8),
        *place(
            things.plant(0.45, 9, np.random.default_rng(3), Paint("tiles", (0.9, 0.7, 0.55), 0.3)),
            0.9,
            DEPTH - 0.22,
            0.8,
        ),
    ]


def _east() -> list[Shape]:
    curtains = Paint("curtain", (0.56, 0.68, 0.72), 0.6)
    return [
        *place(fix.window(1.7, 1.34, 0.88, curtains), WIDTH, 2.3, 0, -90),
        *place(fix.radiator(1.1), WIDTH, 2.3, 0, -90),
        *place(fur.bed(1.05, Paint("quilt", repeat_m=1.0), LINEN), 5.43, DEPTH),
        *place(fur.nightstand((0.75, 0.45, 0.38)), 4.70, DEPTH),
        *place(things.plant(1.5, 22, np.random.default_rng(8), Paint("wicker", repeat_m=0.35)), 5.5, 0.5),
        *place(fix.picture("sunset", 0.7, 0.6, 1.65), WIDTH, 4.2, 0, -90),
        *place(fix.picture("waves", 0.5, 0.7, 1.55), WIDTH, 0.62, 0, -90),
    ]


def _south() -> list[Shape]:
    fabric = Paint("fabric", (0.36, 0.50, 0.56), 0.45)
    accents = (
        Paint("knit", (0.90, 0.72, 0.36), 0.25),
        Paint("circles", repeat_m=0.42),
        Paint("knit", (0.80, 0.42, 0.34), 0.25),
    )
    return [
        *place(fur.sofa(2.1, fabric, 2, accents), 2.9, 0.02, 0, 180),
        *place(fix.picture("alps", 1.1, 0.75, 1.62, things.WALNUT), 2.9, 0, 0, 180),
        *place(fix.picture("blocks", 0.5, 0.5, 1.72), 4.0, 0, 0, 180),
        *place(fix.picture("skyline", 0.5, 0.64, 1.62), 1.75, 0, 0, 180),
        *place(things.floor_lamp(), 0.45, 0.5),
        *place(fur.table(0.5, 0.5, 0.5, things.OAK), 4.32, 0.12, 0, 180),
        *place(things.table_lamp(), 4.4, 0.32, 0.5),
        *place(things.books(0.2, 0.22, 0.15, np.random.default_rng(5)), 4.1, 0.5, 0.5),
    ]


def _west() -> list[Shape]:
    return [
        *place(fix.door(0.9, Paint("door", (0.93, 0.83, 0.70), 0.0)), 0, 1.55, 0, 90),
        *place(fur.cupboard(1.3, 2.1, 0.58, 3, 1, things.WHITE, (0.93, 0.90, 0.84)), 0, 3.3, 0, 90),
        *place(fix.clock(2.35), 0, 1.55, 0, 90),
        *place([block((-0.3, -0.45, 2.1), (0.3, -0.05, 2.38), Paint("wicker", repeat_m=0.35), 0.02)], 0, 3.3, 0, 90),
    ]


def _middle() -> list[Shape]:
    return [
        *place(fur.rug(2.5, 1.7, "oriental"), 2.9, 1.75),
        *place(fur.low_table(6), 2.9, 1.75),
        *place(things.pendant(0.32, (0.85, 0.6, 0.35)), 2.9, 2.4, HEIGHT),
    ]


def _path() -> tuple[Waypoint, ...]:
    """Once around the low table, looking across it."""
    out = []
    for k in range(12):
        a = np.radians(30 * k - 150)
        x, y = 3.0 + 1.0 * np.cos(a), 2.55 + 0.72 * np.sin(a)
        out.append(
            Waypoint(float(x), float(y), 1.5 + 0.1 * float(np.sin(2 * a)), 30 * k + 50, -13 + 6 * float(np.cos(3 * a)))
        )
    return tuple(out)
