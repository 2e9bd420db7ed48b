"""Triton kernels for gradients in space: TSDF and luminance with theirs at points, and the sums of direct alignment."""

from __future__ import annotations

import triton
import triton.language as tl

from ._gpu_decoders import decode, into_features, into_hidden, layer_one, through_blob
from ._gpu_field import gather, on_box, one_blob, place, pull
from ._gpu_points import moved, triple

RED, GREEN, BLUE = tl.constexpr(0.299), tl.constexpr(0.587), tl.constexpr(0.114)
SUMS = 67  # [8, 8] products of (jacobian, residual, 0), then cost, used, inliers


@triton.jit
def into_world(field, hidden, d_out, at, fraction, slope, inside, live, shape: tl.constexpr):
    """Gradient by the world position, per metre (x, y, z: [P] each), from those of the outputs before their sigmoid."""
    d_hidden = into_hidden(field, hidden, d_out)
    d_features = into_features(field, d_hidden, shape)
    d_even, d_odd = tl.split(tl.reshape(d_features, [d_features.shape[0], shape.width, 2]))
    gx, gy, gz = pull(field, at, fraction, d_even, d_odd, live, shape)
    bx, by, bz = through_blob(field, d_hidden, slope, shape)
    return (gx + bx) * inside[0], (gy + by) * inside[1], (gz + bz) * inside[2]


@triton.jit
def both_gradients(field, world, live, colour: tl.constexpr, shape: tl.constexpr):
    """TSDF and its gradient, luminance and (if ``colour``, else anything) its gradient, at world positions."""
    x, y, z = on_box(field, world[0], 0, shape), on_box(field, world[1], 1, shape), on_box(field, world[2], 2, shape)
    at, fraction = place(field, (x[0], y[0], z[0]), (x[1], y[1], z[1]), shape)
    inside = x[3], y[3], z[3]
    blob, slope = one_blob((x[2], y[2], z[2]), shape)
    even, odd, _, _ = gather(field, at, fraction, live, shape)
    hidden = layer_one(field, tl.interleave(even, odd), blob, shape)
    sdf, red, green, blue = decode(field, hidden)
    luminance = RED * red + GREEN * green + BLUE * blue
    one, none = tl.full(sdf.shape, 1, tl.float32), tl.zeros_like(sdf)
    gx, gy, gz = tl.zeros_like(sdf), tl.zeros_like(sdf), tl.zeros_like(sdf)
    sdf_x, sdf_y, sdf_z = gx, gy, gz
    # A loop that stays a loop: written out, all its gathers would be merged and their results kept in registers.
    for k in range(2 if colour else 1):
        d_red, d_green, d_blue = RED * red * (1 - red), GREEN * green * (1 - green), BLUE * blue * (1 - blue)
        d_color = tl.where(k == 0, none, d_red), tl.where(k == 0, none, d_green), tl.where(k == 0, none, d_blue)
        d_out = tl.where(k == 0, one, none), d_color[0], d_color[1], d_color[2]
        gx, gy, gz = into_world(field, hidden, d_out, at, fraction, slope, inside, live, shape)
        sdf_x, sdf_y, sdf_z = tl.where(k == 0, gx, sdf_x), tl.where(k == 0, gy, sdf_y), tl.where(k == 0, gz, sdf_z)
    return sdf, (sdf_x, sdf_y, sdf_z), luminance, (gx, gy, gz)


@triton.jit(do_not_specialize=["total"])
def gradients_kernel(
    field, points, total, sdf, d_sdf, luminance, d_luminance, shape: tl.constexpr, block: tl.constexpr
):  # fmt: skip
    """TSDF [N], its gradient [N, 3], luminance [N], its gradient [N, 3] at ``points.position`` [N, 3] in the world."""
    i = tl.program_id(0) * block + tl.arange(0, block)
    live = i < total
    found = both_gradients(field, triple(points.position + 3 * i, live), live, True, shape)
    tl.store(sdf + i, found[0], live)
    tl.store(luminance + i, found[2], live)
    for k in tl.static_range(3):
        tl.store(d_sdf + 3 * i + k, found[1][k], live)
        tl.store(d_luminance + 3 * i + k, found[3][k], live)


