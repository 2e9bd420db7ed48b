"""Triton kernels over blocks of points: values, and everything that flows back from them to map, points and poses.

The way back is two kernels, decoders and grid: one kernel for both would need more registers than there are.
"""

from __future__ import annotations

from typing import NamedTuple

import triton
import triton.language as tl
from torch import Tensor

from ._gpu_decoders import (
    OUTPUTS,
    WIDE,
    add_readers,
    add_rows,
    blob_rows,
    decode,
    feature_rows,
    into_features,
    into_hidden,
    is_colour,
    layer_one,
    product,
    through_blob,
)
from ._gpu_field import gather, on_box, one_blob, place, pull, scatter


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
    total: int


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


@triton.jit
def feature_places(i, live, shape: tl.constexpr):
    """Where the features of points i lie in the buffer [N, 2 L]: [P, width, 2], and which exist."""
    column = 2 * tl.arange(0, shape.width)[:, None] + tl.arange(0, 2)[None, :]
    there = live[:, None, None] & (column < 2 * shape.levels)[None, :, :]
    return 2 * shape.levels * i[:, None, None] + column[None, :, :], there


@triton.jit
def values_kernel(
    field, points, sdf, rgb, features_at, from_rays: tl.constexpr, keep: tl.constexpr, shape: tl.constexpr,
    block: tl.constexpr,
):  # fmt: skip
    """TSDF [N] and colour [N, 3] of points; with ``keep`` their grid features [N, 2 L] as well."""
    i = tl.program_id(0) * block + tl.arange(0, block)
    live = i < points.total
    at, fraction, phase, _ = place(field, world_of(points, i, live, from_rays), shape)
    features = gather(field, at, fraction, live, shape)
    if keep:
        where, there = feature_places(i, live, shape)
        tl.store(features_at + where, tl.join(features[0], features[1]), there)
    out = decode(field, layer_one(field, features, phase, shape))
    output = tl.arange(0, OUTPUTS)[None, :]
    tl.store(sdf + i[:, None] + 0 * output, out, live[:, None] & (output == 0))
    tl.store(rgb + 3 * i[:, None] + output - 1, out, live[:, None] & is_colour(output))


@triton.jit
def decoders_kernel(
    field, points, d_sdf, d_rgb, features_at, d_world, into, blocks, want_params: tl.constexpr,
    want_poses: tl.constexpr, shape: tl.constexpr, block: tl.constexpr,
):  # fmt: skip
    """From the gradients of TSDF [N] and of colour before its sigmoid [N, 3] to the decoders and the grid features,
    which are overwritten by their gradients, and to the position through the one-blob part, d_world [N, 3].

    A program takes every n-th block and keeps its share of the decoders' gradient in registers until the end.
    """
    d_even_rows = tl.full([shape.width, WIDE], 0, tl.float32)
    d_odd_rows = tl.full([shape.width, WIDE], 0, tl.float32)
    d_x_rows = tl.full([shape.blobs, WIDE], 0, tl.float32)
    d_y_rows = tl.full([shape.blobs, WIDE], 0, tl.float32)
    d_z_rows = tl.full([shape.blobs, WIDE], 0, tl.float32)
    d_readers = tl.full([OUTPUTS, WIDE], 0, tl.float32)
    output = tl.arange(0, OUTPUTS)[None, :]
    for number in range(tl.program_id(0), blocks, tl.num_programs(0)):
        i = number * block + tl.arange(0, block)
        live = i < points.total
        world = world_of(points, i, live, True)
        phase = (
            on_box(field, world[0], 0, shape)[3],
            on_box(field, world[1], 1, shape)[3],
            on_box(field, world[2], 2, shape)[3],
        )
        where, there = feature_places(i, live, shape)
        features = tl.split(tl.load(features_at + where, there, 0.0))
        hidden = layer_one(field, features, phase, shape)
        d_out = tl.load(d_sdf + i[:, None] + 0 * output, live[:, None] & (output == 0), 0.0)
        d_out += tl.load(d_rgb + 3 * i[:, None] + output - 1, live[:, None] & is_colour(output), 0.0)
        d_hidden = into_hidden(field, hidden, d_out)
        d_features = into_features(field, d_hidden, shape)
        tl.store(features_at + where, tl.join(d_features[0], d_features[1]), there)
        if want_poses:
            for axis in tl.static_range(3):
                tl.store(d_world + 3 * i + axis, through_blob(field, d_hidden, phase, axis, shape), live)
        if want_params:
            d_readers += product(tl.trans(d_out), tl.maximum(hidden, 0.0))
            d_even_rows += product(tl.trans(features[0]), d_hidden)
            d_odd_rows += product(tl.trans(features[1]), d_hidden)
            d_x_rows += product(tl.trans(one_blob(phase[0], shape)[0]), d_hidden)
            d_y_rows += product(tl.trans(one_blob(phase[1], shape)[0]), d_hidden)
            d_z_rows += product(tl.trans(one_blob(phase[2], shape)[0]), d_hidden)
    if want_params:
        add_rows(into.w_in, feature_rows(0, shape), d_even_rows)
        add_rows(into.w_in, feature_rows(1, shape), d_odd_rows)
        add_rows(into.w_in, blob_rows(0, shape), d_x_rows)
        add_rows(into.w_in, blob_rows(1, shape), d_y_rows)
        add_rows(into.w_in, blob_rows(2, shape), d_z_rows)
        add_readers(into, d_readers)


