"""Light baked once per room: soft shadows from area lights and two diffuse bounces, on a grid over every face."""

from __future__ import annotations

import math
from collections.abc import Sequence as Many
from pathlib import Path

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from ...compiled import drop_stale
from .scene import ALBEDO, GLOW, LIGHT_SIZE, LIGHT_START, Scene
from .shapes import BOX, Light
from .solids import FAR, FAST, ONE, ZERO, F, enter, lean_entry, normal, scalar
from .surface import at, face_of, irradiance, solid
from .tracing import build, buried, to_local, trace
from .workers import spread

SHADOW_RAYS, FIRST_RAYS, SECOND_RAYS = 8, 12, 36
LIFT_M = 0.002
AMBIENT = 0.02
MEAN_DISPLAY = 0.30
CHUNK = 1024
MIDDLE = F(0.5)


def bake(scene: Scene, lights: Many[Light], interior: NDArray[np.float64]) -> Scene:
    """The same scene with its irradiance; only surfaces inside the box ``interior`` [2, 3] are lit."""
    tracer = build(scene)
    owner = _owners(scene)
    point, up, seen = _grid_points(scene.numbers, scene.values, *tracer, owner, scene.rotation, scene.center, interior)
    lamps = np.array([np.concatenate([x.center, *x.half, x.normal, x.power, *x.reach]) for x in lights], np.float32)
    order = np.flatnonzero(seen)
    common = (scene.numbers, scene.values, *tracer, point, up)
    parts = np.array_split(order, max(1, len(order) // CHUNK))
    direct, once, bounced = (np.zeros((len(point), 3), np.float32) for _ in range(3))
    spread(lambda i: _direct(*common, parts[i], lamps, direct), len(parts))
    direct = _smooth(scene, direct, seen, 1)
    spread(lambda i: _gather(*common, parts[i], direct, FIRST_RAYS, once), len(parts))
    once = _smooth(scene, direct + once, seen, 0)
    spread(lambda i: _gather(*common, parts[i], once, SECOND_RAYS, bounced), len(parts))
    bounced = _smooth(scene, bounced, seen, 2)
    light = direct + bounced
    return scene._replace(light=np.ascontiguousarray(light * _exposure(scene, light, seen, owner), np.float32))


def _owners(scene: Scene) -> NDArray[np.int32]:
    """int32 [M, 4]: shape, face and cell (i, j) of each node of the light grids."""
    size = scene.numbers[:, LIGHT_SIZE:].reshape(-1, 2)
    count = size.prod(1)
    face = np.repeat(np.arange(len(size)), count)
    inner = np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count)
    width = size[face, 0]
    return np.stack([face // 6, face % 6, inner % width, inner // width], 1).astype(np.int32)


def _exposure(scene: Scene, light: NDArray[np.float32], seen: NDArray[np.bool_], owner: NDArray[np.int32]) -> float:
    """Factor that brings the mean radiance of what can be seen to MEAN_DISPLAY."""
    albedo = scene.values[owner[:, 0], ALBEDO:]
    return float(MEAN_DISPLAY / max(float((albedo * light)[seen].mean()), 1e-6))


def _smooth(scene: Scene, light: NDArray[np.float32], seen: NDArray[np.bool_], passes: int) -> NDArray[np.float32]:
    """Fill nodes that nobody sees from their neighbours and blur each grid a little."""
    out = light.copy()
    starts, sizes = scene.numbers[:, LIGHT_START:LIGHT_SIZE].ravel(), scene.numbers[:, LIGHT_SIZE:].reshape(-1, 2)
    for start, (width, height) in zip(starts, sizes, strict=True):
        part = slice(start, start + width * height)
        mask = seen[part].reshape(height, width).astype(np.float32)
        if mask.any():
            out[part] = _fill(out[part].reshape(height, width, 3), mask, passes).reshape(-1, 3)
    return out


def _fill(grid: NDArray[np.float32], mask: NDArray[np.float32], passes: int) -> NDArray[np.float32]:
    def blur(image: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.asarray(cv2.GaussianBlur(image, (3, 3), 0.8, borderType=cv2.BORDER_REPLICATE), np.float32)

    for _ in range(passes):
        weight = np.maximum(blur(mask), 1e-6)[..., None]
        grid = np.where(mask[..., None] > 0, blur(grid * mask[..., None]) / weight, grid)
    while not mask.all():
        weight = blur(mask)
        spread = blur(grid * mask[..., None]) / np.maximum(weight, 1e-6)[..., None]
        grid = np.where(mask[..., None] > 0, grid, spread)
        mask = (weight > 1e-4).astype(np.float32)
    return grid


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _grid_points(numbers, values, box, skip, leaf, local, owner, rotation, center, interior):
    """World points and normals float32 [M, 3] of the nodes, and whether each is on the visible surface."""
    count = len(owner)
    point, up = np.zeros((count, 3), np.float32), np.zeros((count, 3), np.float32)
    seen = np.zeros(count, np.bool_)
    p, n = np.empty(3), np.empty(3)
    for m in range(count):
        k, face = owner[m, 0], owner[m, 1]
        kind, hx, hy, hz, extra = solid(numbers, values, k)
        a = (F(owner[m, 2]) + MIDDLE) / F(numbers[k, LIGHT_SIZE + 2 * face]) * F(2) - ONE
        b = (F(owner[m, 3]) + MIDDLE) / F(numbers[k, LIGHT_SIZE + 1 + 2 * face]) * F(2) - ONE
        side = ONE if face & 1 else -ONE
        if face < 2:
            p[0], p[1], p[2] = side * hx, a * hy, b * hz
        elif face < 4:
            p[0], p[1], p[2] = a * hx, side * hy, b * hz
        else:
            p[0], p[1], p[2] = a * hx, b * hy, side * hz
        if kind != BOX:
            d = np.zeros(3)
            d[face // 2] = -side
            t = enter(
                kind, hx, hy, hz, extra, F(p[0] - d[0]), F(p[1] - d[1]), F(p[2] - d[2]), F(d[0]), F(d[1]), F(d[2])
            )
            if t >= FAR:
                continue
            p[face // 2] += d[face // 2] * (t - ONE)
        n[0], n[1], n[2] = normal(kind, hx, hy, hz, extra, F(p[0]), F(p[1]), F(p[2]))
        for i in range(3):
            up[m, i] = rotation[k, i, 0] * n[0] + rotation[k, i, 1] * n[1] + rotation[k, i, 2] * n[2]
            at_surface = rotation[k, i, 0] * p[0] + rotation[k, i, 1] * p[1] + rotation[k, i, 2] * p[2] + center[k, i]
            point[m, i] = at_surface + LIFT_M * up[m, i]
        x, y, z = point[m, 0], point[m, 1], point[m, 2]
        inside = (
            interior[0, 0] < x < interior[1, 0]
            and interior[0, 1] < y < interior[1, 1]
            and interior[0, 2] < z < interior[1, 2]
        )
        seen[m] = inside and not buried(numbers, values, box, skip, leaf, local, x, y, z, k)
    return point, up, seen


@scalar
def _scatter(m, sample):
    """Three numbers in 0..1, well spread over the samples of one node and independent between nodes."""
    seed = np.uint64(m) * np.uint64(0x9E3779B97F4A7C15)
    seed ^= seed >> np.uint64(31)
    seed *= np.uint64(0xBF58476D1CE4E5B9)
    seed ^= seed >> np.uint64(27)
    unit = 1.0 / (1 << 21)
    a = (seed & np.uint64(0x1FFFFF)) * unit + 0.8191725133961645 * sample
    b = ((seed >> np.uint64(21)) & np.uint64(0x1FFFFF)) * unit + 0.6710436067037893 * sample
    c = (seed >> np.uint64(43)) * unit + 0.5497004779019703 * sample
    return F(a - math.floor(a)), F(b - math.floor(b)), F(c - math.floor(c))


@lean_entry
def _direct(numbers, values, box, skip, leaf, local, point, up, nodes, lamps, out):
    """Add to out [M, 3] the irradiance straight from the lights at some nodes."""
    for m in nodes:
        x, y, z = point[m, 0], point[m, 1], point[m, 2]
        for w in range(len(lamps)):
            q = lamps[w]
            if not (q[18] <= x <= q[21] and q[19] <= y <= q[22] and q[20] <= z <= q[23]):
                continue
            total = ZERO
            for sample in range(SHADOW_RAYS):
                a, b, c = _scatter(m, sample)
                a, b, c = a * F(2) - ONE, b * F(2) - ONE, c * F(2) - ONE
                dx = q[0] + a * q[3] + b * q[6] + c * q[9] - x
                dy = q[1] + a * q[4] + b * q[7] + c * q[10] - y
                dz = q[2] + a * q[5] + b * q[8] + c * q[11] - z
                far = math.sqrt(dx * dx + dy * dy + dz * dz)
                dx, dy, dz = dx / far, dy / far, dz / far
                weight = dx * up[m, 0] + dy * up[m, 1] + dz * up[m, 2]
                if q[12] != ZERO or q[13] != ZERO or q[14] != ZERO:
                    weight *= max(-(dx * q[12] + dy * q[13] + dz * q[14]), ZERO)
                if weight <= ZERO:
                    continue
                k, _ = trace(numbers, values, box, skip, leaf, local, x, y, z, dx, dy, dz, far - F(0.01), True)
                if k < 0:
                    total += weight / (far * far + F(0.05))
            for i in range(3):
                out[m, i] += total * q[15 + i] * F(1.0 / SHADOW_RAYS)
    return out


@lean_entry
def _gather(numbers, values, box, skip, leaf, local, point, up, nodes, light, rays, out):
    """Write to out [M, 3] the irradiance that arrives at some nodes from other surfaces lit by ``light``."""
    for m in nodes:
        red, green, blue = ZERO, ZERO, ZERO
        nx, ny, nz = up[m, 0], up[m, 1], up[m, 2]
        x, y, z = point[m, 0], point[m, 1], point[m, 2]
        for sample in range(rays):
            a, b, _ = _scatter(m, sample + 100)
            s, height = F(2 * math.pi) * a, F(2) * b - ONE
            ring = math.sqrt(max(ONE - height * height, ZERO))
            dx, dy, dz = nx * F(1.001) + ring * math.cos(s), ny * F(1.001) + ring * math.sin(s), nz * F(1.001) + height
            scale = ONE / math.sqrt(dx * dx + dy * dy + dz * dz + F(1e-12))
            dx, dy, dz = dx * scale, dy * scale, dz * scale
            k, t = trace(numbers, values, box, skip, leaf, local, x, y, z, dx, dy, dz, F(100), False)
            if k < 0:
                red, green, blue = red + F(AMBIENT), green + F(AMBIENT), blue + F(AMBIENT)
            elif values[k, GLOW] <= ZERO:
                r, g, bl = _bounce(numbers, values, local, light, k, x + t * dx, y + t * dy, z + t * dz)
                red, green, blue = red + r, green + g, blue + bl
        out[m, 0], out[m, 1], out[m, 2] = red / F(rays), green / F(rays), blue / F(rays)
    return out


@scalar
def _bounce(numbers, values, local, light, k, x, y, z):
    """Light that shape k sends on from a world point on it, with its mean colour."""
    kind, hx, hy, hz, extra = solid(numbers, values, k)
    px, py, pz = to_local(local, k, x, y, z, ONE)
    nx, ny, nz = normal(kind, hx, hy, hz, extra, px, py, pz)
    face = face_of(nx, ny, nz)
    a = MIDDLE + MIDDLE * (py / hy if face < 2 else px / hx)
    b = MIDDLE + MIDDLE * (py / hy if face >= 4 else pz / hz)
    r, g, bl = irradiance(numbers, light, at(k), face, a, b)
    return r * values[k, ALBEDO], g * values[k, ALBEDO + 1], bl * values[k, ALBEDO + 2]


drop_stale(Path(__file__).parent, _direct.stats.cache_path)
