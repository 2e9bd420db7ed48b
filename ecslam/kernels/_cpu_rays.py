"""Rays of a chunk, jitted: sample positions, rendering, losses and the way back to TSDF, colour, beta and pose."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from ._cpu_math import INNER, OUTER, exp, expm1, sigmoid
from ._cpu_simd import load, splat, store

FREE, CENTRE, TAIL, DEPTH_UNIFORM, DEPTH_FEATURE, COLOUR_UNIFORM, COLOUR_FEATURE, TRUNCATION, CENTRE_SHARE = range(9)


class Rays(NamedTuple):
    """A RayBatch and its poses as jitted code reads them."""

    c2w: np.ndarray
    direction: np.ndarray
    z: np.ndarray
    depth: np.ndarray
    color: np.ndarray
    feature: np.ndarray
    pose: np.ndarray


@njit(**INNER)
def sample_points(rays, first, count, world, n, pitch):
    """World positions [3, pitch], in float64, of all samples of ``count`` rays."""
    samples = rays.z.shape[1]
    for i in range(count):
        r = first + i
        pose = rays.c2w[rays.pose[r]]
        x, y, z = float(rays.direction[r, 0]), float(rays.direction[r, 1]), float(rays.direction[r, 2])
        for axis in range(3):
            slope = pose[axis, 0] * x + pose[axis, 1] * y + pose[axis, 2] * z
            start = float(pose[axis, 3])
            for j in range(samples):
                world[axis * pitch + i * samples + j] = start + slope * rays.z[r, j]
    for axis in range(3):
        world[axis * pitch + count * samples : axis * pitch + n] = 0


@njit(**INNER)
def composite(beta, count, samples, s, n):
    """Rendering weights (paper, equations 2 and 3): fills ``sharp`` (sigmoid), ``alpha``, ``before`` (transmittance)
    and ``weight``."""
    zero, b = splat(np.float32(0)), splat(beta)
    for p in range(0, n, 8):
        sharp = sigmoid(zero - b * load(s.out, p))
        store(s.sharp, p, sharp)
        store(s.before, p, b * sharp)
        store(s.alpha, p, zero - expm1(zero - b * sharp))
    for i in range(count):
        total = np.float32(0)
        for p in range(i * samples, (i + 1) * samples):
            sigma = s.before[p]
            s.before[p] = total
            total += sigma
    for p in range(0, n, 8):
        passed = exp(zero - load(s.before, p))
        store(s.before, p, passed)
        store(s.weight, p, passed * load(s.alpha, p))


@njit(**INNER)
def rendered(z, at, s, pitch):
    """Colour and depth of the ray whose samples start at ``at``."""
    r, g, b, depth = np.float32(0), np.float32(0), np.float32(0), np.float32(0)
    for j in range(z.shape[0]):
        w = s.weight[at + j]
        r += w * s.out[pitch + at + j]
        g += w * s.out[2 * pitch + at + j]
        b += w * s.out[3 * pitch + at + j]
        depth += w * z[j]
    return r, g, b, depth


@njit(**OUTER)
def count_rays(depth, feature):
    """How many rays have a depth, are uniform, are features, are uniform with depth, are features with depth (at
    least 1 each: they divide)."""
    counts = np.zeros(5, np.float32)
    for r in range(depth.shape[0]):
        has = depth[r] > 0
        counts[0] += has
        counts[1] += not feature[r]
        counts[2] += feature[r]
        counts[3] += has and not feature[r]
        counts[4] += has and feature[r]
    return np.maximum(counts, np.float32(1))


@njit(**INNER)
def sdf_terms(z, depth, w, measured, at, s, losses):
    """Free-space, centre and tail losses of one ray (paper, equations 4 and 5); their gradients start ``s.up``."""
    samples = z.shape[0]
    truncation = w[TRUNCATION]
    edge = w[CENTRE_SHARE] * truncation
    front, centre, tail = 0, 0, 0
    for j in range(samples):
        d = z[j] - depth
        front += d < -truncation
        centre += abs(d) <= truncation and abs(d) < edge
        tail += abs(d) <= truncation and not abs(d) < edge
    scale_f = w[FREE] / (max(front, 1) * measured)
    scale_c = w[CENTRE] / (max(centre, 1) * measured)
    scale_t = w[TAIL] / (max(tail, 1) * measured)
    sum_f, sum_c, sum_t = np.float32(0), np.float32(0), np.float32(0)
    for j in range(samples):
        sdf = s.out[at + j]
        d = z[j] - depth
        up = np.float32(0)
        if d < -truncation:
            sum_f += (sdf - 1) ** 2
            up = 2 * scale_f * (sdf - 1)
        elif abs(d) <= truncation:
            error = d + sdf * truncation
            if abs(d) < edge:
                sum_c += error * error
                up = 2 * scale_c * truncation * error
            else:
                sum_t += error * error
                up = 2 * scale_t * truncation * error
        s.up[at + j] = up
    losses[0] += scale_f * sum_f
    losses[1] += scale_c * sum_c
    losses[2] += scale_t * sum_t


@njit(**INNER)
def render_back(z, at, beta, c_r, c_g, c_b, c_d, s, pitch):
    """Through the compositing of one ray: adds to ``s.up``, returns the gradient of beta. c_*: gradients of the
    rendered colour and depth."""
    d_beta, later = 0.0, 0.0  # later: mean of d_w over what lies behind, in float64 since it nearly cancels d_w
    for j in range(z.shape[0] - 1, -1, -1):
        p = at + j
        r, g, b = s.out[pitch + p], s.out[2 * pitch + p], s.out[3 * pitch + p]
        alpha = float(s.alpha[p])
        d_w = float(c_r) * r + float(c_g) * g + float(c_b) * b + float(c_d) * z[j]
        d_sigma = (d_w - later) * s.before[p] * (1 - alpha)
        later += alpha * (d_w - later)
        w, sharp = s.weight[p], s.sharp[p]
        steep = beta * sharp * (1 - sharp)
        s.up[p] -= np.float32(d_sigma) * beta * steep
        d_beta += d_sigma * (sharp - s.out[p] * steep)
        s.up[pitch + p] = c_r * w * r * (1 - r)
        s.up[2 * pitch + p] = c_g * w * g * (1 - g)
        s.up[3 * pitch + p] = c_b * w * b * (1 - b)
    return d_beta


@njit(**INNER)
def compare(rays, first, count, beta, w, counts, s, n, pitch, losses):
    """Losses of a chunk of rays, added to ``losses`` [5] float64; their gradients go to ``s.up``. Returns d beta."""
    samples = rays.z.shape[1]
    d_beta = 0.0
    for i in range(count):
        r, at = first + i, i * samples
        z, depth = rays.z[r], rays.depth[r]
        red, green, blue, far = rendered(z, at, s, pitch)
        feature = rays.feature[r]
        c_d = np.float32(0)
        if depth > 0:
            sdf_terms(z, depth, w, counts[0], at, s, losses)
            scale = w[DEPTH_FEATURE] / counts[4] if feature else w[DEPTH_UNIFORM] / counts[3]
            losses[3] += scale * (far - depth) ** 2
            c_d = 2 * scale * (far - depth)
        else:
            s.up[at : at + samples] = 0
        scale = (w[COLOUR_FEATURE] / counts[2] if feature else w[COLOUR_UNIFORM] / counts[1]) / np.float32(3)
        red, green, blue = red - rays.color[r, 0], green - rays.color[r, 1], blue - rays.color[r, 2]
        losses[4] += scale * (red * red + green * green + blue * blue)
        d_beta += render_back(z, at, beta, 2 * scale * red, 2 * scale * green, 2 * scale * blue, c_d, s, pitch)
    for k in range(4):
        s.up[k * pitch + count * samples : k * pitch + n] = 0
    return d_beta


@njit(**INNER)
def pose_sums(z, first, count, s, pitch, sums):
    """Per ray: the sums of position gradients and of position gradients times depth, into sums [R, 6]."""
    samples = z.shape[1]
    for i in range(count):
        for axis in range(3):
            total, times_z = np.float32(0), np.float32(0)
            at = axis * pitch + i * samples
            for j in range(samples):
                total += s.d_x[at + j]
                times_z += s.d_x[at + j] * z[first + i, j]
            sums[first + i, axis] = total
            sums[first + i, 3 + axis] = times_z


@njit(**OUTER)
def pose_gradients(rays, sums, d_c2w):
    """Gradients [P, 3, 4] of the poses from the per-ray sums, in ray order."""
    total = np.zeros(d_c2w.shape, np.float64)
    for r in range(sums.shape[0]):
        g = total[rays.pose[r]]
        for axis in range(3):
            for k in range(3):
                g[axis, k] += sums[r, 3 + axis] * rays.direction[r, k]
            g[axis, 3] += sums[r, axis]
    d_c2w[:] = total
