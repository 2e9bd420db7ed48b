"""A deterministic stand-in for the engine: a made-up room, a made-up walk, a loop closure; same protocol, no maths."""

from __future__ import annotations

import json
import queue
import threading
import time
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from ecslam import messages as m
from ecslam.runtime.feed import Feed
from ecslam.runtime.pictures import jpeg
from ecslam.types import InputError, Mesh

FOV, ASPECT = 0.9, 4 / 3
MESH_EVERY_S = 1.0


def room_mesh(step: float = 0.08) -> Mesh:
    """A furnished room whose faces look inwards, with painted vertex colours."""
    parts = [_box((-3, -2.5, 0), (3, 2.5, 2.6), step, inward=True)]
    furniture = [
        ((-2.9, -2.4, 0), (-1.2, 0.2, 0.55), (176, 96, 72)),
        ((0.6, -2.4, 0), (2.4, -1.5, 0.75), (150, 111, 72)),
        ((2.2, 0.2, 0), (2.9, 2.2, 1.9), (88, 120, 138)),
        ((-0.7, -0.5, 0), (0.7, 0.5, 0.42), (196, 164, 110)),
        ((-2.4, 1.5, 0), (-1.4, 2.4, 0.9), (96, 138, 92)),
    ]
    parts += [_box(low, high, step, inward=False, paint=paint) for low, high, paint in furniture]
    offsets = np.cumsum([0] + [len(p.vertices) for p in parts[:-1]])
    return Mesh(
        np.concatenate([p.vertices for p in parts]),
        np.concatenate([p.faces + o for p, o in zip(parts, offsets, strict=True)]).astype(np.int32),
        np.concatenate([p.colors for p in parts]),
    )


def _box(low, high, step, inward, paint=None):
    low, high = np.array(low, float), np.array(high, float)
    vertices, faces, colors = [], [], []
    walls = [(226, 219, 205), (226, 219, 205), (201, 211, 214), (214, 202, 188), (168, 128, 92), (240, 240, 238)]
    base = 0
    for side in range(6):
        axis, top = (0, 0, 1, 1, 2, 2)[side], side % 2 == 0
        if axis == 2:
            top = side == 5
        u, v = [k for k in range(3) if k != axis]
        nu, nv = (max(2, round((high[k] - low[k]) / step)) for k in (u, v))
        grid = np.stack(np.meshgrid(np.linspace(0, 1, nu), np.linspace(0, 1, nv), indexing="ij"), -1).reshape(-1, 2)
        points = np.empty((len(grid), 3))
        points[:, u], points[:, v] = low[u] + grid[:, 0] * (high[u] - low[u]), low[v] + grid[:, 1] * (high[v] - low[v])
        points[:, axis] = high[axis] if top else low[axis]
        i, j = np.meshgrid(np.arange(nu - 1), np.arange(nv - 1), indexing="ij")
        a = (i * nv + j).ravel()
        quad = np.concatenate([np.stack([a, a + nv, a + nv + 1], 1), np.stack([a, a + nv + 1, a + 1], 1)])
        outward = top if axis != 1 else not top
        if outward == inward:
            quad = quad[:, ::-1]
        vertices.append(points)
        faces.append(quad + base)
        base += len(points)
        color = np.array(paint if paint is not None else walls[side], float)
        stripe = 0.93 + 0.07 * np.sign(np.sin(points @ [5.0, 7.0, 11.0] * (2.2 if side == 4 else 0.7)))
        shade = (1.06, 0.9, 0.98, 0.86, 0.8, 1.08)[side]
        colors.append(np.clip(color * stripe[:, None] * shade, 0, 255))
    return Mesh(
        np.concatenate(vertices).astype(np.float32), np.concatenate(faces), np.concatenate(colors).astype(np.uint8)
    )


def walk(count: int) -> np.ndarray:
    """Ground truth [n, 4, 4]: once around the room and a little further, looking across it."""
    angle = np.linspace(0, 2.3 * np.pi, count)
    radius = 1.0 - 0.35 * np.clip(angle / np.pi - 1.6, 0, 0.7)
    eye = np.stack([1.7 * radius * np.cos(angle), 1.35 * radius * np.sin(angle), 1.45 + 0.15 * np.sin(3 * angle)], 1)
    target = np.stack([-0.9 * np.cos(angle + 0.5), -0.9 * np.sin(angle + 0.5), np.full(count, 0.7)], 1)
    forward = target - eye
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, 0], poses[:, :3, 1], poses[:, :3, 2], poses[:, :3, 3] = right, np.cross(forward, right), forward, eye
    return poses


@lru_cache(2000)
def picture(frame: int, tint: float = 0.0) -> np.ndarray:
    y, x = np.mgrid[0:120, 0:160] / 160.0
    red = 150 + 70 * np.sin(6 * x + frame / 15)
    green = 130 + 60 * np.cos(7 * y - frame / 21)
    blue = 120 + 80 * np.sin(4 * (x + y) + frame / 9)
    return np.clip(np.stack([red, green, blue], -1) + tint, 0, 255).astype(np.uint8)


