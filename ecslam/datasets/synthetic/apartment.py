"""The apartment: living room with kitchen, study, bedroom, hall and bathroom, joined in a ring by door openings."""

from __future__ import annotations

import numpy as np

from . import fixtures as fix
from . import furniture as fur
from . import things
from .path import Waypoint
from .rooms import Room, box, daylight, lamp
from .shapes import Light, Paint, Shape, block, place

FRAMES = 1600
HEIGHT = 2.6
LIVING = ((0.0, 0.0), (5.2, 4.0))
STUDY = ((5.32, 0.0), (8.6, 3.2))
BEDROOM = ((5.32, 3.32), (8.6, 7.0))
HALL = ((2.6, 4.12), (5.2, 7.0))
BATH = ((0.0, 4.12), (2.48, 7.0))
PARQUET = Paint("planks", (0.80, 0.62, 0.46), 1.9)
LINEN = Paint("fabric", (0.95, 0.93, 0.90), 0.4)


def build() -> Room:
    """All five rooms and one walk through them."""
    shapes = (*_doorways(), *_living(), *_study(), *_bedroom(), *_hall(), *_bath())
    interior = np.array([[-0.055, -0.055, -0.05], [8.65, 7.05, HEIGHT + 0.05]])
    return Room(shapes, _lights(), interior, _path(), FRAMES)


def _reach(room: tuple[tuple[float, float], tuple[float, float]], far: float = 0.0):
    (x0, y0), (x1, y1) = room
    return box((x0 - far, y0 - far, 0), (x1 + far, y1 + far, HEIGHT))


def _lights() -> tuple[Light, ...]:
    return (
        daylight((1.6, 0.03, 1.6), (0, 1, 0), 1.3, 1.3, 7.0, _reach(LIVING, 1.0)),
        lamp((3.5, 1.7, 2.1), 2.4, _reach(LIVING, 1.0), 0.18),
        lamp((1.75, 2.75, 1.95), 1.1, _reach(LIVING), 0.1),
        daylight((8.57, 1.5, 1.6), (-1, 0, 0), 1.2, 1.2, 5.5, _reach(STUDY, 1.0)),
        lamp((6.8, 1.7, 2.2), 1.6, _reach(STUDY, 1.0), 0.18),
        daylight((7.85, 6.97, 1.6), (0, -1, 0), 0.9, 1.3, 4.0, _reach(BEDROOM, 1.0)),
        lamp((6.9, 5.2, 2.2), 1.7, _reach(BEDROOM, 1.0), 0.18),
        lamp((8.4, 4.30, 0.84), 0.25, _reach(BEDROOM), 0.06),
        lamp((3.9, 5.5, 2.15), 1.9, _reach(HALL, 1.0), 0.15),
        lamp((1.2, 5.5, 2.3), 1.9, _reach(BATH, 1.0), 0.2, (1.0, 0.93, 0.82)),
    )


def _doorways() -> list[Shape]:
    """Frames that line the four openings between rooms, and the bathroom's."""
    depth = 2 * fix.SKIN_M
    parts: list[Shape] = []
    for x, y, yaw in ((5.2, 1.6, -90.0), (6.5, 3.2, 0.0), (5.2, 5.1, -90.0), (3.8, 4.0, 0.0), (2.48, 5.5, -90.0)):
        parts += place(fix.door_frame(1.0, depth + 0.035), x, y, 0, yaw)
    return parts


