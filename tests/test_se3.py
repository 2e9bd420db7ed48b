"""Laws of rigid motions."""

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ecslam import se3

vectors = st.lists(st.floats(-3, 3), min_size=6, max_size=6).map(lambda x: torch.tensor(x, dtype=torch.float64))


def pose(xi):
    return se3.retract(torch.eye(4, dtype=torch.float64), xi)


@given(vectors)
def test_exponential_is_a_rotation(xi):
    r = se3.so3_exp(xi[3:])
    assert torch.allclose(r @ r.T, torch.eye(3, dtype=r.dtype), atol=1e-12)
    assert torch.allclose(torch.linalg.det(r), torch.ones((), dtype=r.dtype))


@given(vectors)
def test_logarithm_inverts_the_exponential(xi):
    w = xi[3:]
    if w.norm() > 3.1:
        w = w / w.norm() * 3.1
    assert torch.allclose(se3.so3_log(se3.so3_exp(w)), w, atol=1e-6)


def test_logarithm_of_half_a_turn():
    for axis in torch.eye(3, dtype=torch.float64):
        r = se3.so3_exp(axis * np.pi)
        assert torch.allclose(se3.so3_log(r).abs(), axis * np.pi, atol=1e-6)


@given(vectors)
def test_inverse_undoes(xi):
    t = pose(xi).numpy()
    assert np.allclose(t @ se3.inverse(t), np.eye(4), atol=1e-12)


@given(vectors, vectors)
@settings(max_examples=25)
def test_tangent_gradient_is_the_derivative_of_retract(start, probe):
    """Oracle: autograd through ``retract`` at zero."""
    c2w = pose(start)
    upstream = torch.outer(probe[:3], torch.cat([probe[2:5], torch.ones(1, dtype=torch.float64)]))
    for about in (None, probe[3:]):
        xi = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        (se3.retract(c2w, xi, about)[:3] * upstream).sum().backward()
        assert torch.allclose(se3.tangent_gradient(c2w, upstream, about), xi.grad, atol=1e-9)


@given(vectors, st.floats(0, 170))
def test_rotation_angle(xi, degrees):
    a = pose(xi)
    w = torch.tensor([0.0, 0.0, np.radians(degrees)], dtype=torch.float64)
    b = a.clone()
    b[:3, :3] = a[:3, :3] @ se3.so3_exp(w)
    assert abs(se3.rotation_angle_deg(a.numpy(), b.numpy()) - degrees) < 1e-6


@given(vectors)
def test_orthonormalise_is_identity_on_rigid_motions_and_repairs_others(xi):
    t = pose(xi).numpy()
    assert np.allclose(se3.orthonormalise(t), t, atol=1e-12)
    bent = t.copy()
    bent[:3, :3] *= 1.001
    assert np.allclose(se3.orthonormalise(bent), t, atol=1e-9)


@given(vectors, vectors)
@settings(max_examples=25)
def test_a_turn_about_a_point_leaves_it_where_it_is(start, probe):
    c2w, about = pose(start), probe[:3]
    turned = se3.retract(c2w, torch.cat([torch.zeros(3, dtype=torch.float64), probe[3:]]), about)
    assert torch.allclose(turned[:3, :3] @ about + turned[:3, 3], c2w[:3, :3] @ about + c2w[:3, 3], atol=1e-9)
    assert torch.allclose(turned[:3, :3], pose(torch.cat([start[:3], probe[3:]]))[:3, :3] @ c2w[:3, :3], atol=1e-9)
