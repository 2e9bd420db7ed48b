"""Triton kernels over blocks of points: values, and everything that flows back from them to map, points and poses.

Points are placed once, in float64; what is left to the other kernels is float32. The way back is three kernels,
weights, decoders and grid: one kernel for all would need more registers than there are.
"""

from __future__ import annotations

from typing import NamedTuple

import triton
import triton.language as tl
from torch import Tensor

from ._gpu_decoders import (
    WIDE,
    add_reader,
    add_rows,
    blob_rows,
    decode,
    feature_rows,
    into_features,
    into_hidden,
    layer_one,
    product,
    through_blob,
)
from ._gpu_field import gather, on_box, one_blob, place


class Points(NamedTuple):
    """Where points come from. With samples > 0 point i is sample i mod samples of ray i div samples; else it is row i
    of ``position`` [N, 3], in the world. c2w: poses, ``pitch`` floats apart."""

    position: Tensor
    c2w: Tensor
    direction: Tensor
    z: Tensor
    pose: Tensor
    pitch: int
    samples: int


class Into(NamedTuple):
    """Where parameter gradients are added."""

    table: Tensor
    w_in: Tensor
    w_sdf: Tensor
    w_rgb: Tensor


@triton.jit
def camera_row(c2w, axis: tl.constexpr):
    """One row of pose matrices as four float64."""
    at = c2w + 4 * axis
    return (
        tl.load(at).to(tl.float64),
        tl.load(at + 1).to(tl.float64),
        tl.load(at + 2).to(tl.float64),
        tl.load(at + 3).to(tl.float64),
    )


@triton.jit
def moved(c2w, local, axis: tl.constexpr):
    """One world coordinate of camera points, float64."""
    m = camera_row(c2w, axis)
    return m[0] * local[0] + m[1] * local[1] + m[2] * local[2] + m[3]


@triton.jit
def triple(at, live):
    """Three floats in a row as float64."""
    return (
        tl.load(at, live, 0.0).to(tl.float64),
        tl.load(at + 1, live, 0.0).to(tl.float64),
        tl.load(at + 2, live, 0.0).to(tl.float64),
    )


@triton.jit
def sample(points, i, live):
    """Position of ray samples i in their camera, float64 (x, y, z), and the pose each belongs to."""
    ray = i // points.samples
    z = tl.load(points.z + i, live, 0.0).to(tl.float64)
    x, y, one = triple(points.direction + 3 * ray, live)
    return (x * z, y * z, one * z), tl.load(points.pose + ray, live, 0).to(tl.int32)


@triton.jit
def world_of(points, i, live, from_rays: tl.constexpr):
    """World position of points i, float64 (x, y, z)."""
    if from_rays:
        local, pose = sample(points, i, live)
        c2w = points.c2w + pose * points.pitch
        return moved(c2w, local, 0), moved(c2w, local, 1), moved(c2w, local, 2)
    else:
        return triple(points.position + 3 * i, live)


@triton.jit(do_not_specialize=["total"])
def place_kernel(field, points, total, placed, from_rays: tl.constexpr, shape: tl.constexpr, block: tl.constexpr):
    """Place points: ``placed`` [12, N] takes their distances from the anchor (x, y, z), what rounding lost, their
    one-blob phases, and 1 for coordinates inside the box, else 0."""
    i = tl.program_id(0) * block + tl.arange(0, block)
    live = i < total
    world = world_of(points, i, live, from_rays)
    for axis in tl.static_range(3):
        found = on_box(field, world[axis], axis, shape)
        for kind in tl.static_range(4):
            tl.store(placed + (3 * kind + axis) * total + i, found[kind], live)


@triton.jit
def load_placed(placed, kind: tl.constexpr, i, live, total):
    """One kind of what ``place_kernel`` found (x, y, z: [P] each)."""
    at = placed + 3 * kind * total + i
    return tl.load(at, live, 0.0), tl.load(at + total, live, 0.0), tl.load(at + 2 * total, live, 0.0)


@triton.jit
def level_places(i, live, total, shape: tl.constexpr):
    """Where the even features of points i lie in the buffer [2, L, N]: [P, width], and which exist; the odd ones lie
    ``levels * total`` further on."""
    level = tl.arange(0, shape.width)[None, :]
    return level * total + i[:, None], live[:, None] & (level < shape.levels)


@triton.jit
def feature_places(i, live, total, shape: tl.constexpr):
    """Where all features of points i lie in the buffer [2, L, N], in the order of w_in: [2 width, P], and which
    exist."""
    row, known = feature_rows(shape)
    at = (row % 2) * shape.levels + row // 2
    return at[:, None] * total + i[None, :], known[:, None] & live[None, :]


@triton.jit
def hidden_places(i, live):
    """Where the hidden units of points i lie in the buffer [N, 64]: [P, 64], and which exist."""
    unit = tl.arange(0, WIDE)[None, :]
    return WIDE * i[:, None] + unit, live[:, None] & (unit >= 0)


