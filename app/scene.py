"""The 3D scene: mesh, both trajectories, keyframe frusta with the window, the current camera, loop-closure links.

Every node is made once and updated in place. Only the hub's thread calls these methods.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from ecslam.messages import KeyframeView, LoopEvent, MeshReady, Snapshot
from ecslam.types import Mesh

from . import theme
from .geometry import (
    FRUSTUM_FACES,
    behind,
    frustum_corners,
    frustum_lines,
    overview,
    polyline,
    rotation_to,
    up_direction,
    wxyz,
)
from .glb import simplify, to_glb, vertex_normals

MESH_MODES = ("Colour", "Normals", "Wireframe", "Off")
FRUSTUM_M = 0.13
LINKS_LAST_FRAMES = 15
_NO_LINES = np.zeros((0, 2, 3), np.float32)


class Scene:
    """Draws snapshots on a viser server. ``on_keyframe(client, index)`` is called when a frustum is clicked."""

    def __init__(self, server: viser.ViserServer, on_keyframe: Callable[[Any, int], None] | None = None) -> None:
        self._server = server
        self._on_keyframe = on_keyframe
        self._mode = MESH_MODES[0]
        self._mesh: Mesh | None = None
        self._mesh_handle: viser.GlbHandle | None = None
        self._frusta: viser.BatchedMeshHandle | None = None
        self._camera: viser.CameraFrustumHandle | None = None
        self._inspected: LoopEvent | None = None
        self._inspected_window: tuple[int, ...] = ()
        self._bounds: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
        self.up = np.array([0.0, 0.0, 1.0])
        self.fov_y, self.aspect = 0.9, 4 / 3
        server.scene.configure_default_lights(cast_shadow=False)
        self._grid = server.scene.add_grid(
            "/grid",
            24,
            24,
            cell_size=0.5,
            section_size=2.0,
            cell_color=theme.KEYFRAME,
            section_color=theme.KEYFRAME,
            cell_thickness=0.5,
            section_thickness=0.8,
            fade_distance=22,
            shadow_opacity=0.0,
        )
        self._lines = {
            name: server.scene.add_line_segments(
                f"/{name}", _NO_LINES, color, thickness=width, thickness_units="screen"
            )
            for name, color, width in (
                ("trajectory/ground truth", theme.TRUTH, 2.0),
                ("trajectory/estimate", theme.ESTIMATE, 3.0),
                ("trajectory/other run", theme.OTHER, 3.0),
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
    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Corners of what there is to see, in metres."""
        return self._bounds or (np.full(3, -1.0), np.full(3, 1.0))

    # ---- what is drawn -------------------------------------------------------------------------------------------

    def begin(self, snapshot: Snapshot) -> None:
        """Take the up direction and the camera's shape from a run's first snapshot, and forget the last run."""
        poses = snapshot.trajectory if snapshot.trajectory_gt is None else snapshot.trajectory_gt
        self.up = up_direction(poses)
        self.fov_y, self.aspect = snapshot.fov_y_rad, snapshot.aspect
        self._inspected, self._mesh = None, None
        self._server.scene.set_up_direction(tuple(self.up))
        if self._mesh_handle is not None:
            self._mesh_handle.visible = False
        centres = poses[np.isfinite(poses).all((1, 2)), :3, 3]
        self._bounds = (centres.min(0) - 1.0, centres.max(0) + 1.0) if len(centres) else None
        self._grid.wxyz = rotation_to(self.up)
        self._grid.position = (centres.mean(0) if len(centres) else np.zeros(3)) - 1.5 * self.up

    def update(self, s: Snapshot) -> None:
        """Draw trajectories, frusta, window, camera and links of a snapshot."""
        centres = s.trajectory[:, :3, 3]
        with self._server.atomic():
            self._lines["trajectory/estimate"].points = polyline(centres)
            truth = _NO_LINES if s.trajectory_gt is None else polyline(s.trajectory_gt[:, :3, 3])
            if len(truth) != len(self._lines["trajectory/ground truth"].points):
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
        low, high = np.percentile(self._mesh.vertices, (1, 99), axis=0).astype(float)
        self._bounds = (low, high)
        middle = (low + high) / 2
        reach = float(((self._mesh.vertices - middle) @ self.up).min())
        self._grid.position = middle + (reach - 0.02) * self.up
        self._draw_mesh()

    def compare(self, centres: NDArray[np.float64]) -> None:
        """Draw another run's camera centres [n, 3] beside this one's."""
        self._lines["trajectory/other run"].points = polyline(centres)

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
        if name == "keyframes" and self._frusta is not None:
            self._frusta.visible = visible

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
        for name, some in (("all", poses[~chosen]), ("window", poses[chosen])):
            self._lines[f"keyframes/{name}"].points = frustum_lines(some, s.fov_y_rad, s.aspect, FRUSTUM_M)
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
                opacity=0.22,
                side="double",
                lod="off",
                cast_shadow=False,
                receive_shadow=False,
            )
            if self._on_keyframe is not None:
                self._frusta.on_click(self._clicked)
        else:
            self._frusta.batched_wxyzs = wxyz(poses).astype(np.float32)
            self._frusta.batched_positions = poses[:, :3, 3].astype(np.float32)
            self._frusta.batched_colors = colors

    async def _clicked(self, event: Any) -> None:
        if event.instance_index is not None and self._on_keyframe is not None:
            self._on_keyframe(event.client, int(event.instance_index))

    def _draw_camera(self, s: Snapshot) -> None:
        if len(s.trajectory) == 0:
            return
        pose = s.trajectory[-1]
        if self._camera is None:
            self._camera = self._server.scene.add_camera_frustum(
                "/camera",
                s.fov_y_rad,
                s.aspect,
                scale=2.2 * FRUSTUM_M,
                thickness=3.0,
                thickness_units="screen",
                color=theme.ESTIMATE,
                cast_shadow=False,
                receive_shadow=False,
                jpeg_quality=80,
            )
        self._camera.position = pose[:3, 3]
        self._camera.wxyz = wxyz(pose)
        if s.color is not None:
            self._camera.image = s.color

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

    # ---- where it is seen from -----------------------------------------------------------------------------------

    def show_all(self, client: viser.ClientHandle, seconds: float = 0.6) -> None:
        """Move one viewer to where the whole scene is in sight."""
        if self._bounds is None:
            return
        self.show_box(client, *self._bounds, seconds)

    def show_box(
        self, client: viser.ClientHandle, low: NDArray[np.float64], high: NDArray[np.float64], seconds: float = 0.6
    ) -> None:
        """Move one viewer to where the box low..high is in sight."""
        camera = client.camera
        self.fly(client, *overview(low, high, self.up, camera.aspect or 1.5, camera.fov), seconds)

    def follow(self, client: viser.ClientHandle, c2w: NDArray[np.float64]) -> None:
        """Put one viewer just behind the camera."""
        position, look_at = behind(c2w, self.up)
        _place(client, position, look_at)

    def visit(self, client: viser.ClientHandle, keyframe: KeyframeView) -> None:
        """Fly one viewer to a keyframe."""
        self.fly(client, *behind(keyframe.c2w, self.up, 0.45))

    def fly(
        self,
        client: viser.ClientHandle,
        position: NDArray[np.float64],
        look_at: NDArray[np.float64],
        seconds: float = 0.6,
    ) -> None:
        """Move one viewer smoothly."""
        start = np.array(client.camera.position), np.array(client.camera.look_at)

        async def glide() -> None:
            steps = max(1, int(30 * seconds))
            for step in range(1, steps + 1):
                if client.client_id not in self._server.get_clients():
                    return
                t = step / steps
                ease = t * t * (3 - 2 * t)
                _place(client, start[0] + ease * (position - start[0]), start[1] + ease * (look_at - start[1]))
                await asyncio.sleep(1 / 30)

        asyncio.run_coroutine_threadsafe(glide(), self._server.get_event_loop())


def _place(client: viser.ClientHandle, position: NDArray[np.float64], look_at: NDArray[np.float64]) -> None:
    with client.atomic():
        client.camera.position = position
        client.camera.look_at = look_at


def _mesh_colors(mesh: Mesh, mode: str) -> NDArray[np.uint8]:
    if mode == "Normals" or mesh.colors is None:
        return np.round(127.5 + 127.5 * vertex_normals(mesh)).astype(np.uint8)
    return mesh.colors
