"""The gallery: a passage 2 m wide around a block of 4.8 x 3.4 m, with pictures, benches and doors, walked around once.

Nothing that is seen on the way is seen again before the walk has come full circle, after 24 m.
"""

from __future__ import annotations

import numpy as np

from . import fixtures as fix
from . import furniture as fur
from . import things
from .path import Waypoint
from .rooms import Room, box, daylight, lamp
from .shapes import Light, Paint, Shape, block, place

LENGTH, DEPTH, HEIGHT, WIDTH = 8.8, 7.4, 2.6, 2.0
FRAMES = 1600
WEST, EAST, SOUTH, NORTH = WIDTH, LENGTH - WIDTH, WIDTH, DEPTH - WIDTH  # the block's walls
CORNERS = ((1.0, 1.0), (LENGTH - 1.0, 1.0), (LENGTH - 1.0, DEPTH - 1.0), (1.0, DEPTH - 1.0))
LAMPS = tuple((x, y) for x in (1.0, 3.3, 5.5, 7.8) for y in (1.0, 3.7, 6.4) if y != 3.7 or x in (1.0, 7.8))
# share of a passage, yaw off its direction and pitch in degrees
GLANCES = ((0.06, 22, -9), (0.24, -14, -12), (0.42, 16, -8), (0.6, -18, -12), (0.78, 8, -9), (0.94, 48, -10))
FIRST = 3  # the glance that the walk begins with


def build() -> Room:
    """Four passages, each with colours and pictures of its own."""
    interior = np.array([[-0.055, -0.055, -0.05], [LENGTH + 0.055, DEPTH + 0.055, HEIGHT + 0.05]])
    shapes = (*_shell(), *_south(), *_east(), *_north(), *_west(), *_floor(), *_ceiling())
    return Room(shapes, _lights(), interior, _path(), FRAMES)


def _lights() -> tuple[Light, ...]:
    reach = box((0, 0, 0), (LENGTH, DEPTH, HEIGHT))
    window = daylight((LENGTH - 0.03, 3.7, 1.5), (-1, 0, 0), 1.0, 1.5, 2.0, reach)
    return (window, *(lamp((x, y, HEIGHT - 0.45), 0.75, reach) for x, y in LAMPS))


def _shell() -> list[Shape]:
    walls = fix.Walls(
        north=Paint("foliage", (0.93, 0.95, 0.90), 1.0),
        east=Paint("plaster", (0.90, 0.86, 0.78), 1.5),
        south=Paint("stripes", (0.95, 0.86, 0.74), 1.1),
        west=Paint("bricks", repeat_m=1.1),
        openings={"east": (fix.Opening(3.2, 4.2, 0.75, 2.25),)},
    )
    middle = block((WEST, SOUTH, 0), (EAST, NORTH, HEIGHT), Paint("plaster", (0.93, 0.90, 0.84), 1.7))
    return [*fix.shell((0, 0), (LENGTH, DEPTH), HEIGHT, walls, Paint("planks", (0.72, 0.52, 0.38), 1.9)), middle]


def _south() -> list[Shape]:
    rng = np.random.default_rng(21)
    return [
        *place(fix.picture("alps", 0.9, 0.6), 2.3, 0, 0, 180),
        *place(fix.picture("waves", 0.5, 0.7), 4.0, 0, 0, 180),
        *place(fix.picture("atlas", 0.9, 0.65), 5.4, 0, 0, 180),
        *place(fix.picture("sunset", 0.6, 0.6), 7.8, 0, 0, 180),
        *place(fix.door(0.9, Paint("door", (0.62, 0.46, 0.36), 0.0)), 6.6, 0, 0, 180),
        *place(fur.cupboard(0.9, 0.8, 0.28, 2, 2, things.WALNUT, (0.66, 0.48, 0.34)), 4.0, 0.02, 0, 180),
        *place(things.ornament(0, rng), 3.8, 0.16, 0.8),
        *place(things.ornament(3, rng), 4.25, 0.16, 0.8),
        *place(fix.picture("circles", 0.7, 0.7), 2.9, SOUTH),
        *place(fix.bench(0.95, Paint("plaid", repeat_m=0.4)), 4.5, SOUTH - 0.02),
        *place(fix.clock(2.0), 4.5, SOUTH),
        *place(fix.picture("botanic", 0.6, 0.75), 6.1, SOUTH),
    ]