class FakeEngine:
    """``period`` seconds a frame; ``busy`` seconds in which commands are only acknowledged (a long mapping)."""

    def __init__(self, run_folder: Path, frames: int = 120, period: float = 0.05, truth: bool = True):
        self.run_folder, self.frames, self.period, self.truth = Path(run_folder), frames, period, truth
        self.sequences = ("synthetic/studio", "synthetic/apartment", "synthetic/corridor")
        self.presets = ("full", "lite", "live", "tum")
        self.log: list[m.Command] = []
        self._inbox, self._ids, self._lock = queue.SimpleQueue(), 0, threading.Lock()
        self._feed = Feed()
        self._gt, self._mesh = walk(frames), room_mesh(0.14)
        self._sequence, self._preset = "synthetic/studio", "lite"
        self._reset()
        self._alive = True
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self):
        self._thread.start()
        return self

    def stop(self):
        self._alive = False
        if self._thread.is_alive():
            self._thread.join(5)

    def submit(self, command):
        with self._lock:
            self._ids += 1
            self._inbox.put((self._ids, command))
            return self._ids

    def latest(self):
        return self._feed.latest()

    def subscribe(self):
        subscription = self._feed.subscribe()
        self._inbox.put((0, m.RequestMesh(0.04)))
        return subscription

    # ---- the made-up run -----------------------------------------------------------------------------------------

    def _reset(self):
        self._frame, self._state, self._until, self._loops = -1, m.State.INITIALISING, None, ()
        self._meshed = -1e9

    def _run(self):
        while self._alive:
            deadline = time.monotonic() + self.period
            while (left := deadline - time.monotonic()) > 0:
                try:
                    self._obey(*self._inbox.get(timeout=left))
                except queue.Empty:
                    break
            if self._state in (m.State.INITIALISING, m.State.TRACKING, m.State.MAPPING):
                self._advance()

    def skip_to(self, frame):
        """Be paused at ``frame``, however long it takes the test to look."""
        while self._frame < frame:
            self._advance()
        self._state = m.State.PAUSED
        self.publish()
        return self

    def _advance(self):
        self._frame = min(self._frame + 1, self.frames - 1)
        i = self._frame
        self._state = m.State.MAPPING if i % 5 == 0 else m.State.TRACKING
        if i == int(0.9 * self.frames):
            before = self._estimate(i)[:, :3, 3].astype(np.float32)
            old = tuple(range(0, 25, 5))
            event = m.LoopEvent(i, old, 4.2, 1.1, 0.91, 0.37, 4.9, 0.8, 1.6, 0.3, before)
            self._loops = (*self._loops, event)
            self._feed.publish(event)
        if i >= self.frames - 1:
            self._state = m.State.FINISHED
        if self._until is not None and i >= self._until:
            self._state, self._until = m.State.PAUSED, None
        self.publish()
        if time.monotonic() - self._meshed > MESH_EVERY_S:
            self._show_mesh(0.04)

    def _estimate(self, last: int) -> np.ndarray:
        """Ground truth plus a drift that the loop closure takes away."""
        poses = self._gt[: last + 1].copy()
        drift = np.linspace(0, 0.25, self.frames)[: last + 1] * (0.25 if self._loops else 1.0)
        poses[:, 0, 3] += drift
        poses[:, 2, 3] += 0.5 * drift
        turn = 0.12 * drift + 0.002 * np.sin(np.arange(last + 1))
        spin = np.tile(np.eye(4), (last + 1, 1, 1))
        spin[:, 0, 0] = spin[:, 1, 1] = np.cos(turn)
        spin[:, 1, 0], spin[:, 0, 1] = np.sin(turn), -np.sin(turn)
        poses[:, :3, :3] = spin[:, :3, :3] @ poses[:, :3, :3]
        return poses

    def _thumbnail(self, frame: int) -> str:
        path = self.run_folder / "thumbnails" / f"{frame:06d}.jpg"
        if not path.is_file():
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(jpeg(picture(frame)[::2, ::2]))
        return str(path)

    def publish(self, snapshot=None):
        self._feed.publish(snapshot or self.snapshot())

    def snapshot(self) -> m.Snapshot:
        i = max(self._frame, 0)
        poses = self._estimate(i)
        keys = tuple(m.KeyframeView(k, poses[k], self._thumbnail(k)) for k in range(0, i + 1, 5))
        old = (0, 5, 10, 15, 20) if self._loops and i - self._loops[-1].frame < 20 else ()
        window = (*old, *(k.frame for k in keys[-5:] if k.frame not in old))
        error = 100 * np.linalg.norm(poses[:, :3, 3] - self._gt[: i + 1, :3, 3], axis=1)
        decay = float(np.exp(-i / 40))
        return m.Snapshot(
            self._state, self._sequence, self._preset, i, self.frames, poses, self._gt if self.truth else None, keys,
            window, picture(i), FOV, ASPECT,
            {"free_space": 0.1 + decay, "centre": 0.05 + 0.5 * decay, "depth": 0.2 * decay + 0.02,
             "colour": 0.3 * decay + 0.1},
            21.0 + 3 * np.sin(i), 84.0 + 9 * np.cos(i), 11.2, 14.9,
            float(np.sqrt((error**2).mean())) if self.truth else None, 512.0 + i, self._loops, 0, 0,
            reported=i,
        )  # fmt: skip

    def _obey(self, number, command):
        self.log.append(command)
        error = ""
        try:
            self._carry_out(number, command)
        except InputError as problem:
            error = str(problem)
        self._feed.publish(m.Ack(number, command, error))

    def _carry_out(self, number, command):
        match command:
            case m.Pause():
                self._state = m.State.PAUSED
                self.publish()
            case m.Resume():
                if self._state == m.State.PAUSED:
                    self._state = m.State.TRACKING
            case m.Step():
                self._state, self._until = m.State.TRACKING, None
                self._advance()
                self._state = m.State.PAUSED
                self.publish()
            case m.RunTo(frame):
                self._state, self._until = m.State.TRACKING, frame
            case m.Stop():
                self._state = m.State.FINISHED
                self.publish()
            case m.Restart(sequence, preset):
                self._sequence, self._preset = sequence or self._sequence, preset or self._preset
                self._reset()
            case m.LoadPreset(name):
                if name not in self.presets:
                    raise InputError(f"preset {name!r}: no such preset")
                self._preset = name
                self.publish()
            case m.RequestMesh(voxel):
                self._show_mesh(voxel)
            case m.RequestPictures(frame):
                at = self._frame if frame is None else frame
                flat = [picture(at + k, 10 * k) for k in range(6)]
                self._feed.publish(m.FramePictures(at, *flat))
            case m.Export(kind, form, _):
                self._feed.publish(m.Exported(kind, str(self._export(kind, form)), number))
            case _:
                pass

    def _show_mesh(self, voxel):
        self._meshed = time.monotonic()
        share = min(1.0, 0.25 + 0.75 * max(self._frame, 0) / self.frames)
        faces = self._mesh.faces[: int(len(self._mesh.faces) * share)]
        self._feed.publish(m.MeshReady(max(self._frame, 0), voxel, replace(self._mesh, faces=faces)))

    def _export(self, kind, form) -> Path:
        self.run_folder.mkdir(parents=True, exist_ok=True)
        names = {"mesh": f"mesh.{form}", "trajectory": f"trajectory_{form}.txt", "run": "run.zip"}
        path = self.run_folder / names.get(kind, f"{kind}.yaml")
        if kind == "mesh":
            import trimesh

            trimesh.Trimesh(
                self._mesh.vertices, self._mesh.faces, vertex_colors=self._mesh.colors, process=False
            ).export(path)
        elif kind == "trajectory":
            rows = self.snapshot().trajectory[:, :3, 3]
            path.write_text("".join(f"{i} {x} {y} {z} 0 0 0 1\n" for i, (x, y, z) in enumerate(rows)))
        else:
            path.write_text(f"{kind}\n")
        return path


