"""The colour of a surface point: texture times irradiance. It depends on the point alone, never on the viewer."""

from __future__ import annotations

import numpy as np

from .scene import (
    EXTRA,
    GLOW,
    HALF,
    KIND,
    LIGHT_SIZE,
    LIGHT_START,
    MIPS,
    REPEAT,
    SHIFT,
    TEXEL_BITS,
    TEXEL_START,
    TINT,
    TURN,
)
from .solids import ONE, ZERO, F, scalar

MIDDLE = F(0.5)
at = np.uint64  # an unsigned index compiles to a plain load


@scalar
def face_of(nx, ny, nz):
    """0..5 for the axis (-x, +x, -y, +y, -z, +z) a normal is nearest to."""
    ax, ay, az = abs(nx), abs(ny), abs(nz)
    if az >= ax and az >= ay:
        return 5 if nz > ZERO else 4
    if ay >= ax:
        return 3 if ny > ZERO else 2
    return 1 if nx > ZERO else 0


@scalar
def face_uv(face, px, py, pz):
    """The two coordinates along a face."""
    return py if face < 2 else px, py if face >= 4 else pz


@scalar
def solid(numbers, values, k):
    """(kind, half x, y, z, extra) of a shape."""
    k = at(k)
    return numbers[k, KIND], values[k, HALF], values[k, HALF + 1], values[k, HALF + 2], values[k, EXTRA]


@scalar
def finish(numbers, values, k):
    """What ``shade`` needs to know of a shape, read once for a run of pixels."""
    k = at(k)
    extent = ONE / values[k, HALF], ONE / values[k, HALF + 1], ONE / values[k, HALF + 2]
    repeat = values[k, REPEAT]
    pattern = ONE / repeat if repeat > ZERO else ZERO, values[k, SHIFT], values[k, SHIFT + 1], values[k, TURN]
    scale = F(1 / (255 * 4096) ** 2)
    tint = scale * values[k, TINT], scale * values[k, TINT + 1], scale * values[k, TINT + 2]
    return k, extent, pattern, tint, values[k, GLOW], numbers[k, TEXEL_BITS], numbers[k, TEXEL_BITS + 1]


@scalar
def irradiance(numbers, light, k, face, a, b):
    """Linear RGB light at (a, b) in 0..1 on a face, bilinear between the grid's cell centres."""
    nu, nv = numbers[k, at(LIGHT_SIZE + 2 * face)], numbers[k, at(LIGHT_SIZE + 1 + 2 * face)]
    u = min(max(a * F(nu) - MIDDLE, ZERO), F(nu - 1))
    v = min(max(b * F(nv) - MIDDLE, ZERO), F(nv - 1))
    i, j = min(np.int64(u), nu - 2), min(np.int64(v), nv - 2)
    u -= F(i)
    v -= F(j)
    first = numbers[k, at(LIGHT_START + face)] + j * nu + i
    p, q, r, s = at(first), at(first + 1), at(first + nu), at(first + nu + 1)
    w00, w10, w01, w11 = (ONE - u) * (ONE - v), u * (ONE - v), (ONE - u) * v, u * v
    red = w00 * light[p, 0] + w10 * light[q, 0] + w01 * light[r, 0] + w11 * light[s, 0]
    green = w00 * light[p, 1] + w10 * light[q, 1] + w01 * light[r, 1] + w11 * light[s, 1]
    blue = w00 * light[p, 2] + w10 * light[q, 2] + w01 * light[r, 2] + w11 * light[s, 2]
    return red, green, blue


@scalar
def _floor(x):
    """As math.floor, which would be a call into the C library."""
    i = np.int64(x)
    return i - np.int64(F(i) > x)


@scalar
def _lanes(texel):
    """Spread 8-bit red, green, blue over 21-bit lanes of one word, so that one product weighs all three."""
    t = np.uint64(texel)
    return (t & np.uint64(0xFF)) | (t & np.uint64(0xFF00)) << np.uint64(13) | (t & np.uint64(0xFF0000)) << np.uint64(26)


