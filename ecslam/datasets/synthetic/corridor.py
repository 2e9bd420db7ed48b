"""The corridor: 9 m long and 2 m wide, panelled, with doors, lamps and pictures, walked down and back."""

from __future__ import annotations

import numpy as np

from . import fixtures as fix
from . import furniture as fur
from . import things
from .path import Waypoint
from .rooms import Room, box, daylight, lamp
from .shapes import Light, Paint, Shape, Vec, ball, block, can, place, rod

LENGTH, WIDTH, HEIGHT = 9.0, 2.0, 2.6
FRAMES = 640
PANEL_M = 0.5
DOORS_NORTH, DOORS_SOUTH = (1.4, 4.6, 7.4), (2.9, 6.1)


def build() -> Room:
    """Doors and pictures on both sides; a window at the far end, a shelf at the near one."""
    interior = np.array([[-0.055, -0.055, -0.05], [LENGTH + 0.055, WIDTH + 0.05, HEIGHT + 0.05]])
    shapes = (*_shell(), *_sides(), *_ends(), *_ceiling(), *_floor())
    return Room(shapes, _lights(), interior, _path(), FRAMES)


def _lights() -> tuple[Light, ...]:
    reach = box((0, 0, 0), (LENGTH, WIDTH, HEIGHT))
    pendants = tuple(lamp((x, WIDTH / 2, HEIGHT - 0.5), 0.75, reach, 0.12) for x in (1.5, 4.5, 7.5))
    sconces = tuple(lamp((x, y, 1.78), 0.22, reach, 0.07) for x, y in _sconces())
    return (daylight((LENGTH - 0.03, WIDTH / 2, 1.5), (-1, 0, 0), 1.0, 1.5, 5.0, reach), *pendants, *sconces)


def _sconces() -> list[tuple[float, float]]:
    return [(3.0, WIDTH - 0.14), (6.0, WIDTH - 0.14), (1.2, 0.14), (4.5, 0.14), (7.6, 0.14)]


def _shell() -> list[Shape]:
    holes = {"east": (fix.Opening(0.5, 1.5, 0.75, 2.25),)}
    paper = Paint("foliage", (0.93, 0.95, 0.90), 1.0)
    walls = fix.Walls(
        paper,
        Paint("plaster", (0.90, 0.86, 0.78), 1.5),
        Paint("stripes", (0.95, 0.86, 0.74), 1.1),
        Paint("bricks", repeat_m=1.1),
        holes,
    )
    floor = Paint("planks", (0.72, 0.52, 0.38), 1.9)
    return fix.shell((0, 0), (LENGTH, WIDTH), HEIGHT, walls, floor)


def _wainscot(doors: tuple[float, ...], tint: Vec) -> list[Shape]:
    """Panels along a wall from x = 0 to LENGTH, leaving out the doors, under a rail."""
    parts: list[Shape] = []
    stops = [0.0, *(e for d in doors for e in (d - 0.53, d + 0.53)), LENGTH]
    for a, b in zip(stops[::2], stops[1::2], strict=True):
        count = max(1, round((b - a) / PANEL_M))
        step = (b - a) / count
        for k in range(count):
            parts.append(block((a + k * step, -0.016, 0.06), (a + (k + 1) * step, 0, 0.92), Paint("front", tint, 0.0)))
        parts.append(block((a, -0.035, 0.92), (b, 0, 0.96), Paint("wood", tint, 0.6)))
    return parts


def _side(doors: tuple[float, ...], leaf: Paint, tint: Vec) -> list[Shape]:
    parts = _wainscot(doors, tint)
    for at in doors:
        parts += place(fix.door(0.9, leaf), at, 0)
    return parts


def _sides() -> list[Shape]:
    teal, wine = (0.36, 0.50, 0.50), (0.58, 0.40, 0.32)
    south = tuple(LENGTH - d for d in reversed(DOORS_SOUTH))
    parts = [
        *place(_side(DOORS_NORTH, Paint("door", (0.95, 0.84, 0.70), 0.0), teal), 0, WIDTH),
        *place(_side(south, Paint("door", (0.62, 0.46, 0.36), 0.0), wine), LENGTH, 0, 0, 180),
    ]
    pictures = [
        ("alps", 2.5, 0.8, 0.55), ("circles", 3.5, 0.55, 0.55), ("sunset", 5.5, 0.6, 0.6),
        ("botanic", 6.45, 0.5, 0.62), ("skyline", 8.5, 0.55, 0.7), ("waves", 0.45, 0.5, 0.6),
    ]  # fmt: skip
    for name, x, width, height in pictures:
        parts += place(fix.picture(name, width, height, 1.55), x, WIDTH)
    opposite = [
        ("blocks", 0.55, 0.5, 0.5), ("atlas", 1.85, 0.7, 0.55), ("sunset", 3.85, 0.5, 0.6),
        ("waves", 5.1, 0.55, 0.55), ("circles", 7.1, 0.5, 0.5), ("alps", 8.25, 0.8, 0.55),
    ]  # fmt: skip
    for name, x, width, height in opposite:
        parts += place(fix.picture(name, width, height, 1.55, things.BRASS), x, 0, 0, 180)
    for x, y in _sconces():
        parts += [
            ball((x, y, 1.80), (0.075, 0.075, 0.10), things.PAPER),
            rod((x, y, 1.70), (x, WIDTH if y > 1 else 0, 1.66), 0.012, things.BRASS),
        ]
    return parts


