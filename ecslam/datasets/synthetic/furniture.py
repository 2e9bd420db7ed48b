"""Furniture from convex solids. Each piece stands on z = 0 with its back at y = 0, faces -y and is centred on x."""

from __future__ import annotations

import numpy as np

from .shapes import Paint, Shape, Vec, ball, block, can, place, rod, tilt
from .things import BRASS, DARK, OAK, STEEL, WALNUT, books, flowers, ornament, table_lamp, upright


def cloth(texture: str, tint: Vec, repeat_m: float = 0.5) -> Paint:
    """A textile."""
    return Paint(texture, tint, repeat_m)


def legs(width: float, depth: float, height: float, radius: float, paint: Paint) -> list[Shape]:
    """Four round legs under a width x depth rectangle whose back edge is at y = 0."""
    x, y0, y1 = width / 2 - 2 * radius, -2 * radius, -depth + 2 * radius
    return [can((sx, sy, 0), radius * 0.7, radius, height, paint) for sx in (-x, x) for sy in (y0, y1)]


def bed(width: float, cover: Paint, linen: Paint, frame: Paint = OAK) -> list[Shape]:
    """A bed 2.05 m long with headboard, mattress, bedspread, pillows and a folded throw."""
    x = width / 2
    soft = Paint("fabric", linen.tint, 0.4)
    parts = [
        *legs(width, 2.05, 0.14, 0.03, frame),
        block((-x, -2.05, 0.12), (x, 0, 0.30), frame),
        block((-x - 0.04, -0.08, 0.12), (x + 0.04, 0, 1.02), cloth("fabric", (0.45, 0.52, 0.56), 0.6), 0.035),
        block((-x + 0.02, -2.02, 0.28), (x - 0.02, -0.09, 0.50), soft, 0.06),
        block((-x - 0.015, -2.06, 0.22), (x + 0.015, -0.72, 0.545), cover, 0.05),
        block((-x - 0.025, -1.96, 0.24), (x + 0.025, -1.48, 0.57), cloth("plaid", (0.95, 0.85, 0.8), 0.5), 0.04),
    ]
    count = 2 if width > 1.1 else 1
    for i in range(count):
        at = (i - (count - 1) / 2) * width * 0.47
        pillow = block((at - 0.3, -0.50, 0.50), (at + 0.3, -0.12, 0.64), linen, 0.068)
        parts.append(tilt(pillow, 14, 3 - 6 * i))
    parts.append(
        tilt(block((-0.22, -0.66, 0.54), (0.2, -0.54, 0.86), cloth("knit", (0.86, 0.62, 0.32), 0.25), 0.055), -24, 8)
    )
    return parts


def sofa(width: float, fabric: Paint, seats: int, accents: tuple[Paint, ...]) -> list[Shape]:
    """A sofa with loose cushions; an armchair when seats is 1."""
    x, arm = width / 2, 0.17
    inner = (width - 2 * arm) / seats
    parts = [
        *legs(width, 0.88, 0.13, 0.025, WALNUT),
        block((-x, -0.88, 0.12), (x, 0, 0.30), fabric, 0.03),
        block((-x, -0.20, 0.20), (x, 0, 0.80), fabric, 0.06),
        block((-x, -0.90, 0.20), (-x + arm, 0, 0.60), fabric, 0.06),
        block((x - arm, -0.90, 0.20), (x, 0, 0.60), fabric, 0.06),
    ]
    for i in range(seats):
        low = -x + arm + i * inner
        parts.append(block((low + 0.005, -0.91, 0.28), (low + inner - 0.005, -0.19, 0.45), fabric, 0.05))
        back = block((low + 0.01, -0.36, 0.43), (low + inner - 0.01, -0.20, 0.86), fabric, 0.07)
        parts.append(tilt(back, -9))
    for i, paint in enumerate(accents):
        at = (-1) ** i * (x - arm - 0.24)
        parts.append(tilt(block((at - 0.21, -0.50, 0.46), (at + 0.21, -0.38, 0.86), paint, 0.058), -20, 12 * (-1) ** i))
    return parts


def table(width: float, depth: float, height: float, top: Paint, leg: Paint = DARK) -> list[Shape]:
    """A table with a thick top and round legs."""
    x = width / 2
    return [
        block((-x, -depth, height - 0.04), (x, 0, height), top, 0.012),
        block((-x + 0.06, -depth + 0.06, height - 0.10), (x - 0.06, -0.06, height - 0.04), leg),
        *legs(width, depth, height - 0.04, 0.026, leg),
    ]


