"""The readable back end: plain torch, one thought a line, gradients by autograd. Every other back end must agree.

Works in float32 and float64 on any device; the tests check it by ``gradcheck`` and on analytic scenes.
"""

from __future__ import annotations

import torch
from torch import Tensor

from .. import se3
from .reference_depths import importance_depths as importance_depths
from .reference_depths import sample_depths as sample_depths
from .types import (
    FEATURES,
    HIDDEN,
    AdamStep,
    AlignSettings,
    FieldParams,
    GridLayout,
    NormalEquations,
    PoseMoments,
    RayBatch,
    StepResult,
    Weights,
)

LUMINANCE = (0.299, 0.587, 0.114)
PRIMES = (1, 2654435761, 805459861)
CORNERS = [(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)]


def row(layout: GridLayout, level: int, k: Tensor) -> Tensor:
    """Table rows of integer lattice points k int64 [..., 3] at one level."""
    size = int(layout.size[level])
    if int(layout.dims[level, 0]):
        nx, ny, nz = layout.dims[level].tolist()
        first = layout.first[level].to(k.device)
        x, y, z = (k - first).unbind(-1)
        inside = (z.clamp(0, nz - 1) * ny + y.clamp(0, ny - 1)) * nx + x.clamp(0, nx - 1)
    else:
        x, y, z = k.unbind(-1)
        inside = ((x * PRIMES[0]) ^ (y * PRIMES[1]) ^ (z * PRIMES[2])) & (size - 1)
    return inside + int(layout.offset[level])


def encode_hash(layout: GridLayout, table: Tensor, points: Tensor) -> Tensor:
    """Hash features [N, 2 L] of points [N, 3] inside the box (paper, equation 1): trilinear at every level."""
    features = []
    for level in range(layout.levels):
        p = (points - layout.anchor.to(points)) / layout.voxel[level].to(points)
        cell = p.detach().floor()
        f = p - cell
        total = points.new_zeros(points.shape[0], FEATURES)
        for corner in CORNERS:
            c = torch.tensor(corner, device=points.device)
            weight = torch.where(c.bool(), f, 1 - f).prod(-1)
            total = total + weight[:, None] * table[row(layout, level, cell.long() + c)]
        features.append(total)
    return torch.cat(features, -1)


def encode_one_blob(layout: GridLayout, points: Tensor) -> Tensor:
    """One-blob encoding [N, 3 bins]: a quartic kernel one bin wide, integrated over each bin, periodic."""
    bins = layout.bins
    u = (points - layout.blob_low.to(points)) / layout.blob_size.to(points)
    u = u - u.detach().floor()
    edges = torch.arange(bins + 1, device=points.device, dtype=points.dtype) / bins
    total = points.new_zeros(*points.shape, bins)
    for shift in (-1.0, 0.0, 1.0):
        t = ((edges + shift - u[..., None]) * bins).clamp(-1, 1)
        cdf = 0.9375 * t * (1 - (2 / 3) * t**2 + 0.2 * t**4) + 0.5
        total = total + cdf[..., 1:] - cdf[..., :-1]
    return total.flatten(-2)


def field(layout: GridLayout, params: FieldParams, points: Tensor) -> tuple[Tensor, Tensor]:
    """TSDF [N] and colour [N, 3] of points [N, 3] in metres. Both decoders see the same encoding."""
    low, high = layout.box.to(points)
    inside = torch.minimum(torch.maximum(points, low), high)
    encoding = torch.cat([encode_hash(layout, params.table, inside), encode_one_blob(layout, inside)], -1)
    hidden = torch.relu(encoding @ params.w_in)
    sdf = (hidden[:, :HIDDEN] @ params.w_sdf)[:, 0]
    rgb = torch.sigmoid(hidden[:, HIDDEN:] @ params.w_rgb)
    return sdf, rgb


def ray_weights(sdf: Tensor, beta: Tensor) -> Tensor:
    """Rendering weights [R, S] from TSDF values [R, S] along rays (paper, equations 2 and 3)."""
    sigma = beta * torch.sigmoid(-beta * sdf)
    before = torch.cumsum(sigma, -1) - sigma
    return torch.exp(-before) * (1 - torch.exp(-sigma))


