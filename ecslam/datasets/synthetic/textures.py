"""Repeating surface textures, drawn from noise and simple rules. Display-referred RGB in 0..1, sizes powers of two."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

Image = NDArray[np.float32]
Rng = np.random.Generator
SIZE = 512


def cloud(rng: Rng, rows: int, columns: int, blur_rows: float, blur_columns: float) -> Image:
    """Tileable noise [rows, columns] of unit variance, smooth over the given lengths in pixels."""
    spectrum = fft.rfft2(rng.standard_normal((rows, columns), np.float32))
    fy = fft.fftfreq(rows)[:, None] * blur_rows
    fx = fft.rfftfreq(columns)[None, :] * blur_columns
    spectrum *= np.exp(-2 * np.pi**2 * fx**2).astype(np.float32) * np.exp(-2 * np.pi**2 * fy**2).astype(np.float32)
    spectrum[0, 0] = 0
    field = fft.irfft2(spectrum, (rows, columns))
    return np.asarray(field / field.std(), np.float32)


def tone(gray: Image, color: tuple[float, float, float] = (1, 1, 1)) -> Image:
    """Grey levels [H, W] times one colour, as [H, W, 3]."""
    return np.asarray(gray[..., None] * np.array(color, np.float32), np.float32)


def _cells(rows: int, columns: int, stagger: float, size: int = SIZE) -> tuple[Image, Image, NDArray[np.int64]]:
    """Brick layout: position inside the cell (u, v in 0..1) and the number of the cell, each [size, size]."""
    y, x = np.mgrid[0:size, 0:size] / size
    row = np.floor(y * rows)
    u = (x * columns + stagger * row) % columns
    column = np.floor(u)
    return np.float32(u - column), np.float32(y * rows - row), (row * columns + column).astype(np.int64)


def _gap(u: Image, v: Image, width_u: float, width_v: float) -> Image:
    """0 in the joints between cells, 1 inside them, with a soft edge."""
    edge = np.minimum(np.minimum(u, 1 - u) / width_u, np.minimum(v, 1 - v) / width_v)
    return np.clip(edge * 2 - 1, 0, 1)


def plain(rng: Rng) -> Image:
    """Paint or plastic: almost even."""
    return tone(0.93 + 0.012 * cloud(rng, 128, 128, 1, 1))


def plaster(rng: Rng) -> Image:
    """A rolled wall: fine grain, soft patches, a few trowel marks."""
    grain = 0.016 * cloud(rng, SIZE, SIZE, 1, 1) + 0.022 * cloud(rng, SIZE, SIZE, 5, 9)
    patches = 0.022 * cloud(rng, SIZE, SIZE, 26, 40) + 0.016 * cloud(rng, SIZE, SIZE, 80, 60)
    return tone(np.clip(0.89 + grain + patches, 0, 1))


def concrete(rng: Rng) -> Image:
    """Exposed concrete with pores."""
    pores = np.clip(cloud(rng, SIZE, SIZE, 1.5, 1.5) - 2.3, 0, 0.5)
    base = 0.78 + 0.04 * cloud(rng, SIZE, SIZE, 50, 50) + 0.03 * cloud(rng, SIZE, SIZE, 6, 12) - 0.5 * pores
    return tone(np.clip(base, 0, 1), (1.0, 0.985, 0.96))


def wood(rng: Rng) -> Image:
    """Fine straight grain along the texture's u axis."""
    rings = cloud(rng, SIZE, SIZE, 9, 160) * 1.6
    grain = 0.5 + 0.5 * np.sin(6 * rings + 1.5 * cloud(rng, SIZE, SIZE, 2, 60))
    fibre = cloud(rng, SIZE, SIZE, 0.8, 22)
    return tone(np.clip(0.80 + 0.10 * grain + 0.035 * fibre, 0, 1), (1.0, 0.97, 0.93))