def write_run(folder: Path, frames: int = 60, drift: float = 1.0, truth: bool = True) -> Path:
    """A finished run folder as the engine leaves it, from the made-up run."""
    import trimesh

    folder.mkdir(parents=True, exist_ok=True)
    engine = FakeEngine(folder, frames, truth=truth)
    rows, events = [], []
    for _ in range(frames):
        engine._advance()
        s = engine.snapshot()
        c2w = s.trajectory[-1].copy()
        c2w[:3, 3] += (drift - 1) * (c2w[:3, 3] - engine._gt[s.frame, :3, 3])
        rows.append(
            {"frame": s.frame, "timestamp": s.frame / 30, "c2w": c2w[:3].ravel().tolist(), "tracked": True,
             "lost": False, "keyframe": s.frame % 5 == 0, "window": list(s.window), "losses": s.losses,
             "track_ms": s.track_ms, "map_ms": s.map_ms, "ate_cm": s.ate_cm}
        )  # fmt: skip
    for e in engine._loops:
        fields = {k: v for k, v in vars(e).items() if k != "trajectory_before"}
        events.append({"type": "loop", **fields, "trajectory_before": e.trajectory_before[::4].tolist()})
    (folder / "metrics.jsonl").write_text("".join(json.dumps(r) + "\n" for r in rows))
    (folder / "events.jsonl").write_text("".join(json.dumps(e) + "\n" for e in events))
    (folder / "config.yaml").write_text("preset: lite\n")
    summary = {"sequence": "synthetic/studio", "preset": "lite", "frames": frames, "keyframes": frames // 5,
               "ate_rmse_cm": 2.0 * drift, "fps_wall": 11.0, "fps_engine": 14.0, "peak_memory_mb": 600.0,
               "loop_closures": len(events), "lost_frames": 0}  # fmt: skip
    (folder / "summary.json").write_text(json.dumps(summary))
    mesh = engine._mesh
    trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=mesh.colors, process=False).export(folder / "mesh.ply")
    if truth:
        from ecslam.evaluation.trajectory_io import format_tum

        (folder / "groundtruth.txt").write_text(format_tum(np.arange(frames) / 30, engine._gt))
    return folder