def _living() -> list[Shape]:
    sofa = Paint("fabric", (0.62, 0.56, 0.50), 0.45)
    accents = (Paint("plaid", repeat_m=0.3), Paint("knit", (0.35, 0.52, 0.56), 0.25))
    curtains = Paint("curtain", (0.82, 0.62, 0.50), 0.6)
    holes = {
        "south": (fix.Opening(0.95, 2.25, 0.95, 2.25),),
        "east": (fix.Opening(1.1, 2.1),),
        "north": (fix.Opening(3.3, 4.3),),
    }
    cream = Paint("plaster", (0.97, 0.93, 0.85), 1.6)
    walls = fix.Walls(cream, Paint("stripes", (0.80, 0.88, 0.90), 1.2), Paint("bricks", repeat_m=1.15), cream, holes)
    chairs = [place(fur.chair(things.OAK, Paint("fabric", (0.85, 0.55, 0.35), 0.3)), x, y, 0, yaw)
              for x, y, yaw in ((1.45, 3.70, 0), (2.05, 3.70, 0), (1.45, 2.10, 180), (2.05, 2.10, 180))]  # fmt: skip
    return [
        *fix.shell(*LIVING, HEIGHT, walls, PARQUET),
        *place(fix.window(1.3, 1.3, 0.95, curtains), 1.6, 0, 0, 180),
        *place(fix.kitchen(2.5, 3), 0, 2.35, 0, 90),
        *place(fix.fridge(), 0, 0.66, 0, 90),
        *place(fur.table(1.3, 0.75, 0.75, things.WALNUT), 1.75, 3.25),
        *(shape for seat in chairs for shape in seat),
        *place(things.flowers(np.random.default_rng(4)), 1.75, 2.88, 0.75),
        *place(things.pendant(0.55, (0.80, 0.42, 0.30)), 1.75, 2.75, HEIGHT),
        *place(fix.picture("atlas", 0.9, 0.7, 1.55, things.OAK), 1.3, 4.0),
        *place(fix.picture("circles", 0.5, 0.5, 1.55), 2.3, 4.0),
        *place(fix.clock(1.95), 2.85, 4.0),
        *place(fur.bookcase(2, 6, 21, things.OAK), 4.76, 4.0),
        *place(fur.sofa(2.0, sofa, 2, accents), 3.65, 0.02, 0, 180),
        *place(fix.picture("sunset", 0.9, 0.7, 1.6), 3.3, 0, 0, 180),
        *place(fix.picture("botanic", 0.55, 0.7, 1.6), 4.25, 0, 0, 180),
        *place(fur.rug(2.2, 1.5, "kilim"), 3.55, 1.65),
        *place(fur.low_table(16), 3.55, 1.6),
        *place(fur.television(1.25, "alps"), 5.2, 2.86, 0, -90),
        *place(things.plant(1.3, 18, np.random.default_rng(18), Paint("terrazzo", (0.9, 0.8, 0.72), 0.4)), 4.86, 0.45),
        *place(things.pendant(0.38, (0.9, 0.75, 0.5)), 3.5, 1.7, HEIGHT),
    ]


def _study() -> list[Shape]:
    holes = {
        "west": (fix.Opening(1.1, 2.1),),
        "north": (fix.Opening(6.0, 7.0),),
        "east": (fix.Opening(0.9, 2.1, 1.0, 2.2),),
    }
    blue = Paint("plaster", (0.70, 0.79, 0.86), 1.6)
    walls = fix.Walls(blue, Paint("foliage", repeat_m=1.1), Paint("plaster", (0.93, 0.90, 0.84), 1.6), blue, holes)
    armchair = fur.sofa(0.88, Paint("fabric", (0.72, 0.42, 0.30), 0.4), 1, (Paint("knit", (0.9, 0.85, 0.7), 0.25),))
    return [
        *fix.shell(*STUDY, HEIGHT, walls, Paint("planks", (0.62, 0.44, 0.32), 1.9)),
        *place(fix.window(1.2, 1.2, 1.0, None), 8.6, 1.5, 0, -90),
        *place(fur.desk(7), 8.44, 1.5, 0, -90),
        *place(fur.office_chair(Paint("fabric", (0.30, 0.42, 0.48), 0.4)), 7.65, 1.6, 0, 75),
        *place(fur.bookcase(4, 6, 31), 6.75, 0, 0, 180),
        *place(armchair, 8.05, 3.1, 0, -22),
        *place(fix.picture("skyline", 0.7, 0.6, 1.65), 7.85, 3.2),
        *place(fur.cupboard(0.85, 0.85, 0.4, 2, 2, things.WALNUT, (0.62, 0.44, 0.32)), 5.32, 2.66, 0, 90),
        *place(things.ornament(1, np.random.default_rng(5)), 5.52, 2.5, 0.85),
        *place(things.plant(0.5, 9, np.random.default_rng(7), Paint("tiles", (0.6, 0.75, 0.7), 0.3)), 5.54, 2.8, 0.85),
        *place(fix.picture("waves", 0.5, 0.66, 1.6), 5.32, 0.5, 0, 90),
        *place(fix.picture("blocks", 0.55, 0.55, 1.65), 5.32, 2.66, 0, 90),
        *place(fur.rug(1.5, 1.2, "oriental"), 6.7, 1.75),
        *place(things.plant(1.2, 16, np.random.default_rng(9), Paint("wicker", repeat_m=0.35)), 8.2, 0.40),
        *place(things.pendant(0.28, (0.4, 0.55, 0.55)), 6.8, 1.7, HEIGHT),
    ]


