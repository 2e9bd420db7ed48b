"""Parallel loops of the CPU back end, jitted: threads take chunks from a counter, sums are added in chunk order.

Results do not depend on which thread did what, so they repeat bit for bit. Nothing but the counter is atomic.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from ._cpu_adam import adam_range
from ._cpu_back import TABLE_SCRATCH, features_back, hidden_back, next_level, points_back, table_back, weights_back
from ._cpu_field import BLOCK, MASK, OFFSET, carve, forward
from ._cpu_math import BOTH, HALF, INNER, OUTER, PART, WORKER
from ._cpu_rays import compare, composite, pose_sums, rendered, sample_points
from ._cpu_simd import fetch_add

LUMINANCE = (np.float32(0.299), np.float32(0.587), np.float32(0.114))


@njit(**INNER)
def up_to_eight(n):
    """The next multiple of eight."""
    return (n + 7) // 8 * 8


@njit(**INNER)
def load_points(points, first, count, world, n, pitch):
    """Points [N, 3] into a chunk; padding is zero."""
    for axis in range(3):
        for i in range(count):
            world[axis * pitch + i] = points[first + i, axis]
        world[axis * pitch + count : axis * pitch + n] = 0


@njit(**WORKER)
def values_worker(t, counter, kept, buffers, pitch, grid, net, table, points, sdf, rgb):
    """TSDF and colour of points."""
    s = carve(kept[t], buffers[t], pitch, net.padded)
    while True:
        first = fetch_add(counter, 0) * pitch
        if first >= points.shape[0]:
            break
        count = min(pitch, points.shape[0] - first)
        n = up_to_eight(count)
        load_points(points, first, count, s.world, n, pitch)
        forward(grid, table, net, s, n, pitch, False)
        for i in range(count):
            sdf[first + i] = s.out[i]
            for k in range(3):
                rgb[first + i, k] = s.out[(k + 1) * pitch + i]


@njit(**INNER)
def slopes(grid, table, net, s, count, pitch, want_light):
    """Forward, then prepare the hidden gradients of TSDF (first half) and luminance (second half)."""
    n = up_to_eight(count)
    forward(grid, table, net, s, n, pitch, True)
    s.up[:n] = 1
    for k in range(3):
        at = (k + 1) * pitch
        for p in range(n):
            c = s.out[at + p]
            s.up[at + p] = LUMINANCE[k] * c * (1 - c) if want_light else 0
    hidden_back(net, s, 0, n, pitch, s.turn[:HALF], s.turn[HALF : 4 * HALF])


@njit(**INNER)
def slope_of(grid, net, s, count, pitch, half):
    """Position gradients of TSDF (half 0) or luminance (half 1) into ``s.d_x``."""
    n = up_to_eight(count)
    features_back(net, s, 0, n, pitch, half * HALF, (half + 1) * HALF)
    points_back(grid, net, s, 0, n, pitch, half * HALF, (half + 1) * HALF)


@njit(**INNER)
def luminance(s, p, pitch):
    """Luminance of point p."""
    return LUMINANCE[0] * s.out[pitch + p] + LUMINANCE[1] * s.out[2 * pitch + p] + LUMINANCE[2] * s.out[3 * pitch + p]


@njit(**WORKER)
def gradients_worker(t, counter, kept, buffers, pitch, grid, net, table, points, sdf, d_sdf, light, d_light):
    """TSDF, luminance and their gradients at points."""
    s = carve(kept[t], buffers[t], pitch, net.padded)
    while True:
        first = fetch_add(counter, 0) * pitch
        if first >= points.shape[0]:
            break
        count = min(pitch, points.shape[0] - first)
        load_points(points, first, count, s.world, up_to_eight(count), pitch)
        slopes(grid, table, net, s, count, pitch, True)
        for half in range(2):
            target = d_light if half else d_sdf
            slope_of(grid, net, s, count, pitch, half)
            for i in range(count):
                for axis in range(3):
                    target[first + i, axis] = s.d_x[axis * pitch + i]
        for i in range(count):
            sdf[first + i] = s.out[i]
            light[first + i] = luminance(s, i, pitch)


@njit(**INNER)
def add_rows(sums, residual, kernel, j):
    """One residual with its row j [6] of the Jacobian: sums is jtj (36), jtr (6), cost, inliers. Returns its weight."""
    share = kernel * kernel / (kernel * kernel + residual * residual)
    weight = share * share
    for a in range(6):
        scaled = weight * j[a]
        for b in range(6):
            sums[6 * a + b] += scaled * j[b]
        sums[36 + a] += scaled * residual
    sums[42] += 0.5 * residual * residual * share
    return weight


@njit(**INNER)
def jacobian(c2w, world, i, pitch, g, scale, j):
    """Row [6] of the Jacobian of a residual with position gradient ``scale * g``: translation, then rotation."""
    x, y, z = world[i] - c2w[0, 3], world[pitch + i] - c2w[1, 3], world[2 * pitch + i] - c2w[2, 3]
    a, b, c = scale * g[i], scale * g[pitch + i], scale * g[2 * pitch + i]
    j[0], j[1], j[2] = a, b, c
    j[3], j[4], j[5] = y * c - z * b, z * a - x * c, x * b - y * a


@njit(**WORKER)
def align_worker(t, counter, kept, buffers, pitch, grid, net, table, c2w, points, light, settings, sums):
    """Gauss-Newton sums [chunks, 51]: jtj, jtr, cost, inliers, used, and the last row of the Jacobian."""
    truncation, kernel, limit, low, high, colour, colour_kernel = settings
    s = carve(kept[t], buffers[t], pitch, net.padded)
    keep = s.weight
    while True:
        chunk = fetch_add(counter, 0)
        first = chunk * pitch
        if first >= points.shape[0]:
            break
        count = min(pitch, points.shape[0] - first)
        load_points(points, first, count, s.world, up_to_eight(count), pitch)
        for i in range(count):
            x, y, z = s.world[i], s.world[pitch + i], s.world[2 * pitch + i]
            for axis in range(3):
                s.world[axis * pitch + i] = c2w[axis, 0] * x + c2w[axis, 1] * y + c2w[axis, 2] * z + c2w[axis, 3]
        slopes(grid, table, net, s, count, pitch, colour > 0)
        slope_of(grid, net, s, count, pitch, 0)
        total = sums[chunk]
        total[:] = 0
        j = total[45:]
        for i in range(count):
            a, b, c = s.d_x[i], s.d_x[pitch + i], s.d_x[2 * pitch + i]
            norm = np.sqrt(a * a + b * b + c * c) * truncation
            keep[i] = abs(s.out[i]) < limit and norm > low and norm < high
            if keep[i]:
                jacobian(c2w, s.world, i, pitch, s.d_x, truncation, j)
                total[43] += add_rows(total, s.out[i] * truncation, kernel, j) > 0.5
                total[44] += 1
        if colour > 0:
            slope_of(grid, net, s, count, pitch, 1)
            for i in range(count):
                if keep[i]:
                    jacobian(c2w, s.world, i, pitch, s.d_x, colour, j)
                    residual = (luminance(s, i, pitch) - light[first + i]) * colour
                    add_rows(total, residual, colour_kernel * colour, j)


@njit(**WORKER)
def render_worker(t, counter, kept, buffers, chunk_rays, grid, net, table, beta, rays, color, depth, weights):
    """Colour, depth and weights of rays."""
    samples = rays.z.shape[1]
    pitch = up_to_eight(chunk_rays * samples)
    s = carve(kept[t], buffers[t], pitch, net.padded)
    while True:
        first = fetch_add(counter, 0) * chunk_rays
        if first >= rays.z.shape[0]:
            break
        count = min(chunk_rays, rays.z.shape[0] - first)
        n = up_to_eight(count * samples)
        sample_points(rays, first, count, s.world, n, pitch)
        forward(grid, table, net, s, n, pitch, False)
        composite(beta, count, samples, s, n)
        for i in range(count):
            r, at = first + i, i * samples
            color[r, 0], color[r, 1], color[r, 2], depth[r] = rendered(rays.z[r], at, s, pitch)
            for j in range(samples):
                weights[r, j] = s.weight[at + j]


@njit(**WORKER)
def step_worker(
    t,
    counter,
    kept,
    buffers,
    chunk_rays,
    groups,
    grid,
    net,
    table,
    beta,
    rays,
    w,
    counts,
    want_params,
    want_poses,
    losses,
    partial,
    sums,
):
    """One step up to the decoders: losses [groups, 5], decoder gradients partial [groups, size] and ray sums [R, 6].

    Leaves each chunk's positions and feature gradients in ``kept`` for ``table_worker`` if parameters are wanted.
    """
    samples = rays.z.shape[1]
    total = rays.z.shape[0]
    pitch = up_to_eight(chunk_rays * samples)
    chunks = (total + chunk_rays - 1) // chunk_rays
    share = (chunks + groups - 1) // groups
    a = net.padded * BOTH
    b = a + net.blob.shape[0]
    while True:
        group = fetch_add(counter, 0)
        if group >= groups:
            break
        own = partial[group]
        own[:] = 0
        losses[group] = 0
        for chunk in range(group * share, min((group + 1) * share, chunks)):
            s = carve(kept[chunk if want_params else t], buffers[t], pitch, net.padded)
            first = chunk * chunk_rays
            count = min(chunk_rays, total - first)
            n = up_to_eight(count * samples)
            sample_points(rays, first, count, s.world, n, pitch)
            forward(grid, table, net, s, n, pitch, want_poses)
            composite(beta, count, samples, s, n)
            d_beta = compare(rays, first, count, beta, w, counts, s, n, pitch, losses[group])
            own[b + 4 * HALF] += d_beta
            if want_params or want_poses:
                backward(grid, net, s, n, pitch, want_params, want_poses, own, a, b)
            if want_poses:
                pose_sums(rays.z, first, count, s, pitch, sums)


@njit(**PART)
def backward(grid, net, s, n, pitch, want_params, want_poses, own, a, b):
    """From ``s.up`` to gradients of positions, features and decoders (``own``: features to a, blob to b, the rest)."""
    for first in range(0, n, BLOCK):
        last = min(first + BLOCK, n)
        hidden_back(net, s, first, last, pitch, own[b : b + HALF], own[b + HALF : b + 4 * HALF])
        features_back(net, s, first, last, pitch, 0, BOTH)
        if want_params:
            weights_back(grid, net, s, first, last, pitch, own[:a], own[a:b])
        if want_poses:
            points_back(grid, net, s, first, last, pitch, 0, BOTH)


@njit(**WORKER)
def table_worker(t, counter, kept, buffers, chunk_rays, grid, total, samples, d_table, table, mean, square, numbers):
    """Gradient of the whole table from what ``step_worker`` kept, and where there are ``numbers`` for it (see
    ``adam_range``) the table's step: a level belongs to one thread at a time."""
    pitch = up_to_eight(chunk_rays * samples)
    chunks = (total + chunk_rays - 1) // chunk_rays
    scratch = buffers[t, :TABLE_SCRATCH]
    while True:
        level = next_level(counter, grid, d_table)
        if level < 0:
            break
        for chunk in range(chunks):
            n = up_to_eight(min(chunk_rays, total - chunk * chunk_rays) * samples)
            x, d_enc = kept[chunk, : 6 * pitch], kept[chunk, 6 * pitch :]
            table_back(grid, level, x, d_enc, 2 * level * pitch, n, pitch, scratch, d_table)
        if numbers.shape[0]:
            start = 2 * grid.levels[level, OFFSET]
            stop = start + 2 * grid.levels[level, MASK] + 2
            adam_range(table, d_table, mean, square, numbers, start, stop)


