"""Shapes, textures and light packed into flat arrays that the compiled renderer reads."""

from __future__ import annotations

from collections.abc import Sequence as Many
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from .shapes import Shape
from .textures import Image, texture

LIGHT_SPACING_M = 0.06
MAX_LIGHT_NODES = 160


# Columns of Scene.numbers, and of Scene.values.
KIND, TEXEL_BITS, TEXEL_START, LIGHT_START, LIGHT_SIZE = 0, 1, 3, 15, 21
HALF, EXTRA, TINT, REPEAT, GLOW, TURN, SHIFT, ALBEDO = 0, 3, 4, 7, 8, 9, 10, 12
MIPS = 12


class Scene(NamedTuple):
    """A room as arrays, one row a shape, so that compiled code passes few of them around.

    numbers: int32 [N, 33]: kind; log2 of the texture's width and height; where each of its 12 mip levels starts in
    ``texels``; where the irradiance of each of the 6 faces starts in ``light``; their grids' (width, height). Faces are
    -x, +x, -y, +y, -z, +z; a point of a curved solid belongs to the face its normal is nearest to.
    values: float32 [N, 15]: half extents, extra, linear tint, repeat_m, glow, turn, shift (2), mean linear albedo.
    texels: uint32 [T], square root of linear RGB, 8 bits each, red lowest. light: float32 [M, 3], linear irradiance.
    rotation, center: float64 [N, 3, 3], [N, 3], local to world.
    """

    numbers: NDArray[np.int32]
    values: NDArray[np.float32]
    texels: NDArray[np.uint32]
    light: NDArray[np.float32]
    rotation: NDArray[np.float64]
    center: NDArray[np.float64]


def linear(display: NDArray[np.floating]) -> NDArray[np.float32]:
    """Display-referred values in 0..1 to linear light (gamma 2.2)."""
    return np.asarray(np.maximum(display, 0) ** 2.2, np.float32)


def pack(shapes: Many[Shape], lit: bool = True) -> Scene:
    """Lay shapes out for the renderer, with an even light of 1 everywhere (see ``lighting.bake`` for the real one).

    With ``lit`` false textures are left out too: enough for geometry.
    """
    names = sorted({s.paint.texture for s in shapes}) if lit else []
    texels, start, bits, means = _pack_textures([texture(n) for n in names])
    half = np.array([s.half for s in shapes], np.float32)
    tint = linear(np.array([s.paint.tint for s in shapes]))
    which = np.array([names.index(s.paint.texture) if lit else 0 for s in shapes])
    light_start, light_size, total = _light_layout(half)
    kind = np.array([s.kind for s in shapes], np.int32)
    extra = np.array([s.extra for s in shapes], np.float32)
    finish = np.array([_finish(s) for s in shapes], np.float32)
    return Scene(
        numbers=np.column_stack([kind, bits[which], start[which], light_start, light_size]),
        values=np.column_stack([half, extra, tint, finish, tint * means[which]]),
        texels=texels,
        light=np.ones((total, 3), np.float32),
        rotation=np.array([s.rotation for s in shapes], np.float64),
        center=np.array([s.center for s in shapes], np.float64),
    )


def _finish(shape: Shape) -> tuple[float, ...]:
    p = shape.paint
    return p.repeat_m, p.glow, float(p.turn), *p.shift


def _pack_textures(
    images: Many[Image],
) -> tuple[NDArray[np.uint32], NDArray[np.int32], NDArray[np.int32], NDArray[np.float32]]:
    start = np.zeros((max(len(images), 1), MIPS), np.int32)
    bits = np.zeros((max(len(images), 1), 2), np.int32)
    means = np.ones((max(len(images), 1), 3), np.float32)
    parts: list[NDArray[np.uint32]] = []
    total = 0
    for k, image in enumerate(images):
        level = linear(image)
        means[k] = level.mean((0, 1))
        bits[k] = level.shape[1].bit_length() - 1, level.shape[0].bit_length() - 1
        for mip in range(MIPS):
            start[k, mip] = total
            channels = np.rint(255 * np.sqrt(level)).astype(np.uint32).reshape(-1, 3)
            parts.append(channels[:, 0] | channels[:, 1] << 8 | channels[:, 2] << 16)
            total += len(parts[-1])
            if level.shape[0] == level.shape[1] == 1:
                start[k, mip:] = start[k, mip]
                break
            size = (max(level.shape[1] // 2, 1), max(level.shape[0] // 2, 1))
            halved = cv2.resize(level, size, interpolation=cv2.INTER_AREA)
            level = np.asarray(halved, np.float32).reshape(size[1], size[0], 3)
    return np.concatenate(parts) if parts else np.zeros(1, np.uint32), start, bits, means


def _light_layout(half: NDArray[np.float32]) -> tuple[NDArray[np.int32], NDArray[np.int32], int]:
    nodes = np.clip(np.ceil(2 * half / LIGHT_SPACING_M), 2, MAX_LIGHT_NODES).astype(np.int32)
    size = np.stack([nodes[:, [1, 2]], nodes[:, [0, 2]], nodes[:, [0, 1]]], 1).repeat(2, axis=1)
    count = size.prod(-1).ravel()
    start = np.concatenate([[0], np.cumsum(count)[:-1]]).astype(np.int32)
    return start.reshape(-1, 6), size.reshape(-1, 12), int(count.sum())