def _east() -> list[Shape]:
    rng = np.random.default_rng(22)
    return [
        *place(fix.window(1.0, 1.5, 0.75, Paint("curtain", (0.92, 0.80, 0.58), 0.6)), LENGTH, 3.7, 0, -90),
        *place(fix.radiator(0.8), LENGTH, 3.7, 0, -90),
        *place(fix.picture("sunset", 0.6, 0.6), LENGTH, 1.5, 0, -90),
        *place(fix.picture("alps", 0.9, 0.6), LENGTH, 6.1, 0, -90),
        *place(things.plant(1.3, 18, rng, Paint("wicker", repeat_m=0.35)), LENGTH - 0.4, 0.4),
        *place(things.plant(1.1, 14, rng, Paint("terrazzo", (0.9, 0.7, 0.6), 0.4)), LENGTH - 0.4, DEPTH - 0.4),
        *place(fix.picture("skyline", 0.7, 0.8), EAST, 2.9, 0, 90),
        *place(fur.cupboard(1.2, 0.9, 0.3, 3, 1, things.OAK, (0.80, 0.55, 0.36)), EAST, 4.3, 0, 90),
        *place(things.table_lamp(), EAST + 0.15, 4.1, 0.9),
    ]


def _north() -> list[Shape]:
    return [
        *place(fix.picture("circles", 0.6, 0.6, 1.55, things.BRASS), 1.2, DEPTH),
        *place(fix.picture("skyline", 0.6, 0.75, 1.55, things.BRASS), 3.1, DEPTH),
        *place(fix.picture("botanic", 0.5, 0.66, 1.55, things.BRASS), 6.2, DEPTH),
        *place(fix.picture("blocks", 0.6, 0.6, 1.55, things.BRASS), 7.9, DEPTH),
        *place(fix.door(0.9, Paint("door", (0.95, 0.84, 0.70), 0.0)), 4.7, DEPTH),
        *place(fur.chair(things.OAK, Paint("fabric", (0.4, 0.55, 0.6), 0.3)), 2.2, DEPTH - 0.03),
        *place(things.floor_lamp(), 0.4, DEPTH - 0.4),
        *place(fix.picture("waves", 0.6, 0.8), 6.2, NORTH, 0, 180),
        *place(fix.bench(0.95, Paint("knit", (0.80, 0.42, 0.34), 0.25)), 4.4, NORTH + 0.02, 0, 180),
        *place(fix.picture("atlas", 0.8, 0.6), 2.8, NORTH, 0, 180),
    ]


def _west() -> list[Shape]:
    return [
        *place(fix.door(0.9, Paint("door", (0.80, 0.70, 0.52), 0.0)), 0, 5.0, 0, 90),
        *place(fur.bookcase(3, 5, 31, things.OAK), 0, 2.8, 0, 90),
        *place(fix.picture("atlas", 0.9, 0.7), 0, 1.0, 0, 90),
        *place(fix.picture("blocks", 0.6, 0.6), WEST, 4.5, 0, -90),
        *place(fix.coats(((0.30, 0.36, 0.50), (0.62, 0.30, 0.26), (0.80, 0.68, 0.42))), WEST, 2.9, 0, -90),
    ]


def _floor() -> list[Shape]:
    along = [("kilim", 2.9, 1.0), ("oriental", 6.0, 1.0), ("oriental", 2.9, DEPTH - 1), ("kilim", 6.0, DEPTH - 1)]
    across = [("kilim", LENGTH - 1, 3.7), ("oriental", 1.0, 3.7)]
    rugs = [place(fur.rug(1.0, 1.75, name), x, y, 0, 90) for name, x, y in along]
    return [s for rug in (*rugs, *(place(fur.rug(1.0, 1.75, name), x, y) for name, x, y in across)) for s in rug]


def _ceiling() -> list[Shape]:
    return [s for x, y in LAMPS for s in place(things.pendant(0.28, (0.85, 0.65, 0.4)), x, y, HEIGHT)]


def _path() -> tuple[Waypoint, ...]:
    """Around the block from the middle of the south passage, looking ahead, with a glance to either side."""
    out = []
    for k in range(5):
        here, there = np.array(CORNERS[k % 4]), np.array(CORNERS[(k + 1) % 4])
        for i, (share, glance, pitch) in enumerate(GLANCES):
            x, y = here + share * (there - here)
            out.append(Waypoint(float(x), float(y), 1.5 + 0.06 * float(np.sin(1.3 * i)), 90 * k + glance, pitch))
    return tuple(out[FIRST : FIRST - len(GLANCES)])
