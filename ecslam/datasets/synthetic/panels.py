"""Faces of things, stretched once: screens, rugs, book spines, fronts, doors, keys and dials."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from .pictures import canvas, grain
from .textures import Image, Rng, cloud, tone

SIZE = 512


def editor(rng: Rng) -> Image:
    """A computer screen full of code."""
    image = canvas((0.10, 0.12, 0.16))
    cv2.rectangle(image, (0, 0), (86, SIZE), (0.14, 0.16, 0.21), -1)
    palette = [(0.55, 0.78, 0.95), (0.95, 0.65, 0.45), (0.65, 0.9, 0.6), (0.8, 0.6, 0.95), (0.75, 0.78, 0.82)]
    for row in range(14, 500, 17):
        cv2.rectangle(image, (12, row), (12 + int(rng.integers(20, 62)), row + 6), (0.4, 0.43, 0.5), -1)
        x = 104 + 22 * int(rng.integers(0, 4))
        while x < rng.uniform(230, 480):
            width = int(rng.integers(12, 60))
            cv2.rectangle(image, (x, row), (min(x + width, 500), row + 7), palette[int(rng.integers(5))], -1)
            x += width + 9
    return image


def _pile(image: Image, rng: Rng) -> Image:
    return np.clip(image * (0.9 + 0.08 * cloud(rng, SIZE, SIZE, 1.2, 1.2))[..., None], 0, 1).astype(np.float32)


def oriental(rng: Rng) -> Image:
    """A rug with borders, a medallion and mirrored ornaments."""
    y, x = np.mgrid[0:SIZE, 0:SIZE] / (SIZE / 2) - 1
    ax, ay = np.abs(x), np.abs(y)
    edge = np.maximum(ax, ay)
    image = canvas((0.56, 0.13, 0.14))
    star = np.abs(ax) * 1.1 + ay * 0.75 + 0.06 * np.cos(14 * np.arctan2(ay, ax))
    bands = (
        (0.62, (0.13, 0.19, 0.34)),
        (0.53, (0.88, 0.76, 0.54)),
        (0.49, (0.62, 0.2, 0.16)),
        (0.28, (0.9, 0.8, 0.6)),
        (0.22, (0.15, 0.22, 0.38)),
    )
    for size, color in bands:
        image[star < size] = color
    motif = np.cos(26 * ax) * np.cos(26 * ay) + 0.5 * np.cos(52 * ax + 8 * ay)
    image[(motif > 0.85) & (star > 0.66)] = (0.86, 0.72, 0.48)
    image[(motif < -1.0) & (star > 0.66)] = (0.2, 0.3, 0.42)
    along = np.where(ax > ay, y, x)
    border = np.cos(40 * along) + np.cos(60 * (edge - 0.87))
    image[edge > 0.76] = (0.13, 0.18, 0.32)
    image[(edge > 0.79) & (border > 0.9)] = (0.85, 0.62, 0.38)
    image[(edge > 0.79) & (border < -1.1)] = (0.66, 0.22, 0.2)
    image[(edge > 0.745) & (edge < 0.77) | (edge > 0.955)] = (0.89, 0.79, 0.6)
    return _pile(image, rng)


def kilim(rng: Rng) -> Image:
    """A flat rug: rows of zigzags and diamonds in warm colours."""
    y, x = np.mgrid[0:SIZE, 0:SIZE] / SIZE
    palette = np.array(
        [[0.90, 0.86, 0.76], [0.76, 0.38, 0.26], [0.20, 0.33, 0.40], [0.86, 0.64, 0.30], [0.45, 0.24, 0.22]]
    )
    zigzag = np.abs((x * 8) % 1 - 0.5)
    image = palette[np.floor(y * 14 + zigzag * 2).astype(int) % 5]
    diamond = zigzag + np.abs((y * 7) % 1 - 0.5)
    image = np.where((diamond < 0.22)[..., None], palette[np.floor(y * 7).astype(int) * 2 % 5], image)
    return _pile(image.astype(np.float32), rng)


def spine(rng: Rng) -> Image:
    """The back of a book: title bars on cloth."""
    image = tone(0.82 + 0.04 * cloud(rng, 128, 64, 1, 3))
    for top, bottom in ((10, 14), (112, 118)):
        image[top:bottom] = (0.98, 0.9, 0.62)
    for row in (30, 42, 54):
        image[row : row + 7, 14 : 50 - int(rng.integers(0, 14))] = 0.99
    return np.clip(image, 0, 1)


def front(rng: Rng) -> Image:
    """A cabinet or door leaf with a raised panel."""
    image = tone(0.90 + 0.012 * cloud(rng, SIZE, SIZE, 8, 1))
    for inset, shade in ((0.0, 0.55), (0.02, 1.0), (0.13, 0.74), (0.145, 1.06), (0.175, 0.94)):
        k = int(inset * SIZE)
        image[k : SIZE - k, k : SIZE - k] = (
            shade * 0.9 + 0.012 * cloud(rng, SIZE - 2 * k, SIZE - 2 * k, 8, 1)[..., None]
        )
    return np.clip(image, 0, 1)


def door(rng: Rng) -> Image:
    """A wooden door with four panels."""
    grain = 0.80 + 0.05 * np.sin(7 * cloud(rng, SIZE, SIZE, 120, 7)) + 0.03 * cloud(rng, SIZE, SIZE, 20, 1)
    for top, bottom in ((30, 250), (290, 480)):
        for left, right in ((60, 236), (276, 452)):
            grain[top:bottom, left:right] *= 0.72
            grain[top + 8 : bottom, left + 12 : right] *= 1.30
            grain[top + 20 : bottom - 20, left + 30 : right - 30] *= 1.06
    return tone(np.clip(grain, 0, 1), (1, 0.96, 0.9))


def keyboard(rng: Rng) -> Image:
    """Rows of keys."""
    image = canvas((0.16, 0.17, 0.19), 128, 256)
    for row in range(5):
        for column in range(15):
            x, y = 4 + column * 17 - (row % 2) * 4, 6 + row * 24
            cv2.rectangle(image, (x, y), (x + 13, y + 19), (0.34, 0.35, 0.38), -1)
            cv2.rectangle(image, (x + 4, y + 5), (x + 8, y + 10), (0.8, 0.8, 0.82), -1)
    return grain(image, rng)


def dial(rng: Rng) -> Image:
    """A clock face."""
    image = canvas((0.96, 0.95, 0.91), 256, 256)
    for k in range(60):
        way = np.array([np.sin(k * np.pi / 30), -np.cos(k * np.pi / 30)])
        inner = 96 if k % 5 == 0 else 106
        a, b = np.int32(128 + inner * way), np.int32(128 + 114 * way)
        cv2.line(image, a.tolist(), b.tolist(), (0.1, 0.1, 0.12), 5 if k % 5 == 0 else 2, cv2.LINE_AA)
    for length, angle, width in ((58, 305, 8), (88, 60, 5)):
        tip = np.int32(128 + length * np.array([np.sin(np.radians(angle)), -np.cos(np.radians(angle))]))
        cv2.line(image, (128, 128), tip.tolist(), (0.12, 0.12, 0.15), width, cv2.LINE_AA)
    return grain(image, rng)


PANELS: dict[str, Callable[[Rng], Image]] = {
    f.__name__: f for f in (editor, oriental, kilim, spine, front, door, keyboard, dial)
}
