"""Pictures that are stretched once over a face: posters and the view from a window."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from .textures import Image, Rng, cloud

SIZE = 512


def rgb(red: float, green: float, blue: float) -> Image:
    """A colour as an array [3]."""
    return np.array([red, green, blue], np.float32)


def canvas(color: tuple[float, float, float], rows: int = SIZE, columns: int = SIZE) -> Image:
    """An image of one colour."""
    return np.full((rows, columns, 3), color, np.float32)


def _gradient(top: tuple[float, float, float], bottom: tuple[float, float, float]) -> Image:
    mix = np.linspace(0, 1, SIZE, dtype=np.float32)[:, None, None]
    return np.ascontiguousarray(np.broadcast_to(rgb(*top) * (1 - mix) + rgb(*bottom) * mix, (SIZE, SIZE, 3)))


def _ridge(rng: Rng, level: float, height: float, smooth: float) -> np.ndarray:
    """[SIZE] heights (0 top .. 1 bottom) of a mountain line."""
    return level - height * cloud(rng, 8, SIZE, 1, smooth)[0]


def _below(image: Image, line: np.ndarray, color: tuple[float, float, float]) -> None:
    edge = np.clip((np.arange(SIZE)[:, None] / SIZE - line[None, :]) * 200, 0, 1)[..., None]
    image[:] = image * (1 - edge) + rgb(*color) * edge


def grain(image: Image, rng: Rng, amount: float = 0.02) -> Image:
    """The image with a little multiplicative noise."""
    rows, columns = image.shape[:2]
    return np.clip(image * (1 + amount * cloud(rng, rows, columns, 1, 1))[..., None], 0, 1).astype(np.float32)


def outdoors(rng: Rng) -> Image:
    """The view from a window: sky with clouds, far hills, a row of trees."""
    image = _gradient((0.47, 0.69, 0.95), (0.90, 0.95, 0.99))
    puffs = np.clip(cloud(rng, SIZE, SIZE, 14, 38) * 0.7 + 0.3 * cloud(rng, SIZE, SIZE, 5, 9), 0, 1.4)[..., None]
    image = image * (1 - 0.55 * np.clip(puffs, 0, 1)) + 0.55 * np.clip(puffs, 0, 1)
    for level, color in ((0.60, (0.56, 0.68, 0.78)), (0.67, (0.45, 0.60, 0.55)), (0.76, (0.42, 0.58, 0.33))):
        _below(image, _ridge(rng, level, 0.025, 30), color)
    for _ in range(70):
        x, y = int(rng.integers(0, SIZE)), int(rng.normal(0.76, 0.03) * SIZE)
        green = np.array([0.25, 0.42, 0.2]) * rng.uniform(0.7, 1.5)
        for _ in range(12):
            spot = (x + int(rng.normal(0, 7)), y - int(abs(rng.normal(0, 14))))
            cv2.circle(image, spot, int(rng.integers(3, 9)), (green * rng.uniform(0.8, 1.3)).tolist(), -1, cv2.LINE_AA)
    return grain(image, rng)


def sunset(rng: Rng) -> Image:
    """Poster: a low sun over layered hills."""
    image = _gradient((0.98, 0.72, 0.42), (0.95, 0.43, 0.36))
    cv2.circle(image, (330, 210), 78, (1.0, 0.93, 0.72), -1, cv2.LINE_AA)
    hills = (
        (0.5, (0.72, 0.33, 0.38)),
        (0.62, (0.5, 0.25, 0.38)),
        (0.74, (0.31, 0.18, 0.33)),
        (0.86, (0.15, 0.12, 0.24)),
    )
    for level, color in hills:
        _below(image, _ridge(rng, level, 0.04, 26), color)
    return grain(image, rng)


def alps(rng: Rng) -> Image:
    """Poster: snowy peaks above a lake."""
    image = _gradient((0.25, 0.46, 0.68), (0.80, 0.89, 0.93))
    peaks = _ridge(rng, 0.47, 0.10, 24) + 0.012 * cloud(rng, 8, SIZE, 1, 3)[0]
    _below(image, peaks, (0.96, 0.97, 1.0))
    _below(image, peaks + 0.10 + 0.03 * cloud(rng, 8, SIZE, 1, 3)[0], (0.42, 0.47, 0.58))
    _below(image, _ridge(rng, 0.72, 0.03, 8), (0.14, 0.30, 0.28))
    _below(image, np.full(SIZE, 0.80), (0.25, 0.52, 0.62))
    rows = np.arange(SIZE)[:, None]
    ripple = np.where(rows > 0.8 * SIZE, 0.12 * np.clip(cloud(rng, SIZE, SIZE, 1.5, 22) - 0.6, 0, 1), 0)
    return grain(image + ripple[..., None].astype(np.float32), rng)


def blocks(rng: Rng) -> Image:
    """Poster: primary-coloured rectangles between black bars."""
    image = canvas((0.95, 0.93, 0.87))
    xs, ys = [0, 70, 200, 330, 440, 512], [0, 110, 180, 330, 430, 512]
    palette = [(0.82, 0.16, 0.14), (0.13, 0.28, 0.62), (0.96, 0.79, 0.19), (0.95, 0.93, 0.87), (0.95, 0.93, 0.87)]
    for i in range(5):
        for j in range(5):
            cv2.rectangle(image, (xs[i], ys[j]), (xs[i + 1], ys[j + 1]), palette[int(rng.integers(5))], -1)
    for x in xs[1:-1]:
        cv2.line(image, (x, 0), (x, SIZE), (0.07, 0.07, 0.08), 11)
    for y in ys[1:-1]:
        cv2.line(image, (0, y), (SIZE, y), (0.07, 0.07, 0.08), 11)
    return grain(image, rng)


def circles(rng: Rng) -> Image:
    """Poster: concentric rings in a grid of coloured squares."""
    image = canvas((0.9, 0.86, 0.78))
    for i in range(4):
        for j in range(4):
            corner = (i * 128, j * 128)
            cv2.rectangle(image, corner, (corner[0] + 128, corner[1] + 128), rng.uniform(0.25, 0.95, 3).tolist(), -1)
            for radius in (56, 44, 31, 18, 8):
                color = np.clip(rng.uniform(0.1, 1, 3) * [1.1, 0.9, 0.8], 0, 1).tolist()
                cv2.circle(image, (corner[0] + 64, corner[1] + 64), radius, color, -1, cv2.LINE_AA)
    return grain(image, rng, 0.04)


def waves(rng: Rng) -> Image:
    """Poster: curved bands of blue."""
    y, x = np.mgrid[0:SIZE, 0:SIZE] / SIZE
    phase = (y * 9 + 0.8 * np.sin(2 * np.pi * x * 1.3 + 4 * y) + 0.25 * np.sin(9 * x)).astype(np.float32)
    palette = np.array(
        [[0.08, 0.2, 0.36], [0.16, 0.42, 0.58], [0.95, 0.9, 0.78], [0.45, 0.69, 0.72], [0.9, 0.55, 0.36]]
    )
    return grain(palette[np.floor(phase).astype(int) % 5].astype(np.float32), rng)


def botanic(rng: Rng) -> Image:
    """Poster: a plant study on cream paper."""
    image = canvas((0.95, 0.92, 0.84))
    for base, bend, green in (
        (190, -0.35, (0.24, 0.42, 0.28)),
        (270, 0.1, (0.35, 0.52, 0.30)),
        (330, 0.5, (0.18, 0.34, 0.30)),
    ):
        for k in range(16):
            s = k / 16
            point = np.array([base + bend * 260 * s * s, 470 - 400 * s])
            for side in (-1, 1):
                angle = -90 + side * (62 - 20 * s) + 30 * bend
                reach = 52 * (1 - 0.7 * s)
                center = point + reach * np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
                shade = (np.array(green) * rng.uniform(0.8, 1.25)).tolist()
                cv2.ellipse(
                    image,
                    (int(center[0]), int(center[1])),
                    (int(reach), int(reach * 0.24)),
                    angle,
                    0,
                    360,
                    shade,
                    -1,
                    cv2.LINE_AA,
                )
    cv2.rectangle(image, (22, 22), (490, 490), (0.55, 0.5, 0.4), 2, cv2.LINE_AA)
    return grain(image, rng)


def skyline(rng: Rng) -> Image:
    """Poster: a city at night."""
    image = _gradient((0.08, 0.10, 0.25), (0.62, 0.36, 0.46))
    cv2.circle(image, (120, 100), 36, (0.97, 0.94, 0.82), -1, cv2.LINE_AA)
    for shade in (0.30, 0.16, 0.07):
        x = -10
        while x < SIZE:
            width, top = int(rng.integers(34, 74)), int(rng.uniform(0.38, 0.72) * SIZE + (0.3 - shade) * 260)
            cv2.rectangle(image, (x, top), (x + width, SIZE), (shade, shade * 0.9, shade * 1.4), -1)
            for wx in range(x + 6, x + width - 6, 11):
                for wy in range(top + 8, SIZE, 15):
                    if rng.random() < 0.45:
                        cv2.rectangle(image, (wx, wy), (wx + 4, wy + 7), (0.99, 0.85, 0.5), -1)
            x += width + int(rng.integers(0, 8))
    return grain(image, rng)


def atlas(rng: Rng) -> Image:
    """Poster: a map with coast lines, a grid and towns."""
    height = cloud(rng, SIZE, SIZE, 42, 42) + 0.35 * cloud(rng, SIZE, SIZE, 10, 10)
    image = np.where(height[..., None] > 0.2, rgb(0.86, 0.83, 0.66), rgb(0.60, 0.76, 0.83)).astype(np.float32)
    image = np.where(height[..., None] > 0.9, rgb(0.66, 0.74, 0.50), image)
    image = np.where(height[..., None] > 1.6, rgb(0.72, 0.56, 0.42), image)
    image[np.abs(height - 0.2) < 0.04] = (0.25, 0.35, 0.42)
    for k in range(64, SIZE, 64):
        cv2.line(image, (k, 0), (k, SIZE), (0.5, 0.55, 0.58), 1)
        cv2.line(image, (0, k), (SIZE, k), (0.5, 0.55, 0.58), 1)
    for _ in range(40):
        x, y = rng.integers(20, 490, 2)
        cv2.circle(image, (int(x), int(y)), int(rng.integers(2, 6)), (0.75, 0.15, 0.12), -1, cv2.LINE_AA)
    return grain(image, rng)


PICTURES: dict[str, Callable[[Rng], Image]] = {
    f.__name__: f for f in (outdoors, sunset, alps, blocks, circles, waves, botanic, skyline, atlas)
}
