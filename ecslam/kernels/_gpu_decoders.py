"""The two decoders as Triton code: both in one set of small matrix products, and the way back.

Columns 0 to 31 of the hidden layer are the TSDF decoder's, 32 to 63 the colour decoder's. Products run as three TF32
ones: tensor cores at about float32 precision.
"""

from __future__ import annotations

import triton
import triton.language as tl

from ._gpu_field import one_blob

WIDE = tl.constexpr(64)
HALF = tl.constexpr(32)
OUTPUTS = tl.constexpr(16)  # four, and the least that a matrix product takes


@triton.jit
def product(a, b):
    """The matrix product."""
    return tl.dot(a, b, input_precision="tf32x3")


@triton.jit
def feature_rows(odd: tl.constexpr, shape: tl.constexpr):
    """Rows of w_in that the even or the odd features meet [width], and which exist."""
    level = tl.arange(0, shape.width)
    return 2 * level + odd, level < shape.levels


@triton.jit
def blob_rows(axis: tl.constexpr, shape: tl.constexpr):
    """Rows of w_in that one axis' bins meet [blobs], and which exist."""
    bins = tl.arange(0, shape.blobs)
    return 2 * shape.levels + axis * shape.bins + bins, bins < shape.bins


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
def layer_one(field, features, phase, shape: tl.constexpr):
    """The hidden units of both decoders before the ReLU [P, 64], from (even, odd) features and one-blob phases."""
    total = product(features[0], weights(field.w_in, feature_rows(0, shape)))
    total += product(features[1], weights(field.w_in, feature_rows(1, shape)))
    for axis in tl.static_range(3):
        total += product(one_blob(phase[axis], shape)[0], weights(field.w_in, blob_rows(axis, shape)))
    return total


@triton.jit
def readers(field):
    """Weights [16, 64] from the hidden units to the outputs: row 0 the TSDF, 1 to 3 the colours, the rest zero."""
    output, unit = tl.arange(0, OUTPUTS)[:, None], tl.arange(0, WIDE)[None, :]
    to_sdf = tl.load(field.w_sdf + unit + 0 * output, (output == 0) & (unit < HALF), 0.0)
    to_rgb = tl.load(field.w_rgb + 3 * (unit - HALF) + output - 1, is_colour(output) & (unit >= HALF), 0.0)
    return to_sdf + to_rgb


@triton.jit
def is_colour(output):
    """Which outputs are colours."""
    return (output > 0) & (output < 4)


@triton.jit
def add_readers(into, values):
    """Add [16, 64] to the gradients of w_sdf and w_rgb."""
    output, unit = tl.arange(0, OUTPUTS)[:, None], tl.arange(0, WIDE)[None, :]
    tl.atomic_add(into.w_sdf + unit + 0 * output, values, (output == 0) & (unit < HALF), sem="relaxed")
    to_rgb = into.w_rgb + 3 * (unit - HALF) + output - 1
    tl.atomic_add(to_rgb, values, is_colour(output) & (unit >= HALF), sem="relaxed")


@triton.jit
def decode(field, hidden):
    """The outputs [P, 16]: TSDF, the three colours, nothing."""
    out = product(tl.maximum(hidden, 0.0), tl.trans(readers(field)))
    return tl.where(is_colour(tl.arange(0, OUTPUTS)[None, :]), tl.sigmoid(out), out)


@triton.jit
def into_hidden(field, hidden, d_out):
    """Gradient before the ReLU [P, 64] from that of the outputs before their sigmoid [P, 16]."""
    return tl.where(hidden > 0, product(d_out, readers(field)), 0.0)


@triton.jit
def into_features(field, d_hidden, shape: tl.constexpr):
    """Gradients of the even and of the odd features [P, width]."""
    d_even = product(d_hidden, tl.trans(weights(field.w_in, feature_rows(0, shape))))
    d_odd = product(d_hidden, tl.trans(weights(field.w_in, feature_rows(1, shape))))
    return d_even, d_odd


@triton.jit
def through_blob(field, d_hidden, phase, axis: tl.constexpr, shape: tl.constexpr):
    """Gradient by one world coordinate through its one-blob values, per metre [P]."""
    d_blob = product(d_hidden, tl.trans(weights(field.w_in, blob_rows(axis, shape))))
    by_phase = tl.sum(one_blob(phase[axis], shape)[1] * d_blob, 1)
    return by_phase * tl.load(field.geometry + 6 + axis).to(tl.float32) * shape.bins