def _bedroom() -> list[Shape]:
    holes = {
        "south": (fix.Opening(6.0, 7.0),),
        "west": (fix.Opening(4.6, 5.6),),
        "north": (fix.Opening(7.4, 8.3, 0.95, 2.25),),
    }
    rose = Paint("plaster", (0.93, 0.83, 0.78), 1.6)
    walls = fix.Walls(
        rose, Paint("stripes", (0.90, 0.80, 0.74), 1.2), rose, Paint("foliage", (1, 0.97, 0.95), 1.1), holes
    )
    return [
        *fix.shell(*BEDROOM, HEIGHT, walls, Paint("carpet", (0.78, 0.72, 0.64), 1.2)),
        *place(fix.window(0.9, 1.3, 0.95, None), 7.85, 7.0),
        *place(fix.radiator(0.8), 7.85, 7.0),
        *place(fur.bed(1.5, Paint("quilt", (1, 0.92, 0.88), 1.0), LINEN), 8.6, 5.35, 0, -90),
        *place(fur.nightstand((0.55, 0.65, 0.45)), 8.6, 4.28, 0, -90),
        *place(fur.nightstand((0.55, 0.65, 0.45)), 8.6, 6.42, 0, -90),
        *place(fix.picture("alps", 1.0, 0.66, 1.65), 8.6, 5.35, 0, -90),
        *place(fur.cupboard(1.4, 2.15, 0.58, 3, 1, things.OAK, (0.90, 0.80, 0.66)), 6.2, 7.0),
        *place(fur.cupboard(1.1, 0.85, 0.45, 2, 3, things.WALNUT, (0.70, 0.50, 0.38)), 7.85, 3.32, 0, 180),
        *place(fix.picture("circles", 0.7, 0.7, 1.5, things.BRASS), 7.85, 3.32, 0, 180),
        *place(things.table_lamp((0.8, 0.55, 0.5)), 8.15, 3.55, 0.85),
        *place(things.ornament(0, np.random.default_rng(2)), 7.5, 3.52, 0.85),
        *place(fix.picture("botanic", 0.5, 0.66, 1.6), 5.32, 6.0, 0, 90),
        *place(things.plant(1.0, 13, np.random.default_rng(12), Paint("marble", (0.85, 0.6, 0.5), 0.4)), 5.68, 3.70),
        *place(fur.rug(2.0, 1.3, "kilim"), 6.75, 5.3, 0, 90),
        *place(things.pendant(0.28, (0.9, 0.8, 0.7)), 6.9, 5.2, HEIGHT),
    ]


def _hall() -> list[Shape]:
    holes = {
        "south": (fix.Opening(3.3, 4.3),),
        "east": (fix.Opening(4.6, 5.6),),
        "west": (fix.Opening(5.0, 6.0),),
    }
    green = Paint("foliage", (0.92, 0.95, 0.86), 1.1)
    walls = fix.Walls(
        Paint("plaster", (0.90, 0.86, 0.76), 1.6), green, green, Paint("plaster", (0.72, 0.80, 0.74), 1.6), holes
    )
    return [
        *fix.shell(*HALL, HEIGHT, walls, Paint("terrazzo", repeat_m=1.3)),
        *place(fix.door(0.9, Paint("door", (0.50, 0.62, 0.60), 0.0)), 4.4, 7.0),
        *place(fix.coats([(0.72, 0.24, 0.2), (0.24, 0.34, 0.5), (0.85, 0.7, 0.4), (0.3, 0.42, 0.34)]), 3.28, 7.0),
        *place(fix.bench(0.95, Paint("plaid", repeat_m=0.4)), 5.2, 6.30, 0, -90),
        *place(fix.picture("atlas", 0.75, 0.6, 1.6, things.OAK), 5.2, 6.30, 0, -90),
        *place(fur.cupboard(0.66, 0.85, 0.3, 2, 1, things.OAK, (0.85, 0.75, 0.58)), 2.6, 4.52, 0, 90),
        *place(things.table_lamp(), 2.75, 4.52, 0.85),
        *place(fix.picture("sunset", 0.5, 0.5, 1.65), 2.6, 4.55, 0, 90),
        *place(fix.picture("waves", 0.45, 0.6, 1.6), 4.82, 4.12, 0, 180),
        *place(fix.picture("blocks", 0.5, 0.6, 1.6), 2.6, 6.5, 0, 90),
        *place(fix.clock(2.3), 3.28, 7.0),
        *place(fur.rug(1.4, 1.9, "oriental"), 3.9, 5.6),
        *place(things.pendant(0.3, (0.75, 0.5, 0.35)), 3.9, 5.5, HEIGHT),
        *place([block((-0.2, -0.5, 0), (0.2, -0.1, 0.34), Paint("wicker", repeat_m=0.35), 0.03)], 2.95, 6.25, 0, 90),
    ]