@triton.jit
def add_poses(d_c2w, live, local, pose, gradient):
    """Add a block's share to the gradients [P, 3, 4] of its poses. Poses ascend, so a block meets few of them."""
    first, last = tl.min(tl.where(live, pose, 2147483647)), tl.max(tl.where(live, pose, -1))
    axis = tl.arange(0, 4)[None, :]
    gx, gy, gz = gradient[0][:, None], gradient[1][:, None], gradient[2][:, None]
    up = tl.where(axis == 0, gx, tl.where(axis == 1, gy, tl.where(axis == 2, gz, 0.0)))
    x, y, z = local[0].to(tl.float32)[:, None], local[1].to(tl.float32)[:, None], local[2].to(tl.float32)[:, None]
    lever = tl.where(axis == 0, x, tl.where(axis == 1, y, tl.where(axis == 2, z, 1.0)))
    entries = up[:, :, None] * lever[:, None, :]
    row, column = tl.arange(0, 4)[:, None], tl.arange(0, 4)[None, :]
    for p in range(first, last + 1):
        mine = (live & (pose == p))[:, None, None]
        total = tl.sum(tl.where(mine, entries, 0.0), 0)
        tl.atomic_add(d_c2w + 12 * p + 4 * row + column, total, (row < 3) & (column >= 0), sem="relaxed")


@triton.jit
def grid_kernel(
    field, points, d_features_at, d_world, into, d_c2w, want_params: tl.constexpr, want_poses: tl.constexpr,
    shape: tl.constexpr, block: tl.constexpr,
):  # fmt: skip
    """From the gradients of the grid features [N, 2 L] to the table and, with the one-blob part of the position's
    gradient d_world [N, 3], to the poses."""
    i = tl.program_id(0) * block + tl.arange(0, block)
    live = i < points.total
    at, fraction, _, inside = place(field, world_of(points, i, live, True), shape)
    where, there = feature_places(i, live, shape)
    d_even, d_odd = tl.split(tl.load(d_features_at + where, there, 0.0))
    if want_params:
        scatter(field, into.table, at, fraction, d_even, d_odd, live, shape)
    if want_poses:
        gx, gy, gz = pull(field, at, fraction, d_even, d_odd, live, shape)
        gradient = (
            (gx + tl.load(d_world + 3 * i, live, 0.0)) * inside[0],
            (gy + tl.load(d_world + 3 * i + 1, live, 0.0)) * inside[1],
            (gz + tl.load(d_world + 3 * i + 2, live, 0.0)) * inside[2],
        )
        local, pose = sample(points, i, live)
        add_poses(d_c2w, live, local, pose, gradient)
