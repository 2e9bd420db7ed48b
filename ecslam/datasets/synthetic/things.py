"""Small things and finishes: books, plants, lamps, ornaments. Each stands on z = 0 around the origin."""

from __future__ import annotations

import numpy as np

from .shapes import Paint, Shape, Vec, ball, block, can, pillar, rod, tilt

OAK = Paint("wood", (0.86, 0.66, 0.44), 0.7)
WALNUT = Paint("wood", (0.55, 0.37, 0.25), 0.7)
DARK = Paint("plain", (0.16, 0.16, 0.18), 0.5)
WHITE = Paint("plain", (0.95, 0.94, 0.91), 0.6)
STEEL = Paint("metal", (0.80, 0.82, 0.84), 0.4)
BRASS = Paint("metal", (0.86, 0.68, 0.36), 0.4)
PAPER = Paint("plain", (1.0, 0.92, 0.76), 0.5, glow=0.95)
SOIL = Paint("cork", (0.40, 0.30, 0.25), 0.3)


def upright(paint: Paint) -> Paint:
    """The same wood with its grain running upwards."""
    return Paint(paint.texture, paint.tint, paint.repeat_m, paint.glow, True, paint.shift)


def books(width: float, height: float, depth: float, rng: np.random.Generator, filled: float = 1.0) -> list[Shape]:
    """A row of books from x = 0 to x = width * filled, backs towards -y, spines at y = -depth."""
    palette = [
        (0.70, 0.20, 0.17), (0.17, 0.31, 0.48), (0.88, 0.72, 0.36), (0.25, 0.44, 0.33), (0.90, 0.87, 0.80),
        (0.45, 0.26, 0.42), (0.86, 0.48, 0.26), (0.20, 0.22, 0.26), (0.46, 0.66, 0.70), (0.62, 0.44, 0.31),
    ]  # fmt: skip
    parts: list[Shape] = []
    x = 0.0
    while True:
        thick = float(rng.uniform(0.022, 0.055))
        tall = float(rng.uniform(0.68, 0.96)) * height
        tint = np.clip(np.array(palette[int(rng.integers(10))]) * rng.uniform(0.85, 1.12), 0, 1)
        if x + thick > width * filled:
            break
        paint = Paint("spine", (float(tint[0]), float(tint[1]), float(tint[2])), 0.0)
        parts.append(block((x, -depth + float(rng.uniform(0, 0.03)), 0), (x + thick - 0.001, -0.02, tall), paint))
        x += thick
    return parts


def ornament(which: int, rng: np.random.Generator) -> list[Shape]:
    """A small thing for a shelf: a vase, a ball on a stand, a box or a pot with leaves."""
    tint = (float(rng.uniform(0.3, 0.9)), float(rng.uniform(0.3, 0.8)), float(rng.uniform(0.3, 0.8)))
    glaze = Paint("marble", tint, 0.3)
    if which == 0:
        return [can((0, 0, 0), 0.03, 0.06, 0.10, glaze), can((0, 0, 0.10), 0.06, 0.025, 0.08, glaze)]
    if which == 1:
        return [
            can((0, 0, 0), 0.035, 0.02, 0.04, DARK),
            ball((0, 0, 0.105), (0.068, 0.068, 0.068), Paint("atlas", repeat_m=0.16)),
        ]
    if which == 2:
        return [block((-0.07, -0.08, 0), (0.07, 0.08, 0.12), Paint("wicker", repeat_m=0.2), 0.012)]
    return plant(0.24, 7, rng, Paint("terrazzo", (0.95, 0.85, 0.8), 0.3))


def plant(height: float, count: int, rng: np.random.Generator, pot: Paint) -> list[Shape]:
    """A pot plant: leaves are flat ellipsoids at the ends of thin stems."""
    r = height * 0.15 + 0.02
    base = height * 0.26
    parts = [can((0, 0, 0), r * 0.75, r, base, pot), can((0, 0, base - 0.004), r * 0.88, r * 0.88, 0.006, SOIL)]
    for k in range(count):
        a = 2.4 * k + float(rng.uniform(-0.3, 0.3))
        spread = height * float(rng.uniform(0.14, 0.30))
        top = base + (height - base) * (0.35 + 0.62 * (k + 0.5) / count)
        tip = (spread * float(np.cos(a)), spread * float(np.sin(a)), top)
        shade = float(rng.uniform(0.75, 1.15))
        green = Paint("leaf", (0.34 * shade, 0.58 * shade, 0.30 * shade), 0.25)
        blade = ball(tip, (height * 0.065, height * 0.145, height * 0.012), green)
        parts.append(tilt(blade, float(rng.uniform(15, 50)), float(np.degrees(a)) - 90))
        if k % 2 == 0:
            parts.append(
                rod((0, 0, base), (tip[0] * 0.8, tip[1] * 0.8, tip[2] - 0.02 * height), height * 0.007 + 0.001, green)
            )
    return parts


def flowers(rng: np.random.Generator) -> list[Shape]:
    """A vase of flowers, 0.4 m."""
    parts = [can((0, 0, 0), 0.03, 0.05, 0.16, Paint("marble", (0.85, 0.9, 0.92), 0.25))]
    for k in range(7):
        a, spread = 2.4 * k, 0.03 + 0.012 * k
        tip = (spread * float(np.cos(a)), spread * float(np.sin(a)), 0.40 - 0.018 * k)
        bloom = ((0.92, 0.45, 0.5), (0.96, 0.82, 0.4), (0.78, 0.55, 0.82))[k % 3]
        parts += [
            rod((0, 0, 0.15), tip, 0.004, Paint("leaf", (0.35, 0.6, 0.3), 0.2)),
            ball(tip, (0.034, 0.034, 0.026), Paint("cork", bloom, float(rng.uniform(0.1, 0.2)))),
        ]
    return parts


def floor_lamp() -> list[Shape]:
    """A standard lamp with a paper shade, 1.6 m."""
    return [
        can((0, 0, 0), 0.15, 0.14, 0.025, BRASS),
        rod((0, 0, 0.02), (0, 0, 1.40), 0.012, BRASS),
        can((0, 0, 1.32), 0.21, 0.14, 0.28, PAPER),
    ]


def table_lamp(tint: Vec = (0.30, 0.48, 0.52)) -> list[Shape]:
    """A small lamp with a ceramic foot, 0.42 m."""
    return [
        ball((0, 0, 0.10), (0.07, 0.07, 0.10), Paint("marble", tint, 0.3)),
        rod((0, 0, 0.17), (0, 0, 0.25), 0.008, BRASS),
        can((0, 0, 0.24), 0.125, 0.08, 0.18, PAPER),
    ]


def pendant(drop: float, tint: Vec) -> list[Shape]:
    """A lamp hanging from z = 0 downwards."""
    return [
        pillar((0, 0, -drop), (0, 0, 0), 0.006, DARK),
        can((0, 0, -drop - 0.17), 0.19, 0.05, 0.18, Paint("metal", tint, 0.4)),
        ball((0, 0, -drop - 0.15), (0.07, 0.07, 0.07), Paint("plain", (1, 0.93, 0.8), 0.5, glow=1.1)),
    ]