def chair(wood: Paint, seat: Paint) -> list[Shape]:
    """A dining chair with a slatted back."""
    parts = [*legs(0.44, 0.44, 0.44, 0.018, wood), block((-0.22, -0.44, 0.43), (0.22, 0, 0.475), seat, 0.02)]
    parts += [rod((sx, -0.03, 0.46), (sx, 0.01, 0.86), 0.016, wood) for sx in (-0.19, 0.19)]
    parts += [block((-0.19, -0.015, z), (0.19, 0.012, z + 0.07), wood, 0.01) for z in (0.60, 0.79)]
    return parts


def office_chair(fabric: Paint) -> list[Shape]:
    """A swivel chair on a star of five feet."""
    parts = [can((0, -0.3, 0.07), 0.03, 0.025, 0.37, STEEL)]
    for k in range(5):
        a = 2 * np.pi * k / 5 + 0.3
        tip = (0.29 * float(np.cos(a)), -0.3 + 0.29 * float(np.sin(a)), 0.06)
        parts += [rod((0, -0.3, 0.10), tip, 0.02, DARK), ball((tip[0], tip[1], 0.032), (0.03, 0.03, 0.03), DARK)]
    parts.append(block((-0.25, -0.56, 0.43), (0.25, -0.06, 0.52), fabric, 0.04))
    parts.append(tilt(block((-0.23, -0.07, 0.60), (0.23, 0.0, 1.08), fabric, 0.033), -8))
    parts.append(rod((0, -0.08, 0.46), (0, -0.005, 0.75), 0.02, DARK))
    for x in (-0.29, 0.29):
        parts += [
            rod((x, -0.42, 0.66), (x, -0.18, 0.66), 0.02, DARK),
            rod((x, -0.3, 0.46), (x, -0.3, 0.66), 0.015, DARK),
        ]
    return parts


def bookcase(columns: int, rows: int, seed: int, wood: Paint = WALNUT) -> list[Shape]:
    """A bookcase of 0.42 m wide bays, 0.34 m high, with books and a few ornaments."""
    rng = np.random.default_rng(seed)
    bay, step, depth = 0.42, 0.34, 0.28
    width, height = columns * bay + 0.03, rows * step + 0.08
    x0 = -width / 2
    parts = [block((x0, -0.012, 0), (x0 + width, 0, height), upright(wood))]
    parts += [
        block((x0 + i * bay, -depth, 0), (x0 + i * bay + 0.03, 0, height), upright(wood)) for i in range(columns + 1)
    ]
    parts += [
        block((x0, -depth + 0.004, 0.05 + j * step), (x0 + width, 0, 0.075 + j * step), wood) for j in range(rows + 1)
    ]
    for i in range(columns):
        for j in range(rows):
            x, z = x0 + 0.035 + i * bay, 0.076 + j * step
            filled = float(rng.choice([0.0, 0.6, 1.0], p=[0.2, 0.3, 0.5]))
            parts += place(books(bay - 0.04, step - 0.05, 0.22, rng, filled), x, -0.012, z)
            if filled < 1:
                parts += place(ornament(int(rng.integers(4)), rng), x + (0.19 if filled == 0 else 0.31), -0.14, z)
    return parts


def cupboard(width: float, height: float, depth: float, across: int, down: int, body: Paint, leaf: Vec) -> list[Shape]:
    """A wardrobe, dresser or sideboard: a carcass with across x down panelled fronts and knobs."""
    x = width / 2
    parts = [
        block((-x, -depth, 0.07), (x, 0, height), upright(body)),
        block((-x + 0.03, -depth + 0.04, 0), (x - 0.03, 0, 0.07), DARK),
    ]
    w, h = width / across, (height - 0.11) / down
    tall = h > 1.2 * w
    for i in range(across):
        for j in range(down):
            low = (-x + i * w + 0.008, -depth - 0.018, 0.09 + j * h + 0.004)
            parts.append(block(low, (low[0] + w - 0.016, -depth, low[2] + h - 0.008), Paint("front", leaf, 0.0)))
            knob_x = low[0] + (w - 0.06 if i % 2 == 0 else 0.045) if tall else low[0] + w / 2 - 0.008
            parts.append(ball((knob_x, -depth - 0.032, low[2] + h * 0.55), (0.016, 0.018, 0.016), BRASS))
    return parts


def nightstand(lamp: Vec) -> list[Shape]:
    """A bedside cabinet with a lamp and a book."""
    return [
        *cupboard(0.44, 0.48, 0.38, 1, 2, OAK, (0.90, 0.82, 0.70)),
        *place(table_lamp(lamp), 0.06, -0.2, 0.48),
        *place([block((-0.08, -0.11, 0), (0.08, 0.11, 0.03), Paint("waves", repeat_m=0.0))], -0.1, -0.25, 0.48, 20),
    ]