def _render(
    layout: GridLayout, params: FieldParams, c2w: Tensor, rays: RayBatch
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    pose = c2w[rays.pose]
    local = rays.z[..., None] * rays.direction[:, None, :]
    points = torch.einsum("rij,rsj->rsi", pose[:, :3, :3], local) + pose[:, None, :3, 3]
    sdf, rgb = field(layout, params, points.reshape(-1, 3))
    sdf, rgb = sdf.reshape(rays.z.shape), rgb.reshape(*rays.z.shape, 3)
    weights = ray_weights(sdf, params.beta)
    return (weights[..., None] * rgb).sum(1), (weights * rays.z).sum(1), weights, sdf


def _mean_per_ray(value: Tensor, mask: Tensor, rays: Tensor) -> Tensor:
    """Mean over each ray's masked samples, then over ``rays`` (how many count)."""
    return ((value * mask).sum(1) / mask.sum(1).clamp_min(1)).sum() / rays.clamp_min(1)


def losses(color: Tensor, depth: Tensor, sdf: Tensor, rays: RayBatch, w: Weights) -> Tensor:
    """The weighted terms [5] of the paper's objective (equations 4 to 8) for rendered rays.

    Colour errors are averaged over the channels; rays without a measured depth take part in the colour term only.
    """
    has = rays.depth > 0
    measured = has.sum()
    signed = rays.z - rays.depth[:, None]
    front = has[:, None] & (signed < -w.truncation_m)
    band = has[:, None] & (signed.abs() <= w.truncation_m)
    centre = band & (signed.abs() < w.centre_share * w.truncation_m)
    surface = (signed + sdf * w.truncation_m) ** 2
    d_error = torch.where(has, (depth - rays.depth) ** 2, torch.zeros_like(depth))
    c_error = ((color - rays.color) ** 2).mean(-1)
    feature, uniform = rays.feature, ~rays.feature

    def group(error: Tensor, members: Tensor) -> Tensor:
        return (error * members).sum() / members.sum().clamp_min(1)

    return torch.stack(
        [
            w.free_space * _mean_per_ray((sdf - 1) ** 2, front, measured),
            w.centre * _mean_per_ray(surface, centre, measured),
            w.tail * _mean_per_ray(surface, band & ~centre, measured),
            w.depth_uniform * group(d_error, uniform & has) + w.depth_feature * group(d_error, feature & has),
            w.colour_uniform * group(c_error, uniform) + w.colour_feature * group(c_error, feature),
        ]
    )


# ---- the seam -----------------------------------------------------------------------------------------------------


@torch.no_grad()
def values(layout: GridLayout, params: FieldParams, points: Tensor) -> tuple[Tensor, Tensor]:
    """TSDF [N] and colour [N, 3] in 0..1 at world points [N, 3]."""
    return field(layout, params, points)


def gradients(layout: GridLayout, params: FieldParams, points: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """TSDF [N], its gradient [N, 3] per metre, luminance [N] in 0..1 and its gradient [N, 3] at world points [N, 3]."""
    with torch.enable_grad():
        x = points.detach().requires_grad_()
        sdf, rgb = field(layout, params, x)
        luminance = rgb @ rgb.new_tensor(LUMINANCE)
        d_sdf = torch.autograd.grad(sdf.sum(), x, retain_graph=True)[0]
        d_luminance = torch.autograd.grad(luminance.sum(), x)[0]
    return sdf.detach(), d_sdf, luminance.detach(), d_luminance


@torch.no_grad()
def render(layout: GridLayout, params: FieldParams, c2w: Tensor, rays: RayBatch) -> tuple[Tensor, Tensor, Tensor]:
    """Colour [R, 3], depth [R] and weights [R, S] of rays seen from poses c2w [P, 3 or 4, 4]."""
    color, depth, weights, _ = _render(layout, params, c2w, rays)
    return color, depth, weights


def step(
    layout: GridLayout,
    params: FieldParams,
    c2w: Tensor,
    rays: RayBatch,
    weights: Weights,
    into: FieldParams | None,
    want_poses: bool,
    adam: AdamStep | None = None,
) -> StepResult:
    """Render, compare, differentiate. Parameter gradients overwrite ``into`` unless it is None; with ``adam`` the table
    takes its step as well."""
    with torch.enable_grad():
        names = FieldParams.__dataclass_fields__
        leaves = {n: getattr(params, n).detach().requires_grad_(into is not None) for n in names}
        pose = c2w[:, :3, :].detach().requires_grad_(want_poses)
        color, depth, _, sdf = _render(layout, FieldParams(**leaves), pose, rays)
        terms = losses(color, depth, sdf, rays, weights)
        wanted = (list(leaves.values()) if into is not None else []) + ([pose] if want_poses else [])
        found = torch.autograd.grad(terms.sum(), wanted, allow_unused=True, materialize_grads=True) if wanted else ()
    if into is not None:
        for name, gradient in zip(names, found, strict=False):
            getattr(into, name).copy_(gradient)
        if adam is not None:
            map_step([params.table], [into.table], adam)
    return StepResult(terms.detach(), found[-1] if want_poses else None)


def normal_equations(
    layout: GridLayout, params: FieldParams, c2w: Tensor, points: Tensor, luminance: Tensor, settings: AlignSettings
) -> NormalEquations:
    """Sums for one Gauss-Newton step that moves camera points [N, 3] seen from c2w [3 or 4, 4] onto the zero level set.

    The residual of a point is its TSDF in metres; with ``colour_weight`` a second one is the luminance error times that
    weight. Geman-McClure weights (k^2 / (k^2 + r^2))^2, cost k^2 r^2 / (k^2 + r^2) / 2 per residual.
    """
    s = settings
    rotated = points @ c2w[:3, :3].T
    sdf, d_sdf, value, d_value = gradients(layout, params, rotated + c2w[:3, 3])
    norm = d_sdf.norm(dim=-1) * s.truncation_m
    keep = (sdf.abs() < s.tsdf_limit) & (norm > s.gradient_low) & (norm < s.gradient_high)
    jtj = torch.zeros(6, 6, dtype=torch.float64, device=points.device)
    jtr = torch.zeros(6, dtype=torch.float64, device=points.device)
    cost, inliers = 0.0, 0
    parts = [(sdf * s.truncation_m, d_sdf * s.truncation_m, s.kernel_m)]
    if s.colour_weight > 0:
        scale = s.colour_weight
        parts.append(((value - luminance) * scale, d_value * scale, s.colour_kernel * scale))
    for residual, gradient, kernel in parts:
        r, g = residual[keep].double(), gradient[keep].double()
        j = torch.cat([g, torch.cross(rotated[keep].double(), g, dim=-1)], -1)
        share = kernel**2 / (kernel**2 + r**2)
        w = share**2
        jtj += (j * w[:, None]).T @ j
        jtr += j.T @ (w * r)
        cost += float(0.5 * (r**2 * share).sum())
        if residual is parts[0][0]:
            inliers = int((w > 0.5).sum())
    return NormalEquations(jtj, jtr, cost, int(keep.sum()), inliers)


def pose_step(c2w: Tensor, d_c2w: Tensor, moments: PoseMoments, rates: Tensor, count: int) -> Tensor:
    """Poses float64 [P, 4, 4] after step ``count`` (from 1 on) of Adam in the tangent of ``se3.retract``.

    d_c2w: gradients [P, 3, 4]. rates: float64 [P, 6].
    """
    mean, square, decays = moments.mean, moments.square, moments.decays
    gradient = se3.tangent_gradient(c2w, d_c2w.to(c2w.dtype), moments.about)
    mean.mul_(decays[0]).add_(gradient, alpha=1 - decays[0])
    square.mul_(decays[1]).addcmul_(gradient, gradient, value=1 - decays[1])
    first, second = mean / (1 - decays[0] ** count), square / (1 - decays[1] ** count)
    return se3.retract(c2w, -rates * first / (second.sqrt() + moments.epsilon), moments.about)


def map_step(parameters: list[Tensor], gradients: list[Tensor], adam: AdamStep) -> None:
    """Take a step for ``parameters``, in place; all float32 on one device. One launch on a GPU, however many there are:
    torch's fused update, without the seconds that importing ``torch.optim``'s compiler support costs."""
    torch._fused_adam_(
        parameters,
        gradients,
        adam.mean,
        adam.square,
        [],
        [adam.count] * len(parameters),
        lr=adam.rate,
        beta1=adam.decays[0],
        beta2=adam.decays[1],
        weight_decay=0.0,
        eps=adam.epsilon,
        amsgrad=False,
        maximize=False,
    )


def smoothness(layout: GridLayout, table: Tensor, lattice: Tensor) -> Tensor:
    """Gradient [rows, 2] by the table of the mean squared difference of hash features between neighbours in a lattice
    [n^3, 3] of points inside the box (Co-SLAM, equation 9). Without autograd, whose graph would take gigabytes."""
    n = round(len(lattice) ** (1 / 3))
    corners = torch.tensor(CORNERS, device=table.device)
    gradient = torch.zeros_like(table)
    for level in range(layout.levels):
        p = (lattice - layout.anchor.to(lattice)) / layout.voxel[level].to(lattice)
        cell = p.floor()
        f = (p - cell)[:, None]
        weight = torch.where(corners.bool(), f, 1 - f).prod(-1)  # [n^3, 8]
        rows = row(layout, level, cell.long()[:, None] + corners)
        feature = (weight[..., None] * table[rows]).sum(1).reshape(n, n, n, -1)
        d_feature = torch.zeros_like(feature)
        for axis in range(3):
            d = torch.diff(feature, dim=axis)
            d_feature.narrow(axis, 1, n - 1).add_(d, alpha=2 / n**3)
            d_feature.narrow(axis, 0, n - 1).sub_(d, alpha=2 / n**3)
        spread = weight[..., None] * d_feature.reshape(-1, 1, feature.shape[-1])
        gradient.index_add_(0, rows.reshape(-1), spread.reshape(-1, feature.shape[-1]))
    return gradient