@triton.jit
def robust(residual, kernel):
    """Geman-McClure of residuals, float64: share k^2 / (k^2 + r^2); the weight is its square."""
    return kernel * kernel / (kernel * kernel + residual * residual)


@triton.jit
def add_products(sums, residual, gradient, lever, kernel, keep):
    """Add one residual a point, with its gradient by the world position, to the sums; returns the shares."""
    r = residual.to(tl.float64)
    gx, gy, gz = gradient[0].to(tl.float64), gradient[1].to(tl.float64), gradient[2].to(tl.float64)
    x, y, z = lever
    j3, j4, j5 = y * gz - z * gy, z * gx - x * gz, x * gy - y * gx
    column = tl.arange(0, 8)[None, :]
    v = tl.where(column == 0, gx[:, None], tl.where(column == 1, gy[:, None], 0.0))
    v = tl.where(column == 2, gz[:, None], tl.where(column == 3, j3[:, None], v))
    v = tl.where(column == 4, j4[:, None], tl.where(column == 5, j5[:, None], v))
    v = tl.where(column == 6, r[:, None], v)
    share = tl.where(keep, robust(r, kernel), 0.0)
    products = tl.sum((share * share)[:, None, None] * v[:, :, None] * v[:, None, :], 0)
    row, column = tl.arange(0, 8)[:, None], tl.arange(0, 8)[None, :]
    tl.atomic_add(sums + 8 * row + column, products, (row < 6) & (column < 7), sem="relaxed")
    tl.atomic_add(sums + 64, tl.sum(0.5 * r * r * share), sem="relaxed")
    return share


@triton.jit
def add_points(sums, value, gradient, light, d_light, seen, lever, settings, live, colour: tl.constexpr):
    """Add points to ``sums`` float64 [67]: TSDF with its gradient per metre and, with ``colour``, luminance with
    its own against the one that was ``seen``. settings: the fields of ``AlignSettings`` in their order."""
    truncation, near, limit, low, high, scale, colour_kernel = settings
    gx, gy, gz = gradient[0] * truncation, gradient[1] * truncation, gradient[2] * truncation
    norm = tl.sqrt(gx * gx + gy * gy + gz * gz)
    keep = live & (tl.abs(value) < limit) & (norm > low) & (norm < high)
    share = add_products(sums, value * truncation, (gx, gy, gz), lever, near, keep)
    tl.atomic_add(sums + 65, tl.sum(keep.to(tl.float64)), sem="relaxed")
    tl.atomic_add(sums + 66, tl.sum((share * share > 0.5).to(tl.float64)), sem="relaxed")
    if colour:
        d_error = (d_light[0] * scale, d_light[1] * scale, d_light[2] * scale)
        add_products(sums, (light - seen) * scale, d_error, lever, colour_kernel * scale, keep)


@triton.jit(do_not_specialize=["total"])
def align_kernel(
    field, points, total, luminance, settings, sums, colour: tl.constexpr, shape: tl.constexpr, block: tl.constexpr
):
    """Add a block's share to ``sums`` float64 [67]. points.position: camera points; settings: the fields of
    ``AlignSettings`` in their order."""
    i = tl.program_id(0) * block + tl.arange(0, block)
    live = i < total
    local = triple(points.position + 3 * i, live)
    world = (moved(points.c2w, local, 0), moved(points.c2w, local, 1), moved(points.c2w, local, 2))
    tx, ty, tz = tl.load(points.c2w + 3), tl.load(points.c2w + 7), tl.load(points.c2w + 11)
    lever = (world[0] - tx.to(tl.float64), world[1] - ty.to(tl.float64), world[2] - tz.to(tl.float64))
    sdf, d_sdf, light, d_light = both_gradients(field, world, live, colour, shape)
    add_points(sums, sdf, d_sdf, light, d_light, tl.load(luminance + i, live, 0.0), lever, settings, live, colour)