@triton.jit(do_not_specialize=["total"])
def values_kernel(
    field, placed, total, sdf, rgb, features_at, slopes_at, hidden_at, keep: tl.constexpr, keep_features: tl.constexpr,
    keep_slopes: tl.constexpr, shape: tl.constexpr, block: tl.constexpr,
):  # fmt: skip
    """TSDF [N] and colour [N, 3] of points; with ``keep`` the hidden units before the ReLU [N, 64] as well and, where
    these are wanted too, the grid features [2, L, N] and their derivatives by the fractions within the cells
    [2, 3, L, N]."""
    i = tl.program_id(0) * block + tl.arange(0, block)
    live = i < total
    x, rest = load_placed(placed, 0, i, live, total), load_placed(placed, 1, i, live, total)
    at, fraction = place(field, x, rest, shape)
    even, odd, even_slope, odd_slope = gather(field, at, fraction, live, shape)
    where, there = level_places(i, live, total, shape)
    further = shape.levels * total
    if keep and keep_features:
        tl.store(features_at + where, even, there)
        tl.store(features_at + further + where, odd, there)
    if keep and keep_slopes:
        for axis in tl.static_range(3):
            tl.store(slopes_at + axis * further + where, even_slope[axis], there)
            tl.store(slopes_at + (3 + axis) * further + where, odd_slope[axis], there)
    blob, _ = one_blob(load_placed(placed, 2, i, live, total), shape)
    hidden = layer_one(field, tl.interleave(even, odd), blob, shape)
    if keep:
        where, there = hidden_places(i, live)
        tl.store(hidden_at + where, hidden, there)
    out = decode(field, hidden)
    tl.store(sdf + i, out[0], live)
    for k in tl.static_range(3):
        tl.store(rgb + 3 * i + k, out[1 + k], live)


@triton.jit(do_not_specialize=["total"])
def decoders_kernel(
    field, placed, total, d_sdf, d_rgb, hidden_at, d_features_at, d_world, into, want_params: tl.constexpr,
    want_poses: tl.constexpr, shape: tl.constexpr, block: tl.constexpr,
):  # fmt: skip
    """From the gradients of TSDF [N] and of colour before its sigmoid [N, 3] to the decoders' last layer, to the hidden
    units, which are overwritten by their gradients (both with ``want_params``), to the grid features [2, L, N] and,
    with ``want_poses``, to the position through the one-blob part, d_world [N, 3]."""
    i = tl.program_id(0) * block + tl.arange(0, block)
    live = i < total
    where, there = hidden_places(i, live)
    hidden = tl.load(hidden_at + where, there, 0.0)
    to_sdf, to_red = tl.load(d_sdf + i, live, 0.0), tl.load(d_rgb + 3 * i, live, 0.0)
    to_green, to_blue = tl.load(d_rgb + 3 * i + 1, live, 0.0), tl.load(d_rgb + 3 * i + 2, live, 0.0)
    d_out = to_sdf, to_red, to_green, to_blue
    d_hidden = into_hidden(field, hidden, d_out)
    if want_params:
        tl.store(hidden_at + where, d_hidden, there)
        for output in tl.static_range(4):
            add_reader(into, output, tl.sum(tl.maximum(hidden, 0.0) * d_out[output][:, None], 0))
    where, there = feature_places(i, live, total, shape)
    tl.store(d_features_at + where, tl.trans(into_features(field, d_hidden, shape)), there)
    if want_poses:
        _, slope = one_blob(load_placed(placed, 2, i, live, total), shape)
        gradient = through_blob(field, d_hidden, slope, shape)
        for axis in tl.static_range(3):
            tl.store(d_world + 3 * i + axis, gradient[axis], live)


@triton.jit(do_not_specialize=["total"])
def weights_kernel(placed, total, features_at, d_hidden_at, into, blocks, shape: tl.constexpr, block: tl.constexpr):
    """From the gradients of the hidden units [N, 64] to the decoders' first layer.

    A program takes every n-th block and keeps its share of the gradient in registers until the end.
    """
    by_feature = tl.full([2 * shape.width, WIDE], 0, tl.float32)
    by_blob = tl.full([shape.blobs, WIDE], 0, tl.float32)
    for number in tl.range(tl.program_id(0), blocks, tl.num_programs(0), num_stages=1):
        i = number * block + tl.arange(0, block)
        live = i < total
        where, there = hidden_places(i, live)
        d_hidden = tl.load(d_hidden_at + where, there, 0.0)
        where, there = feature_places(i, live, total, shape)
        by_feature += product(tl.load(features_at + where, there, 0.0), d_hidden)
        blob, _ = one_blob(load_placed(placed, 2, i, live, total), shape)
        by_blob += product(tl.trans(blob), d_hidden)
    add_rows(into.w_in, feature_rows(shape), by_feature)
    add_rows(into.w_in, blob_rows(shape), by_blob)