def desk(seed: int) -> list[Shape]:
    """A work place, 1.5 m wide: monitor, keyboard, lamp, books, a mug with pens, a notebook."""
    rng = np.random.default_rng(seed)
    parts = table(1.5, 0.72, 0.74, OAK)
    parts += place(cupboard(0.4, 0.62, 0.6, 1, 3, OAK, (0.80, 0.84, 0.84)), 0.48, -0.06)
    parts += place(monitor("editor"), -0.1, -0.2, 0.74)
    parts += [
        block((-0.34, -0.58, 0.74), (0.10, -0.44, 0.757), Paint("keyboard", repeat_m=0.0)),
        ball((0.22, -0.50, 0.752), (0.032, 0.05, 0.02), DARK),
        block((0.30, -0.64, 0.74), (0.52, -0.36, 0.752), Paint("botanic", repeat_m=0.0)),
        can((0.40, -0.16, 0.74), 0.04, 0.042, 0.10, Paint("tiles", (0.9, 0.5, 0.3), 0.2)),
        rod((0.39, -0.16, 0.76), (0.37, -0.14, 0.91), 0.005, Paint("plain", (0.2, 0.4, 0.8))),
        rod((0.41, -0.17, 0.76), (0.43, -0.19, 0.90), 0.005, Paint("plain", (0.9, 0.7, 0.1))),
        can((0.62, -0.42, 0.74), 0.038, 0.042, 0.09, Paint("marble", (0.4, 0.6, 0.7), 0.2)),
    ]
    parts += place(books(0.24, 0.24, 0.18, rng), 0.48, -0.03, 0.74)
    parts += place(table_lamp((0.62, 0.34, 0.28)), -0.62, -0.22, 0.74)
    return parts


def monitor(screen: str, width: float = 0.62) -> list[Shape]:
    """A flat screen on a foot."""
    x, h = width / 2, width * 0.58
    return [
        block((-0.11, -0.10, 0), (0.11, 0.06, 0.012), DARK),
        block((-0.025, -0.01, 0.01), (0.025, 0.015, 0.2), DARK),
        block((-x, -0.045, 0.10), (x, -0.015, 0.10 + h), DARK, 0.01),
        block((-x + 0.015, -0.047, 0.118), (x - 0.015, -0.044, 0.085 + h), Paint(screen, repeat_m=0.0, glow=0.8)),
    ]


def low_table(seed: int) -> list[Shape]:
    """A coffee table centred on the origin with books, a fruit bowl, a mug and flowers."""
    rng = np.random.default_rng(seed)
    parts = [
        *place(table(1.0, 0.6, 0.40, WALNUT, OAK), 0, 0.3),
        block((-0.42, -0.24, 0.14), (0.42, 0.24, 0.16), OAK),
        block((-0.40, -0.16, 0.16), (-0.1, 0.06, 0.19), Paint("alps", repeat_m=0.0)),
        can((0.18, 0.06, 0.40), 0.07, 0.15, 0.07, Paint("marble", (0.45, 0.6, 0.66), 0.3)),
        can((-0.02, -0.19, 0.40), 0.035, 0.04, 0.085, Paint("tiles", (0.95, 0.9, 0.8), 0.15)),
    ]
    for x, y, z, tint in (
        (0.13, 0.05, 0.47, (0.9, 0.3, 0.2)),
        (0.22, 0.11, 0.47, (0.95, 0.65, 0.2)),
        (0.22, 0.01, 0.48, (0.6, 0.75, 0.25)),
    ):
        parts.append(ball((x, y, z), (0.045, 0.045, 0.043), Paint("cork", tint, 0.2)))
    for k, (pattern, turn) in enumerate((("sunset", 8.0), ("atlas", -10.0), ("circles", 22.0))):
        size = (0.16 - 0.02 * k, 0.11 - 0.01 * k)
        book = block((-size[0], -size[1], 0), (size[0], size[1], 0.03), Paint(pattern, repeat_m=0.0))
        parts += place([book], -0.26, 0.04, 0.40 + 0.03 * k, turn)
    parts += place(flowers(rng), -0.02, 0.2, 0.40)
    return parts


def rug(width: float, depth: float, pattern: str) -> list[Shape]:
    """A rug centred on the origin."""
    return [block((-width / 2, -depth / 2, 0), (width / 2, depth / 2, 0.012), Paint(pattern, repeat_m=0.0))]


def television(width: float, picture: str) -> list[Shape]:
    """A sideboard with a screen, two speakers and a row of books."""
    x = width / 2
    parts = cupboard(width, 0.50, 0.42, 3, 1, WALNUT, (0.62, 0.46, 0.34))
    parts += place(monitor(picture, 1.1), 0, -0.12, 0.46)
    parts += [
        block(
            (s * (x - 0.13) - 0.09, -0.33, 0.50),
            (s * (x - 0.13) + 0.09, -0.10, 0.83),
            Paint("fabric", (0.3, 0.3, 0.33), 0.2),
            0.015,
        )
        for s in (-1, 1)
    ]
    return parts