def _ends() -> list[Shape]:
    rng = np.random.default_rng(5)
    return [
        *place(fix.window(1.0, 1.5, 0.75, None), LENGTH, WIDTH / 2, 0, -90),
        *place(fix.radiator(0.8), LENGTH, WIDTH / 2, 0, -90),
        *place(things.plant(1.2, 16, rng, Paint("wicker", repeat_m=0.35)), LENGTH - 0.35, WIDTH - 0.38),
        *place(things.plant(0.9, 12, rng, Paint("terrazzo", (0.9, 0.7, 0.6), 0.4)), LENGTH - 0.32, 0.34),
        *place(fur.bookcase(3, 3, 41, things.OAK), 0, WIDTH / 2, 0, 90),
        *place(things.table_lamp(), 0.15, 0.60, 1.10),
        *place(things.flowers(rng), 0.15, 1.05, 1.10),
        *place(things.ornament(1, rng), 0.15, 1.40, 1.10),
        *place(fix.picture("atlas", 0.9, 0.7, 1.9), 0, WIDTH / 2, 0, 90),
        *place(fix.bench(0.95, Paint("plaid", repeat_m=0.4)), 5.35, WIDTH - 0.02),
        *place(fur.cupboard(0.9, 0.8, 0.28, 2, 2, things.WALNUT, (0.66, 0.48, 0.34)), 4.5, 0.02, 0, 180),
        *place(things.ornament(0, rng), 4.3, 0.16, 0.8),
        *place(things.ornament(3, rng), 4.75, 0.16, 0.8),
        *place(fur.chair(things.OAK, Paint("fabric", (0.4, 0.55, 0.6), 0.3)), 7.75, 0.03, 0, 180),
        can((2.55, WIDTH - 0.18, 0), 0.11, 0.13, 0.5, Paint("wicker", repeat_m=0.3)),
        rod((2.53, WIDTH - 0.16, 0.06), (2.58, WIDTH - 0.10, 0.86), 0.018, Paint("plaid", repeat_m=0.2)),
        rod((2.58, WIDTH - 0.2, 0.06), (2.50, WIDTH - 0.12, 0.80), 0.018, Paint("fabric", (0.2, 0.25, 0.4), 0.2)),
    ]


def _ceiling() -> list[Shape]:
    beams = [
        block(
            (x - 0.06, 0, HEIGHT - 0.12), (x + 0.06, WIDTH, HEIGHT), Paint("wood", (0.58, 0.42, 0.30), 0.6, turn=True)
        )
        for x in (0.75, 2.25, 3.75, 5.25, 6.75, 8.25)
    ]
    lamps = [s for x in (1.5, 4.5, 7.5) for s in place(things.pendant(0.28, (0.85, 0.65, 0.4)), x, WIDTH / 2, HEIGHT)]
    return [*beams, *lamps]


def _floor() -> list[Shape]:
    """A row of runners."""
    names = ("kilim", "oriental", "kilim", "oriental")
    return [
        s for k, name in enumerate(names) for s in place(fur.rug(1.0, 1.75, name), 1.55 + 1.95 * k, WIDTH / 2, 0, 90)
    ]


def _path() -> tuple[Waypoint, ...]:
    """Down the corridor, about, and back, glancing at either side."""
    spots = [
        (1.5, 1.0, 0, -8), (2.2, 0.94, 18, -12), (2.9, 1.0, -4, -8), (3.6, 1.06, -20, -12), (4.25, 1.0, 2, -8),
        (4.8, 0.86, 32, -12), (5.05, 0.72, 86, -14), (4.95, 0.84, 138, -10), (4.5, 1.0, 172, -8), (3.9, 1.05, 197, -12),
        (3.2, 0.98, 180, -8), (2.5, 0.95, 164, -12), (1.95, 1.02, 182, -8), (1.5, 1.14, 216, -12),
        (1.25, 1.26, 272, -14), (1.3, 1.12, 326, -10),
    ]  # fmt: skip
    return tuple(
        Waypoint(x, y, 1.5 + 0.06 * float(np.sin(1.3 * i)), yaw, pitch) for i, (x, y, yaw, pitch) in enumerate(spots)
    )
