"""A run as one HTML file that plays by itself: the live scene's own drawing code on a server nobody can reach."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ecslam.messages import MeshReady, Snapshot
from ecslam.types import Mesh

from .front import close_viser, open_viser
from .geometry import overview
from .history import History
from .listen import bind
from .scene import Scene
from .views import FOV_RAD

STEPS, SECONDS = 150, 12.0


def html_replay(s: Snapshot, mesh: Mesh | None, history: History, dark: bool) -> str:
    """A self-contained page that replays the run up to snapshot ``s`` before its mesh."""
    server = open_viser(bind("127.0.0.1", 0), "127.0.0.1", "closed-" * 4, "EC-SLAM replay")
    try:
        scene = Scene(server)
        scene.begin(s)
        scene.set_dark(dark)
        if mesh is not None:
            scene.set_mesh(MeshReady(s.frame, 0.0, mesh))
        position, look_at = overview(scene.points, scene.up, scene.side, 1.5, FOV_RAD)
        server.initial_camera.position, server.initial_camera.look_at = tuple(position), tuple(look_at)
        server.initial_camera.up, server.initial_camera.fov = tuple(scene.up), FOV_RAD
        serializer = server.get_scene_serializer()
        for count in np.unique(np.linspace(1, len(s.trajectory), min(STEPS, len(s.trajectory))).astype(int)):
            scene.update(_until(s, int(count), history))
            serializer.insert_sleep(SECONDS / STEPS)
        return str(serializer.as_html(dark_mode=dark))
    finally:
        close_viser(server)


def _until(s: Snapshot, count: int, history: History) -> Snapshot:
    """The snapshot as it would have been after ``count`` frames, with today's poses."""
    return replace(
        s,
        frame=count - 1,
        trajectory=s.trajectory[:count],
        keyframes=tuple(k for k in s.keyframes if k.frame < count),
        window=history.window_at(count - 1),
        loops=tuple(e for e in s.loops if e.frame < count),
        color=None,
    )