@njit(**OUTER)
def fill_net(w_in, w_sdf, w_rgb, features, bins, padded, flat, flat_t, blob, steps, sdf, rgb):
    """Lay the decoders out as ``Net`` wants them."""
    flat[features * BOTH :] = 0
    for i in range(features):
        for j in range(BOTH):
            flat[i * BOTH + j] = w_in[i, j]
            flat_t[j * padded + i] = w_in[i, j]
    for j in range(BOTH):
        flat_t[j * padded + features : (j + 1) * padded] = 0
    for axis in range(3):
        for i in range(bins + 2):
            source = features + axis * bins + (i - 1) % bins
            at = (axis * (bins + 2) + i) * BOTH
            blob[at : at + BOTH] = w_in[source]
    for at in range(blob.shape[0] - BOTH):
        steps[at] = blob[at + BOTH] - blob[at]
    for j in range(HALF):
        sdf[j] = w_sdf[j, 0]
        for k in range(3):
            rgb[k * HALF + j] = w_rgb[j, k]


@njit(**OUTER)
def add_partials(partial, features, bins, padded, w_in, w_sdf, w_rgb, beta):
    """Decoder gradients from the groups' partial sums, in group order."""
    total = np.zeros(partial.shape[1], np.float32)
    for group in range(partial.shape[0]):
        total += partial[group]
    for i in range(features):
        w_in[i] = total[i * BOTH : (i + 1) * BOTH]
    w_in[features:] = 0
    at = padded * BOTH
    for axis in range(3):
        for i in range(bins + 2):
            w_in[features + axis * bins + (i - 1) % bins] += total[at : at + BOTH]
            at += BOTH
    for j in range(HALF):
        w_sdf[j, 0] = total[at + j]
        for k in range(3):
            w_rgb[j, k] = total[at + HALF + k * HALF + j]
    beta[0] = total[at + 4 * HALF]
