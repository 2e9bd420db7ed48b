"""A step of Adam for rigid poses as one Triton kernel: what ``reference.pose_step`` does with some forty small ones."""

from __future__ import annotations

import triton
import triton.language as tl

from ._gpu_points import triple


@triton.jit
def dot(a, b):
    """Scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@triton.jit
def cross(a, b):
    """Vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@triton.jit
def adam(mean, square, rates, gradient, i, p, live, keep, add, scale, epsilon):
    """The move of tangent coordinate i; moments [P, 6] are brought up to date. keep, add, scale: for either moment its
    decay, one less that, and the inverse of its correction (given apart, since numbers come as float32).

    Only what is summed up needs float64: its roots and quotients are long chains of instructions."""
    at = 6 * p + i
    m = keep[0] * tl.load(mean + at, live, 0.0) + add[0] * gradient
    s = keep[1] * tl.load(square + at, live, 0.0) + add[1] * gradient * gradient
    tl.store(mean + at, m, live)
    tl.store(square + at, s, live)
    step = (m * scale[0]).to(tl.float32) / (tl.sqrt((s * scale[1]).to(tl.float32)) + epsilon)
    return -tl.load(rates + at, live, 0.0) * step


@triton.jit
def rodrigues(square):
    """sin(x) / x and (1 - cos(x)) / x^2 from x^2: by their series at an eighth of the angle, which is doubled thrice.
    To float64's precision up to half a turn and more, without a quotient or a root."""
    q = square * 0.015625
    a, b = tl.full(q.shape, 1, tl.float64), tl.full(q.shape, 1, tl.float64)
    for k in tl.static_range(7, 0, -1):
        a = 1 - q * (1 / (2 * k * (2 * k + 1))) * a
        b = 1 - q * (1 / ((2 * k + 1) * (2 * k + 2))) * b
    b *= 0.5
    for _ in tl.static_range(3):
        a, b, q = a * (1 - q * b), 0.5 * a * a, 4 * q
    return a, b


@triton.jit
def turned(turn, a, b, row, i: tl.constexpr):
    """Row i of exp(turn) times a rotation, given by its columns' entries ``row`` [3 tuples: its rows]; a, b: see
    Rodrigues."""
    first, second, third = row
    square = dot(turn, turn)
    own = turn[i]
    ex, ey, ez = b * own * turn[0], b * own * turn[1], b * own * turn[2]
    if i == 0:
        ex, ey, ez = ex + 1 - b * square, ey - a * turn[2], ez + a * turn[1]
    elif i == 1:
        ex, ey, ez = ex + a * turn[2], ey + 1 - b * square, ez - a * turn[0]
    else:
        ex, ey, ez = ex - a * turn[1], ey + a * turn[0], ez + 1 - b * square
    return (
        ex * first[0] + ey * second[0] + ez * third[0],
        ex * first[1] + ey * second[1] + ez * third[1],
        ex * first[2] + ey * second[2] + ez * third[2],
    )


@triton.jit
def put_row(moved, p, i: tl.constexpr, rotation, before, shift, old, about, live):
    """Store row i of the moved poses; the point ``about`` stays where the rotation is concerned."""
    at = moved + 16 * p + 4 * i
    for k in tl.static_range(3):
        tl.store(at + k, rotation[k], live)
    kept = dot((old[0] - rotation[0], old[1] - rotation[1], old[2] - rotation[2]), about)
    tl.store(at + 3, before + shift + kept, live)


@triton.jit(do_not_specialize=["poses"])
def pose_kernel(
    c2w, d_c2w, mean, square, rates, about, moved, poses, keep, add, scale, epsilon, turns_about: tl.constexpr,
    block: tl.constexpr,
):  # fmt: skip
    """Poses float64 [P, 4, 4] after a step from the gradients d_c2w float32 [P, 3, 4], into ``moved``. mean, square,
    rates: float64 [P, 6]; keep, add, scale: see ``adam``; about: float64 [P, 3], in camera coordinates, where
    ``turns_about`` says that there is one."""
    p = tl.program_id(0) * block + tl.arange(0, block)
    live = p < poses
    r0, r1, r2 = triple(c2w + 16 * p, live), triple(c2w + 4 + 16 * p, live), triple(c2w + 8 + 16 * p, live)
    g0, g1, g2 = triple(d_c2w + 12 * p, live), triple(d_c2w + 4 + 12 * p, live), triple(d_c2w + 8 + 12 * p, live)
    pull = (
        tl.load(d_c2w + 12 * p + 3, live, 0.0).to(tl.float64),
        tl.load(d_c2w + 12 * p + 7, live, 0.0).to(tl.float64),
        tl.load(d_c2w + 12 * p + 11, live, 0.0).to(tl.float64),
    )
    twist = dot(g2, r1) - dot(g1, r2), dot(g0, r2) - dot(g2, r0), dot(g1, r0) - dot(g0, r1)
    zero = tl.zeros_like(pull[0])
    centre = (zero, zero, zero)
    if turns_about:
        centre = triple(about + 3 * p, live)
        lever = cross((dot(r0, centre), dot(r1, centre), dot(r2, centre)), pull)
        twist = twist[0] - lever[0], twist[1] - lever[1], twist[2] - lever[2]
    numbers = keep, add, scale, epsilon
    shift = (
        adam(mean, square, rates, pull[0], 0, p, live, *numbers),
        adam(mean, square, rates, pull[1], 1, p, live, *numbers),
        adam(mean, square, rates, pull[2], 2, p, live, *numbers),
    )
    turn = (
        adam(mean, square, rates, twist[0], 3, p, live, *numbers),
        adam(mean, square, rates, twist[1], 4, p, live, *numbers),
        adam(mean, square, rates, twist[2], 5, p, live, *numbers),
    )
    a, b = rodrigues(dot(turn, turn))
    rows = (r0, r1, r2)
    put_row(moved, p, 0, turned(turn, a, b, rows, 0), tl.load(c2w + 16 * p + 3, live, 0.0), shift[0], r0, centre, live)
    put_row(moved, p, 1, turned(turn, a, b, rows, 1), tl.load(c2w + 16 * p + 7, live, 0.0), shift[1], r1, centre, live)
    put_row(moved, p, 2, turned(turn, a, b, rows, 2), tl.load(c2w + 16 * p + 11, live, 0.0), shift[2], r2, centre, live)
    for k in tl.static_range(4):
        tl.store(moved + 16 * p + 12 + k, zero + (1.0 if k == 3 else 0.0), live)