def _bath() -> list[Shape]:
    holes = {"east": (fix.Opening(5.0, 6.0),)}
    tile = Paint("tiles", (0.80, 0.90, 0.92), 0.8)
    walls = fix.Walls(
        tile, Paint("tiles", (0.95, 0.95, 0.92), 0.8), Paint("tiles", (0.62, 0.78, 0.80), 0.8), tile, holes
    )
    towels = [block((-0.02 - 0.3 * k, -0.07, 0.85), (0.22 - 0.3 * k, -0.02, 1.45), Paint("stripes", t, 0.4), 0.02)
              for k, t in enumerate(((0.9, 0.6, 0.4), (0.5, 0.7, 0.8)))]  # fmt: skip
    return [
        *fix.shell(*BATH, HEIGHT, walls, Paint("checker", repeat_m=1.2)),
        *place(fix.bathtub(), 0.86, 7.0),
        *place(fix.basin(), 0, 5.3, 0, 90),
        *place(fix.toilet(), 0.62, 4.12, 0, 180),
        *place(towels, 1.62, 4.12, 0, 180),
        *place(fix.picture("alps", 0.5, 0.4, 1.7), 0.62, 4.12, 0, 180),
        *place(fur.cupboard(0.5, 1.6, 0.32, 1, 2, things.WHITE, (0.55, 0.70, 0.72)), 2.1, 4.12, 0, 180),
        *place(fix.wall_shelf(0.8, 1.5, things.plant(0.3, 7, np.random.default_rng(3), things.WHITE)), 0.9, 7.0),
        *place(fur.rug(0.9, 0.6, "kilim"), 1.35, 5.35),
        *place(things.pendant(0.12, (0.85, 0.88, 0.9)), 1.2, 5.5, HEIGHT),
        *place([block((-0.18, -0.36, 0), (0.18, -0.04, 0.5), Paint("wicker", repeat_m=0.3), 0.03)], 2.48, 6.6, 0, -90),
    ]


def _path() -> tuple[Waypoint, ...]:
    """Living room, study, bedroom, bathroom and back through the hall."""
    spots = [
        (3.2, 3.0, 280, -14), (2.75, 2.55, 225, -10), (2.75, 2.15, 165, -12), (2.9, 1.8, 105, -10), (3.3, 1.65, 50, -8),
        (4.2, 1.6, 10, -8), (5.26, 1.6, 0, -8), (6.1, 1.6, -25, -12), (6.6, 1.65, -75, -8), (6.75, 1.75, -20, -12),
        (6.7, 2.1, 40, -10), (6.52, 2.6, 85, -8), (6.5, 3.26, 90, -8), (6.5, 4.1, 50, -12), (6.65, 4.8, -15, -14),
        (6.6, 5.25, -65, -10), (6.35, 5.4, 0, -14), (6.2, 5.3, 65, -10), (6.1, 5.15, 130, -10), (5.85, 5.1, 172, -8),
        (5.26, 5.1, 180, -8), (4.4, 5.25, 165, -10), (3.6, 5.47, 178, -10), (2.54, 5.5, 182, -12),
        (1.75, 5.5, 165, -14), (1.45, 5.5, 220, -14), (1.45, 5.45, 290, -12), (1.75, 5.5, 345, -10),
        (2.54, 5.5, 360, -8), (3.3, 5.5, 352, -8), (3.72, 5.2, 305, -8), (3.8, 4.65, 272, -8), (3.8, 4.06, 270, -8),
        (3.6, 3.45, 272, -12),
    ]  # fmt: skip
    return tuple(
        Waypoint(x, y, 1.48 + 0.06 * float(np.sin(1.7 * i)), yaw, pitch) for i, (x, y, yaw, pitch) in enumerate(spots)
    )
