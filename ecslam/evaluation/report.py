"""All figures of the reconstruction tables (paper, section IV) for one mesh."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ..types import InputError, Intrinsics, Mesh
from .culling import (
    OCCLUSION_MARGIN_M,
    culled,
    faces_seen,
    faces_seen_whole,
    framed,
    observed,
    rendered_depth,
    spread_frames,
)
from .depth_views import TRIES_PER_VIEW, depth_l1, random_views, up_direction, viewpoint_candidates
from .reconstruction import register, surface_error
from .surface import moved, part, sample_surface, subdivided

LONGEST_EDGE_M = 0.03
CULLING_WIDTH = 640
CLEARANCE_M = 0.1
REGISTRATION_SAMPLES = 30_000

Progress = Callable[[float], None]
Poses = NDArray[np.float64]


def evaluate_run(
    mesh: Mesh,
    reference: Mesh,
    intrinsics: Intrinsics,
    poses: Poses,
    *,
    samples: int = 200_000,
    views: int = 1000,
    align: bool = True,
    progress: Progress | None = None,
) -> dict[str, float | None]:
    """depth_l1_cm, accuracy_cm, completion_cm and completion_ratio (per cent) of a mesh against the true surface.

    poses: [N, 4, 4] true camera-to-world poses in the reference's world, with which both meshes are culled (see
    ``culling``); not finite where unknown. align: register the mesh to the reference by ICP first, as NICE-SLAM and
    Co-SLAM do. progress: gets the share done in 0..1. A figure is None where there is nothing to measure, e.g. for an
    empty mesh. The same input gives the same figures.

    Raises InputError when no pose is known or the cameras see nothing of the reference.
    """
    rng = np.random.default_rng(0)
    report = progress or (lambda done: None)
    poses = poses[spread_frames(poses)]
    if not len(poses):
        raise InputError("evaluation: no true pose is known; use a sequence with ground truth")
    up = up_direction(poses)
    camera = _at_most(intrinsics, CULLING_WIDTH)

    reference = subdivided(reference, LONGEST_EDGE_M)
    places = viewpoint_candidates(_bounds(reference), up, TRIES_PER_VIEW * views, rng)
    seen, places = _look_at_reference(reference, places, poses, camera, lambda done: report(0.15 * done))
    mesh = subdivided(mesh, LONGEST_EDGE_M)
    mesh = culled(mesh, framed(mesh.vertices, poses, camera))
    shown = _seen_part(mesh, poses, camera, lambda done: report(0.15 + 0.15 * done))

    truth = sample_surface(part(reference, faces_seen(reference, seen)), samples, rng)
    points = sample_surface(shown, samples, rng)
    if not len(points):
        return dict.fromkeys(("depth_l1_cm", "accuracy_cm", "completion_cm", "completion_ratio"))
    if align:
        motion = register(points[:REGISTRATION_SAMPLES], truth)
        mesh, points = moved(mesh, motion), motion.apply(points)
    surface = surface_error(points, truth)
    looks = random_views(places, up, rng)
    whole = faces_seen_whole(reference, seen)
    depth = depth_l1(mesh, reference, whole, looks, views, progress=lambda done: report(0.4 + 0.6 * done))
    report(1.0)
    return {
        "depth_l1_cm": depth.cm if depth else None,
        "accuracy_cm": surface.accuracy_cm,
        "completion_cm": surface.completion_cm,
        "completion_ratio": surface.completion_ratio,
    }


def _look_at_reference(
    reference: Mesh, places: NDArray[np.float64], poses: Poses, camera: Intrinsics, progress: Progress
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Which vertices (bool [V]) the cameras saw, and those of the places [N, 3] that they saw to be free."""
    points = np.concatenate([reference.vertices, places])
    margins = np.full(len(points), -CLEARANCE_M)
    margins[: len(reference.vertices)] = OCCLUSION_MARGIN_M
    hit = observed(points, poses, camera, rendered_depth(reference, poses, camera), margins, progress=progress)
    seen = hit[: len(reference.vertices)]
    if not seen.any():
        raise InputError("evaluation: the cameras see nothing of the reference mesh; check that their worlds agree")
    return seen, places[hit[len(reference.vertices) :]]


def _seen_part(mesh: Mesh, poses: Poses, camera: Intrinsics, progress: Progress) -> Mesh:
    return culled(mesh, observed(mesh.vertices, poses, camera, rendered_depth(mesh, poses, camera), progress=progress))


def _bounds(mesh: Mesh) -> NDArray[np.float64]:
    if not len(mesh.vertices):
        raise InputError("evaluation: the reference mesh is empty")
    return np.stack([mesh.vertices.min(0), mesh.vertices.max(0)]).astype(np.float64)


def _at_most(camera: Intrinsics, width: int) -> Intrinsics:
    if camera.width <= width:
        return camera
    return camera.resized(width, round(camera.height * width / camera.width))
