"""The 3D scene: mesh, both trajectories, keyframe frusta with the window, the current camera, loop-closure links.

Every node is made once and updated in place. Only the hub's thread calls these methods.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from ecslam.messages import LoopEvent, MeshReady, Snapshot
from ecslam.types import Mesh

from . import theme
from .geometry import (
    FRUSTUM_FACES,
    NEARLY_LEVEL_DEG,
    best_side,
    first_side,
    frustum_corners,
    frustum_lines,
    level,
    polyline,
    rotation_to,
    up_direction,
    wxyz,
)
from .glb import simplify, to_glb
from .grids import GAP_M, add_grid, paint

MESH_MODES = ("Colour", "Normals", "Wireframe", "Off")
FRUSTUM_M, CAMERA_M = 0.09, 0.28
LINKS_LAST_FRAMES = 15
SAMPLE = 2000
_NO_LINES = np.zeros((0, 2, 3), np.float32)


class Scene:
    """Draws snapshots on a viser server. ``on_keyframe(client, index)`` is called when a frustum is clicked.

    points: [n, 3] metres, a sample of what there is to see; up: [3] unit.
    """

    def __init__(self, server: viser.ViserServer, on_keyframe: Callable[[Any, int], None] | None = None) -> None:
        self._server = server
        self._on_keyframe = on_keyframe
        self._mode = MESH_MODES[0]
        self._mesh: Mesh | None = None
        self._mesh_handle: viser.GlbHandle | None = None
        self._frusta: viser.BatchedMeshHandle | None = None
        self._keyframes_wanted = True
        self._camera: viser.CameraFrustumHandle | None = None
        self._inspected: LoopEvent | None = None
        self._inspected_window: tuple[int, ...] = ()
        self._walked = np.zeros((1, 3))
        self.points = np.array([[-1.0, -1, -1], [1, 1, 1]])
        self.up, self._back = np.array([0.0, 0.0, 1.0]), np.array([0.8, -0.6, 0.0])
        self._guessed_up = self.up
        self._best_side: NDArray[np.float64] | None = None
        server.scene.configure_default_lights(cast_shadow=False)
        self._grid = add_grid(server.scene, "/grid")
        self._lines = {
            name: server.scene.add_line_segments(
                f"/{name}", _NO_LINES, color, thickness=width, thickness_units="screen"
            )
            for name, color, width in (
                ("trajectory/ground truth", theme.TRUTH, 1.8),
                ("trajectory/estimate", theme.ESTIMATE, 5.0),
                ("trajectory/other run", theme.OTHER, 3.4),
                ("trajectory/before the loop", theme.BEFORE, 2.0),
                ("keyframes/all", theme.KEYFRAME, 1.0),
                ("keyframes/window", theme.WINDOW, 2.2),
                ("loops/links", theme.LOOP, 3.5),
            )
        }

    @property
    def mesh(self) -> Mesh | None:
        """The mesh on show, simplified to the triangle budget."""
        return self._mesh

    @property
    def surface(self) -> Mesh | None:
        """The mesh that viewers see; None where there is none, or none is wanted."""
        return None if self._mode == "Off" else self._mesh

    @property
    def side(self) -> NDArray[np.float64]:
        """The horizontal direction [3] from what there is to see towards where it is seen best."""
        return self._back if self._best_side is None else self._best_side

    @property
    def floor(self) -> NDArray[np.float64]:
        """The middle [3] of the floor's grid."""
        return np.array(self._grid.position)

    # ---- what is drawn -------------------------------------------------------------------------------------------

    def begin(self, s: Snapshot) -> None:
        """Take the up direction from a run's first snapshot, and forget the last run."""
        poses = s.trajectory if s.trajectory_gt is None else s.trajectory_gt
        self.up = self._guessed_up = up_direction(poses)
        self._inspected, self._mesh = None, None
        self._lines["trajectory/before the loop"].points = _NO_LINES
        self._server.scene.set_up_direction(tuple(self.up))
        if self._mesh_handle is not None:
            self._mesh_handle.visible = False
        centres = poses[np.isfinite(poses).all((1, 2)), :3, 3]
        self._walked = centres[:: max(1, len(centres) // SAMPLE)] if len(centres) else np.zeros((1, 3))
        self.points = np.concatenate([self._walked - 1.0, self._walked + 1.0])
        self._back, self._best_side = first_side(s.trajectory, self.up), None
        self._grid.wxyz = rotation_to(self.up)
        self._grid.position = (centres.mean(0) if len(centres) else np.zeros(3)) - 1.5 * self.up

    def update(self, s: Snapshot) -> None:
        """Draw trajectories, frusta, window, camera and links of a snapshot."""
        centres = s.trajectory[:, :3, 3]
        with self._server.atomic():
            self._lines["trajectory/estimate"].points = polyline(centres)
            truth = _NO_LINES if s.trajectory_gt is None else polyline(s.trajectory_gt[:, :3, 3])
            if not np.array_equal(truth, self._lines["trajectory/ground truth"].points):
                self._lines["trajectory/ground truth"].points = truth
            self._draw_keyframes(s)
            self._draw_camera(s)
            self._draw_loop(s)

    def set_mesh(self, ready: MeshReady) -> None:
        """Show a mesh, simplified to the triangle budget where it is larger."""
        if len(ready.mesh.faces) == 0:
            return
        self.show_mesh(ready.mesh)

    def show_mesh(self, mesh: Mesh) -> None:
        """Put ``mesh`` in the place of the one on show."""
        self._mesh = simplify(mesh)
        self._stand_upright(self._mesh)
        self._best_side = best_side(self._mesh, self.up, self._best_side)
        low, high = np.percentile(self._mesh.vertices, (1, 99), axis=0)
        some = self._mesh.vertices[:: max(1, len(self._mesh.vertices) // SAMPLE)].astype(float)
        self.points = np.concatenate([some.clip(low, high), self._walked])
        self._grid.position = (low + high) / 2 + (float(((some - (low + high) / 2) @ self.up).min()) - GAP_M) * self.up
        self._draw_mesh()

    def _stand_upright(self, mesh: Mesh) -> None:
        """Cameras that look down take up for where they came from; floors and tables know better."""
        found = level(mesh, self._guessed_up)
        if found is not None and found @ self.up < np.cos(np.radians(NEARLY_LEVEL_DEG)):
            self.up, self._best_side = found, None
            self._grid.wxyz = rotation_to(self.up)

    def compare(self, centres: NDArray[np.float64]) -> None:
        """Draw another run's camera centres [n, 3] beside this one's."""
        self._lines["trajectory/other run"].points = polyline(centres)

    def set_dark(self, dark: bool) -> None:
        """Draw the floor's grid for a dark or a light page."""
        paint(self._grid, dark)

    def set_mode(self, mode: str) -> None:
        """Show the mesh as one of ``MESH_MODES``."""
        self._mode = mode
        self._draw_mesh()

    def inspect(self, event: LoopEvent | None, window: tuple[int, ...] = ()) -> None:
        """Show a loop event's links, window and the trajectory before its correction until ``inspect(None)``."""
        self._inspected, self._inspected_window = event, window
        before = _NO_LINES if event is None else polyline(event.trajectory_before.astype(float))
        self._lines["trajectory/before the loop"].points = before

    def set_visible(self, name: str, visible: bool) -> None:
        """Show or hide a group: ``keyframes`` or ``trajectory/ground truth``."""
        for key, lines in self._lines.items():
            if key.startswith(name):
                lines.visible = visible
        if name == "keyframes":
            self._keyframes_wanted = visible
            if self._frusta is not None:
                self._frusta.visible = visible and self._inspected is None

    def _draw_mesh(self) -> None:
        if self._mode == "Off" or self._mesh is None:
            if self._mesh_handle is not None:
                self._mesh_handle.visible = False
            return
        data = to_glb(self._mesh, _mesh_colors(self._mesh, self._mode), wireframe=self._mode == "Wireframe")
        if self._mesh_handle is None:
            self._mesh_handle = self._server.scene.add_glb("/mesh", data, cast_shadow=False, receive_shadow=False)
        else:
            with self._server.atomic():
                self._mesh_handle.glb_data = data
                self._mesh_handle.visible = True

    def _draw_keyframes(self, s: Snapshot) -> None:
        poses = np.array([k.c2w for k in s.keyframes]).reshape(-1, 4, 4)
        window = s.window if self._inspected is None else (*self._inspected_window, *self._inspected.keyframes)
        chosen = np.isin([k.frame for k in s.keyframes], window)
        others = poses[~chosen] if self._inspected is None else poses[:0]
        for name, some in (("all", others), ("window", poses[chosen])):
            self._lines[f"keyframes/{name}"].points = frustum_lines(some, s.fov_y_rad, s.aspect, FRUSTUM_M)
        if self._frusta is not None:
            self._frusta.visible = len(poses) > 0 and self._keyframes_wanted and self._inspected is None
        if len(poses) == 0:
            return
        colors = np.where(chosen[:, None], theme.WINDOW, theme.KEYFRAME).astype(np.uint8)
        if self._frusta is None:
            self._frusta = self._server.scene.add_batched_meshes_simple(
                "/keyframes/faces",
                frustum_corners(s.fov_y_rad, s.aspect, FRUSTUM_M),
                FRUSTUM_FACES,
                wxyz(poses),
                poses[:, :3, 3],
                batched_colors=colors,
                opacity=0.14,
                side="double",
                lod="off",
                cast_shadow=False,
                receive_shadow=False,
            )
            if self._on_keyframe is not None:
                self._frusta.on_click(self._clicked)
        else:
            self._frusta.vertices = frustum_corners(s.fov_y_rad, s.aspect, FRUSTUM_M).astype(np.float32)
            self._frusta.batched_wxyzs = wxyz(poses).astype(np.float32)
            self._frusta.batched_positions = poses[:, :3, 3].astype(np.float32)
            self._frusta.batched_colors = colors

    async def _clicked(self, event: Any) -> None:
        if event.instance_index is not None and self._on_keyframe is not None:
            self._on_keyframe(event.client, int(event.instance_index))

    def _draw_camera(self, s: Snapshot) -> None:
        if self._camera is not None:
            self._camera.visible = len(s.trajectory) > 0
        if len(s.trajectory) == 0:
            return
        at = len(s.trajectory) - 1 if self._inspected is None else min(self._inspected.frame, len(s.trajectory) - 1)
        pose = s.trajectory[at]
        if self._camera is None:
            self._camera = self._server.scene.add_camera_frustum(
                "/camera",
                s.fov_y_rad,
                s.aspect,
                scale=CAMERA_M,
                thickness=3.0,
                thickness_units="screen",
                color=theme.ESTIMATE,
                cast_shadow=False,
                receive_shadow=False,
                jpeg_quality=80,
            )
        self._camera.fov, self._camera.aspect = s.fov_y_rad, s.aspect
        self._camera.position = pose[:3, 3]
        self._camera.wxyz = wxyz(pose)
        self._camera.image = s.color if self._inspected is None else None

    def _draw_loop(self, s: Snapshot) -> None:
        event = self._inspected
        if event is None and s.loops and 0 <= s.frame - s.loops[-1].frame <= LINKS_LAST_FRAMES:
            event = s.loops[-1]
        links = _NO_LINES
        if event is not None and event.frame < len(s.trajectory):
            here = s.trajectory[event.frame, :3, 3]
            old = [k.c2w[:3, 3] for k in s.keyframes if k.frame in event.keyframes]
            links = np.array([[here, there] for there in old], np.float32).reshape(-1, 2, 3)
        self._lines["loops/links"].points = links


def _mesh_colors(mesh: Mesh, mode: str) -> NDArray[np.uint8]:
    if mode == "Normals" or mesh.colors is None:
        return np.round(127.5 + 127.5 * mesh.vertex_normals()).astype(np.uint8)
    return mesh.colors
