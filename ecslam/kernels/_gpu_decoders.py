"""The two decoders as Triton code: both in one set of small matrix products, and the way back.

Columns 0 to 31 of the hidden layer are the TSDF decoder's, 32 to 63 the colour decoder's. Products run as three TF32
ones: tensor cores at about float32 precision. The last layer is too narrow for them and is summed plainly.
"""

from __future__ import annotations

import triton
import triton.language as tl

from ._gpu_field import axis_of

WIDE = tl.constexpr(64)
HALF = tl.constexpr(32)


@triton.jit
def product(a, b):
    """The matrix product."""
    return tl.dot(a, b, input_precision="tf32x3")


@triton.jit
def feature_rows(shape: tl.constexpr):
    """Rows of w_in that the grid features meet [2 width], and which exist."""
    row = tl.arange(0, 2 * shape.width)
    return row, row < 2 * shape.levels


@triton.jit
def blob_rows(shape: tl.constexpr):
    """Rows of w_in that the one-blob values meet [blobs], and which exist."""
    row = tl.arange(0, shape.blobs)
    return 2 * shape.levels + row, row < 3 * shape.bins


@triton.jit
def weights(w_in, rows):
    """Some rows of w_in [.., 64]; zero where there is none."""
    row, known = rows
    return tl.load(w_in + WIDE * row[:, None] + tl.arange(0, WIDE)[None, :], known[:, None], 0.0)


@triton.jit
def add_rows(into, rows, values):
    """Add [.., 64] to some rows of the gradient of w_in."""
    row, known = rows
    at = into + WIDE * row[:, None] + tl.arange(0, WIDE)[None, :]
    tl.atomic_add(at, values, known[:, None] & (tl.arange(0, WIDE) >= 0)[None, :], sem="relaxed")


@triton.jit
def layer_one(field, features, blob, shape: tl.constexpr):
    """The hidden units of both decoders before the ReLU [P, 64], from grid features and one-blob values."""
    from_grid = product(features, weights(field.w_in, feature_rows(shape)))
    return from_grid + product(blob, weights(field.w_in, blob_rows(shape)))


@triton.jit
def reader(field, output: tl.constexpr):
    """Where the weights [64] from the hidden units to one output lie (0: TSDF, 1 to 3: colours), and which exist."""
    unit = tl.arange(0, WIDE)
    if output == 0:
        return field.w_sdf + unit, unit < HALF
    else:
        return field.w_rgb + 3 * (unit - HALF) + (output - 1), unit >= HALF


@triton.jit
def read(field, output: tl.constexpr):
    """The weights [1, 64] from the hidden units to one output, zero for those of the other decoder."""
    at, there = reader(field, output)
    return tl.load(at, there, 0.0)[None, :]


@triton.jit
def add_reader(into, output: tl.constexpr, values):
    """Add [64] to the gradient of one output's weights."""
    at, there = reader(into, output)
    tl.atomic_add(at, values, there, sem="relaxed")


@triton.jit
def decode(field, hidden):
    """TSDF, red, green, blue [P] each."""
    on = tl.maximum(hidden, 0.0)
    red, green = tl.sum(on * read(field, 1), 1), tl.sum(on * read(field, 2), 1)
    blue = tl.sum(on * read(field, 3), 1)
    return tl.sum(on * read(field, 0), 1), tl.sigmoid(red), tl.sigmoid(green), tl.sigmoid(blue)


@triton.jit
def into_hidden(field, hidden, d_out):
    """Gradient before the ReLU [P, 64] from those of TSDF and of the colours before their sigmoid [P] each."""
    d_hidden = d_out[0][:, None] * read(field, 0) + d_out[1][:, None] * read(field, 1)
    d_hidden += d_out[2][:, None] * read(field, 2) + d_out[3][:, None] * read(field, 3)
    return tl.where(hidden > 0, d_hidden, 0.0)


@triton.jit
def into_features(field, d_hidden, shape: tl.constexpr):
    """Gradient of the grid features [P, 2 width]."""
    return product(d_hidden, tl.trans(weights(field.w_in, feature_rows(shape))))


@triton.jit
def through_blob(field, d_hidden, slope, shape: tl.constexpr):
    """Gradient by the world position through the one-blob values, per metre (x, y, z: [P] each). slope: derivatives of
    the values by their phases."""
    by_phase = slope * product(d_hidden, tl.trans(weights(field.w_in, blob_rows(shape))))
    axis, at = axis_of(shape)[None, :], field.geometry + 6
    x = tl.sum(tl.where(axis == 0, by_phase, 0.0), 1) * (shape.bins * tl.load(at).to(tl.float32))
    y = tl.sum(tl.where(axis == 1, by_phase, 0.0), 1) * (shape.bins * tl.load(at + 1).to(tl.float32))
    z = tl.sum(tl.where(axis == 2, by_phase, 0.0), 1) * (shape.bins * tl.load(at + 2).to(tl.float32))
    return x, y, z
