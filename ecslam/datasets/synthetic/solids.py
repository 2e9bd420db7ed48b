"""Rays against one convex solid in its local frame: entry distance, normal, signed distance. Scalar numba, float32.

Directions need not be unit vectors: distances are in multiples of the direction.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from .shapes import BOX, ELLIPSOID, ROUND

F = np.float32
FAR = F(1e9)
ZERO, ONE, HALF = F(0), F(1), F(0.5)
TINY = F(1e-20)
FAST = {"nsz", "arcp", "contract", "reassoc"}

# Compiled without reference counts on the arrays passed in, which would be atomic and shared by all threads; such
# functions cannot allocate. What is not inlined is compiled for itself and with each caller, and need not round alike:
# which one runs depends on whether the caller was read from disk. So what makes pictures is inlined throughout.
_LEAN = {"fastmath": FAST, "error_model": "numpy", "nogil": True, "_nrt": False}
scalar = njit(forceinline=True, **_LEAN)
lean = njit(**_LEAN)
lean_entry = njit(cache=True, **_LEAN)


@scalar
def slab(hx, hy, hz, ox, oy, oz, dx, dy, dz):
    """(entry, exit) of a ray and the box |x| <= h; entry > exit means a miss."""
    ix, iy, iz = ONE / dx, ONE / dy, ONE / dz
    a, b = (-hx - ox) * ix, (hx - ox) * ix
    near, far = min(a, b), max(a, b)
    a, b = (-hy - oy) * iy, (hy - oy) * iy
    near, far = max(near, min(a, b)), min(far, max(a, b))
    a, b = (-hz - oz) * iz, (hz - oz) * iz
    return max(near, min(a, b)), min(far, max(a, b))


@scalar
def _enter_round(hx, hy, hz, r, ox, oy, oz, dx, dy, dz, far):
    """Newton on the distance to a rounded box: it is convex along a ray, so from outside no step overshoots."""
    cx, cy, cz = hx - r, hy - r, hz - r
    t = ZERO
    for _ in range(24):
        px, py, pz = ox + t * dx, oy + t * dy, oz + t * dz
        qx, qy, qz = abs(px) - cx, abs(py) - cy, abs(pz) - cz
        mx, my, mz = max(qx, ZERO), max(qy, ZERO), max(qz, ZERO)
        length = math.sqrt(mx * mx + my * my + mz * mz)
        f = length - r
        if f < F(4e-6):
            return t
        slope = (math.copysign(mx, px) * dx + math.copysign(my, py) * dy + math.copysign(mz, pz) * dz) / length
        if slope >= F(-1e-6):
            return FAR
        t -= f / slope
        if t > far:
            return FAR
    return FAR


@scalar
def _enter_ellipsoid(hx, hy, hz, ox, oy, oz, dx, dy, dz):
    ox, oy, oz = ox / hx, oy / hy, oz / hz
    dx, dy, dz = dx / hx, dy / hy, dz / hz
    dd = dx * dx + dy * dy + dz * dz
    s = -(ox * dx + oy * dy + oz * dz) / dd
    px, py, pz = ox + s * dx, oy + s * dy, oz + s * dz
    room = ONE - (px * px + py * py + pz * pz)
    if room <= ZERO:
        return FAR
    return s - math.sqrt(room / dd)


@scalar
def _enter_frustum(hx, hz, slope, ox, oy, oz, dx, dy, dz):
    middle = hx - abs(slope) * hz
    best = FAR
    if dz != ZERO:
        cap = -hz if dz > ZERO else hz
        t = (cap - oz) / dz
        x, y, r = ox + t * dx, oy + t * dy, middle + slope * cap
        if t >= F(-1e-4) and x * x + y * y <= r * r:
            best = t
    r = middle + slope * oz
    a = dx * dx + dy * dy - slope * slope * dz * dz
    b = ox * dx + oy * dy - slope * r * dz
    c = ox * ox + oy * oy - r * r
    disc = b * b - a * c
    if disc > ZERO and abs(a) > TINY:
        q = -(b + math.copysign(math.sqrt(disc), b))
        for t in (q / a, c / q):
            z = oz + t * dz
            if t >= F(-1e-4) and t < best and abs(z) <= hz and middle + slope * z > ZERO:
                best = t
    return best


@scalar
def enter(kind, hx, hy, hz, extra, ox, oy, oz, dx, dy, dz):
    """Distance at which a ray enters a solid: >= 0, or FAR when it misses, starts inside or has passed it."""
    near, far = slab(hx, hy, hz, ox, oy, oz, dx, dy, dz)
    if near > far or far < ZERO:
        return FAR
    if kind == BOX:
        return near if near >= ZERO else FAR
    start = max(near, ZERO)
    ox, oy, oz = ox + start * dx, oy + start * dy, oz + start * dz
    if kind == ROUND:
        t = _enter_round(hx, hy, hz, extra, ox, oy, oz, dx, dy, dz, far - start + F(1e-4))
    elif kind == ELLIPSOID:
        t = _enter_ellipsoid(hx, hy, hz, ox, oy, oz, dx, dy, dz)
    else:
        t = _enter_frustum(hx, hz, extra, ox, oy, oz, dx, dy, dz)
    return start + t if t < FAR and start + t >= ZERO else FAR


@scalar
def normal(kind, hx, hy, hz, extra, px, py, pz):
    """Outward unit normal at a point on the surface."""
    if kind == ELLIPSOID:
        nx, ny, nz = px / (hx * hx), py / (hy * hy), pz / (hz * hz)
    elif kind == BOX:
        ex, ey, ez = abs(px) - hx, abs(py) - hy, abs(pz) - hz
        nx = math.copysign(ONE, px) if ex >= ey and ex >= ez else ZERO
        ny = math.copysign(ONE, py) if ey > ex and ey >= ez else ZERO
        nz = math.copysign(ONE, pz) if ez > ex and ez > ey else ZERO
    elif kind == ROUND:
        nx = math.copysign(max(abs(px) - hx + extra, ZERO), px)
        ny = math.copysign(max(abs(py) - hy + extra, ZERO), py)
        nz = math.copysign(max(abs(pz) - hz + extra, ZERO), pz)
    else:
        radius = math.sqrt(px * px + py * py)
        side = radius - (hx - abs(extra) * hz + extra * pz)
        if abs(pz) - hz > side:
            nx, ny, nz = ZERO, ZERO, math.copysign(ONE, pz)
        else:
            nx, ny, nz = px / max(radius, TINY), py / max(radius, TINY), -extra
    scale = ONE / math.sqrt(max(nx * nx + ny * ny + nz * nz, TINY))
    return nx * scale, ny * scale, nz * scale


@scalar
def distance(kind, hx, hy, hz, extra, px, py, pz):
    """Signed distance to the surface, negative inside (ellipsoids: to first order, exact on the surface)."""
    if kind == ELLIPSOID:
        f = math.sqrt((px / hx) ** 2 + (py / hy) ** 2 + (pz / hz) ** 2)
        g = math.sqrt((px / (hx * hx)) ** 2 + (py / (hy * hy)) ** 2 + (pz / (hz * hz)) ** 2)
        return f * (f - ONE) / g if g > TINY else -min(hx, hy, hz)
    if kind in (BOX, ROUND):
        r = extra if kind == ROUND else ZERO
        qx, qy, qz = abs(px) - hx + r, abs(py) - hy + r, abs(pz) - hz + r
        outside = math.sqrt(max(qx, ZERO) ** 2 + max(qy, ZERO) ** 2 + max(qz, ZERO) ** 2)
        return outside + min(max(qx, qy, qz), ZERO) - r
    radius = math.sqrt(px * px + py * py)
    side = (radius - (hx - abs(extra) * hz + extra * pz)) / math.sqrt(ONE + extra * extra)
    return max(side, abs(pz) - hz)