def planks(rng: Rng) -> Image:
    """A parquet of staggered boards along u."""
    size = 1024
    rows, columns = 10, 2
    u, v, cell = _cells(rows, columns, 0.37 * columns, size)
    shade = rng.uniform(0.72, 1.0, rows * columns + columns)[cell]
    warm = rng.uniform(-0.04, 0.04, rows * columns + columns)[cell]
    slide = (rng.integers(0, size, rows * columns + columns)[cell] + np.arange(size)[None, :]) % size
    field = cloud(rng, size, size, 5, 110)
    grain = field[np.arange(size)[:, None], slide]
    streak = cloud(rng, size, size, 0.9, 30)
    gray = shade * (0.86 + 0.05 * np.sin(5 * grain) + 0.03 * streak) * (0.55 + 0.45 * _gap(u, v, 0.006, 0.035))
    color = np.stack([gray * (1 + warm), gray, gray * (1 - 1.5 * warm)], -1)
    return np.clip(color, 0, 1).astype(np.float32)


def tiles(rng: Rng) -> Image:
    """Square glazed tiles, each of its own tone, with pale joints."""
    u, v, cell = _cells(4, 4, 0)
    shade = rng.uniform(0.76, 0.98, 16)[cell]
    gap = _gap(u, v, 0.035, 0.035)
    glaze = 0.03 * cloud(rng, SIZE, SIZE, 12, 12) + 0.015 * cloud(rng, SIZE, SIZE, 2, 2)
    return tone(np.clip((shade + glaze) * gap + 0.62 * (1 - gap), 0, 1))