@scalar
def _texel(texels, start, bits_u, bits_v, u, v, stretched):
    """Bilinear lookup in one mip level, in 1/64 of a texel; u, v in repeats; each channel times 4096."""
    wide, high = np.int64(1) << bits_u, np.int64(1) << bits_v
    x, y = u * F(wide) - MIDDLE, v * F(high) - MIDDLE
    if stretched:
        x, y = min(max(x, ZERO), F(wide - 1)), min(max(y, ZERO), F(high - 1))
    sub_x, sub_y = _floor(x * F(64)), _floor(y * F(64))
    i, j = sub_x >> 6, sub_y >> 6
    i0, i1 = i & (wide - 1), (i + 1) & (wide - 1)
    row0, row1 = start + ((j & (high - 1)) << bits_u), start + (((j + 1) & (high - 1)) << bits_u)
    fx, fy = np.uint64(sub_x & 63), np.uint64(sub_y & 63)
    gx, gy = np.uint64(64) - fx, np.uint64(64) - fy
    top = gx * _lanes(texels[at(row0 + i0)]) + fx * _lanes(texels[at(row0 + i1)])
    bottom = gx * _lanes(texels[at(row1 + i0)]) + fx * _lanes(texels[at(row1 + i1)])
    both = gy * top + fy * bottom
    mask = np.uint64(0x1FFFFF)
    return F(np.int64(both & mask)), F(np.int64(both >> np.uint64(21) & mask)), F(np.int64(both >> np.uint64(42)))


@scalar
def _log2(x):
    """Within 0.005, from the bits of a positive float32."""
    bits = F(x).view(np.int32)
    mantissa = np.int32((bits & 0x7FFFFF) | 0x3F800000).view(np.float32)
    return F((bits >> 23) - 127) + (F(-0.344845) * mantissa + F(2.024658)) * mantissa - F(1.674873)


@scalar
def shade(numbers, texels, light, look, px, py, pz, face, footprint4):
    """Linear RGB radiance at a local point on a face of a shape with ``finish`` look.

    footprint4: fourth power of the width in metres over which to average the texture (saves the square roots).
    """
    k, extent, pattern, tint, glow, bits_u, bits_v = look
    pu, pv = face_uv(face, px, py, pz)
    eu, ev = face_uv(face, extent[0], extent[1], extent[2])
    a, b = MIDDLE + MIDDLE * pu * eu, MIDDLE + MIDDLE * pv * ev
    stretched = pattern[0] <= ZERO
    density = MIDDLE * eu if stretched else pattern[0]
    u = a if stretched else pu * pattern[0] + pattern[1]
    v = ONE - b if stretched else pattern[2] - pv * pattern[0]
    if pattern[3] > ZERO:
        u, v = v, u
    density *= density
    blur = F(0.25) * _log2(max(footprint4 * density * density, F(1e-36))) + F(bits_u)
    blur = min(max(blur, ZERO), F(MIPS - 1.01))
    level = np.int64(blur)
    mix = blur - F(level)
    start0, start1 = numbers[k, at(TEXEL_START + level)], numbers[k, at(TEXEL_START + 1 + level)]
    r0, g0, b0 = _texel(texels, start0, max(bits_u - level, 0), max(bits_v - level, 0), u, v, stretched)
    r1, g1, b1 = _texel(texels, start1, max(bits_u - level - 1, 0), max(bits_v - level - 1, 0), u, v, stretched)
    red, green, blue = r0 + mix * (r1 - r0), g0 + mix * (g1 - g0), b0 + mix * (b1 - b0)
    er = eg = eb = glow
    if glow <= ZERO:
        er, eg, eb = irradiance(numbers, light, k, face, a, b)
    return red * red * tint[0] * er, green * green * tint[1] * eg, blue * blue * tint[2] * eb