def checker(rng: Rng) -> Image:
    """Dark and light stone tiles."""
    u, v, cell = _cells(4, 4, 0)
    odd = (cell // 4 + cell % 4) % 2
    vein = np.clip(1.2 - 3 * np.abs(cloud(rng, SIZE, SIZE, 22, 14)), 0, 1)
    stone = np.where(odd == 1, 0.90 - 0.12 * vein, 0.36 + 0.16 * vein)
    stone = stone * rng.uniform(0.92, 1.04, 16)[cell] + 0.015 * cloud(rng, SIZE, SIZE, 1, 1)
    return tone(np.clip(stone * (0.6 + 0.4 * _gap(u, v, 0.03, 0.03)), 0, 1), (1.0, 0.98, 0.94))


def bricks(rng: Rng) -> Image:
    """A brick wall in running bond."""
    u, v, cell = _cells(8, 4, 0.5)
    rough = 0.05 * cloud(rng, SIZE, SIZE, 2, 3) + 0.04 * cloud(rng, SIZE, SIZE, 9, 14)
    shade = rng.uniform(0.66, 1.0, 40)[cell] + rough
    gap = _gap(u, v, 0.055, 0.11)
    hue = rng.uniform(-0.05, 0.07, 40)[cell]
    brick = np.stack([shade * 0.74, shade * (0.43 + hue), shade * (0.34 + hue)], -1)
    mortar = tone(0.72 + 0.03 * cloud(rng, SIZE, SIZE, 2, 2), (1, 0.97, 0.92))
    return np.clip(brick * gap[..., None] + mortar * (1 - gap[..., None]), 0, 1).astype(np.float32)


def terrazzo(rng: Rng) -> Image:
    """Stone chips in cement."""
    image = tone(0.86 + 0.012 * cloud(rng, SIZE, SIZE, 2, 2), (1, 0.98, 0.95))
    palette = np.array(
        [[0.45, 0.42, 0.40], [0.78, 0.56, 0.44], [0.55, 0.63, 0.58], [0.95, 0.9, 0.8], [0.3, 0.32, 0.36]]
    )
    for _ in range(700):
        x, y = rng.integers(0, SIZE, 2)
        axes = rng.uniform(2, 9, 2)
        angle = float(rng.uniform(0, 180))
        chip = cv2.ellipse2Poly((0, 0), (int(axes[0]), int(axes[1])), int(angle), 0, 360, 60)
        color = [float(c) for c in palette[rng.integers(5)] * rng.uniform(0.85, 1.1)]
        for dx in (0, -SIZE) if x > SIZE - 16 else (0, SIZE) if x < 16 else (0,):
            for dy in (0, -SIZE) if y > SIZE - 16 else (0, SIZE) if y < 16 else (0,):
                cv2.fillConvexPoly(image, np.add(chip, (int(x) + dx, int(y) + dy)), color, cv2.LINE_AA)
    return np.clip(image, 0, 1)


def marble(rng: Rng) -> Image:
    """Pale stone with veins."""
    vein = np.clip(1 - 2.4 * np.abs(cloud(rng, SIZE, SIZE, 40, 24) + 0.25 * cloud(rng, SIZE, SIZE, 6, 6)), 0, 1)
    thin = np.clip(1 - 7 * np.abs(cloud(rng, SIZE, SIZE, 24, 34)), 0, 1)
    return tone(
        np.clip(0.93 - 0.26 * vein**2 - 0.2 * thin + 0.01 * cloud(rng, SIZE, SIZE, 3, 3), 0, 1), (1, 0.985, 0.97)
    )


def fabric(rng: Rng) -> Image:
    """A coarse weave with melange."""
    y, x = np.mgrid[0:SIZE, 0:SIZE] * (2 * np.pi * 64 / SIZE)
    weave = 0.05 * np.sin(x) * np.sign(np.sin(y)) + 0.03 * np.sin(2 * y)
    melange = 0.05 * cloud(rng, SIZE, SIZE, 1, 5) + 0.04 * cloud(rng, SIZE, SIZE, 5, 1)
    return tone(np.clip(0.82 + weave + melange + 0.03 * cloud(rng, SIZE, SIZE, 30, 30), 0, 1))


def knit(rng: Rng) -> Image:
    """Chunky knitwear: rows of V stitches."""
    y, x = np.mgrid[0:SIZE, 0:SIZE] / SIZE
    slant = np.abs((x * 24) % 1 - 0.5)
    stitch = 0.5 + 0.5 * np.cos(2 * np.pi * (y * 32 + 1.6 * slant))
    groove = np.clip(slant * 8, 0, 1) * np.clip((0.5 - slant) * 8, 0, 1)
    return tone(np.clip(0.55 + 0.35 * stitch * groove + 0.03 * cloud(rng, SIZE, SIZE, 2, 2), 0, 1))


def plaid(rng: Rng) -> Image:
    """Checked cloth in three colours."""
    line = np.arange(SIZE) / SIZE * 4 % 1
    band = (line < 0.42).astype(np.float32)
    thin = ((line > 0.62) & (line < 0.67)) | ((line > 0.77) & (line < 0.82))
    cloth = np.full((SIZE, SIZE, 3), (0.93, 0.89, 0.80), np.float32)
    for axis_band, axis_thin in ((band[:, None], thin[:, None]), (band[None], thin[None])):
        cloth *= 1 - 0.38 * axis_band[..., None] * np.array([0.15, 0.75, 0.7], np.float32)
        cloth *= 1 - 0.55 * axis_thin[..., None] * np.array([0.9, 0.7, 0.2], np.float32)
    return np.clip(cloth * (1 + 0.04 * cloud(rng, SIZE, SIZE, 1, 1))[..., None], 0, 1)


def quilt(rng: Rng) -> Image:
    """A padded bedspread: diamonds with seams, some of them coloured."""
    y, x = np.mgrid[0:SIZE, 0:SIZE] / SIZE * 6
    a, b = (x + y) % 6, (x - y) % 6
    u, v = a % 1, b % 1
    cell = np.floor(a).astype(int) * 6 + np.floor(b).astype(int)
    puff = np.sqrt(np.clip(np.sin(np.pi * u) * np.sin(np.pi * v), 0, 1)).astype(np.float32)
    palette = np.array([[0.93, 0.92, 0.89], [0.70, 0.78, 0.84], [0.86, 0.80, 0.70], [0.40, 0.52, 0.66]])
    color = palette[rng.choice(4, 36, p=[0.45, 0.22, 0.2, 0.13])[cell]]
    return np.clip(color * (0.72 + 0.27 * puff + 0.02 * cloud(rng, SIZE, SIZE, 1, 1))[..., None], 0, 1).astype(
        np.float32
    )


def carpet(rng: Rng) -> Image:
    """Deep wool pile."""
    return tone(np.clip(0.72 + 0.09 * cloud(rng, SIZE, SIZE, 1.5, 1.5) + 0.06 * cloud(rng, SIZE, SIZE, 8, 8), 0, 1))


def curtain(rng: Rng) -> Image:
    """Cloth hanging in vertical folds."""
    x = np.arange(SIZE) / SIZE * 2 * np.pi
    fold = 0.10 * np.sin(9 * x) + 0.07 * np.sin(14 * x + 1) + 0.04 * np.sin(23 * x + 2)
    return tone(np.clip(0.80 + fold[None, :] + 0.03 * cloud(rng, SIZE, SIZE, 12, 2), 0, 1))


def stripes(rng: Rng) -> Image:
    """Wallpaper in broad and thin vertical stripes."""
    line = np.arange(SIZE) / SIZE * 6 % 1
    broad = 0.90 - 0.13 * (line < 0.45) - 0.16 * (np.abs(line - 0.55) < 0.018) - 0.16 * (np.abs(line - 0.9) < 0.018)
    return tone(
        np.clip(broad[None, :] + 0.018 * cloud(rng, SIZE, SIZE, 2, 1) + 0.018 * cloud(rng, SIZE, SIZE, 60, 60), 0, 1)
    )


def foliage(rng: Rng) -> Image:
    """Wallpaper with scattered sprigs of leaves."""
    image = tone(0.91 + 0.012 * cloud(rng, SIZE, SIZE, 2, 2), (0.98, 0.98, 0.94))
    for x, y in [(i * 128 + 64 * (j % 2) + 30, j * 64 + 32) for i in range(4) for j in range(8)]:
        lean = float(rng.uniform(-35, 35))
        green = np.array([0.52, 0.66, 0.56]) * rng.uniform(0.8, 1.12)
        for k in range(5):
            angle = lean - 90 + (-1) ** k * 42
            stem = np.array([x, y]) + (k - 2) * 11 * np.array([np.sin(np.radians(lean)), -np.cos(np.radians(lean))])
            center = stem + 11 * np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
            leaf = cv2.ellipse2Poly((0, 0), (12, 5), int(angle), 0, 360, 20)
            for dx in (-SIZE, 0, SIZE):
                for dy in (-SIZE, 0, SIZE):
                    cv2.fillConvexPoly(
                        image, np.add(leaf, np.add(center, (dx, dy)).astype(int)), green.tolist(), cv2.LINE_AA
                    )
    return np.clip(image, 0, 1)


def leaf(rng: Rng) -> Image:
    """A green leaf with veins."""
    y, x = np.mgrid[0:128, 0:128] / 128
    veins = np.clip(1 - 14 * np.abs((x * 8 + np.abs(y - 0.5) * 6) % 1 - 0.5), 0, 1) + np.clip(
        1 - 40 * np.abs(y - 0.5), 0, 1
    )
    gray = 0.78 + 0.08 * cloud(rng, 128, 128, 5, 5) + 0.18 * np.clip(veins, 0, 1)
    return tone(np.clip(gray, 0, 1))


def wicker(rng: Rng) -> Image:
    """Basket weave."""
    u, v, cell = _cells(16, 16, 0)
    over = (cell // 16 + cell % 16) % 2
    bulge = np.where(over == 1, np.sin(np.pi * v) * (0.8 + 0.2 * np.sin(6 * np.pi * u)), np.sin(np.pi * u))
    return tone(np.clip(0.42 + 0.45 * bulge * rng.uniform(0.85, 1.1, 256)[cell], 0, 1), (1, 0.93, 0.8))


def metal(rng: Rng) -> Image:
    """Brushed metal."""
    return tone(np.clip(0.82 + 0.05 * cloud(rng, 256, 256, 0.7, 30) + 0.03 * cloud(rng, 256, 256, 20, 40), 0, 1))


def cork(rng: Rng) -> Image:
    """Cork or bark."""
    gray = 0.72 + 0.08 * cloud(rng, SIZE, SIZE, 3, 3) + 0.06 * cloud(rng, SIZE, SIZE, 1, 1)
    dark = np.clip(cloud(rng, SIZE, SIZE, 4, 4) - 1.5, 0, 1) * 0.3
    return tone(np.clip(gray - dark, 0, 1), (1, 0.83, 0.63))


REPEATING: dict[str, Callable[[Rng], Image]] = {
    f.__name__: f
    for f in (
        plain, plaster, concrete, wood, planks, tiles, checker, bricks, terrazzo, marble, fabric, knit, plaid, quilt,
        carpet, curtain, stripes, foliage, leaf, wicker, metal, cork,
    )
}  # fmt: skip


@cache
def texture(name: str) -> Image:
    """The texture or picture of that name, [H, W, 3] in 0..1, always the same and read-only."""
    from .panels import PANELS
    from .pictures import PICTURES

    draw = {**REPEATING, **PICTURES, **PANELS}[name]
    image = draw(np.random.default_rng(zlib.crc32(name.encode())))
    image.setflags(write=False)
    return image
