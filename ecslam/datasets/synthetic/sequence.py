"""The built-in rooms as sequences: frames are rendered when they are asked for."""

from __future__ import annotations

import importlib
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from ...types import Frame, Intrinsics, Mesh
from ..addresses import SYNTHETIC
from .address import Address, check, parse_address
from .lighting import bake
from .mesh import reference_mesh
from .noise import kinect
from .path import closed_path
from .render import render
from .rooms import Room
from .scene import Scene, pack
from .store import kept
from .visitor import standing, with_visitor

RATE_HZ = 30.0
FOCAL = 0.8
MARGIN_M = 0.05
STRIPS = 24
SWING_FRAMES = 50  # from one brightest image to the next
PATH_SEED = 1

_baking = threading.Lock()


@cache
def room(name: str) -> Room:
    """The room of that name, from the module of that name."""
    built: Room = importlib.import_module(f".{name}", __package__).build()
    return built


@cache
def _lit_scene(name: str) -> Scene:
    built = room(name)
    return kept(name, lambda: bake(pack(built.shapes), built.lights, built.interior))


def lit_scene(name: str) -> Scene:
    """The room with textures and light, ready to render; made once, in a second or a few, and kept on disk."""
    with _baking:
        return _lit_scene(name)


def open_synthetic(
    name: str,
    width: int = 640,
    height: int = 480,
    frames: int | None = None,
    noise: bool = False,
    seed: int = 0,
    readout: float = 0.0,
    visitor: bool = False,
    exposure: float = 0.0,
) -> SyntheticSequence:
    """Open a built-in room, one of ``ROOMS``, also as an address with options (see address).

    The camera's path is closed: ``frames`` beyond one round (the default) go round again. ``noise`` imitates a Kinect;
    ``seed`` changes that noise and nothing else; ``readout``, ``visitor``, ``exposure``: see ``Address``. Raises
    InputError for an unknown room or values out of range.
    """
    defaults = check(Address("studio", width, height, frames, noise, seed, readout, visitor, exposure))
    return SyntheticSequence(parse_address(name, defaults))


@dataclass(eq=False)
class SyntheticSequence:
    """A ``Sequence`` whose frames are rendered exactly: depth, pose and mesh are the truth itself."""

    address: Address

    def __post_init__(self) -> None:
        a = self.address
        self.name: str = SYNTHETIC + a.room
        self.layout: str = "synthetic"
        self.preset: str = "lite"
        focal, centre = FOCAL * a.width, ((a.width - 1) / 2, (a.height - 1) / 2)
        self.intrinsics: Intrinsics = Intrinsics(focal, focal, *centre, a.width, a.height, readout_s=a.readout)
        self.bounds: NDArray[np.float64] | None = room(a.room).interior + np.array([[-MARGIN_M], [MARGIN_M]])

    def __len__(self) -> int:
        return self.address.frames or room(self.address.room).frames

    def __iter__(self) -> Iterator[Frame]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, index: int) -> Frame:
        """Render frame ``index``. Raises IndexError outside 0 .. len - 1."""
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        c2w = self._round[index % len(self._round)]
        color, depth = self._look(index) if self.address.readout else self._seen(self.intrinsics, c2w)
        feet = standing(index, self._round, room(self.address.room).interior[0, 2]) if self.address.visitor else None
        if feet is not None:
            color, depth = with_visitor(color, depth, self.intrinsics, c2w, feet)
        if self.address.exposure:
            gain = 1 + self.address.exposure * np.sin(2 * np.pi * index / SWING_FRAMES)
            color = np.rint(np.minimum(color * np.float32(gain), 255)).astype(np.uint8)
        if self.address.noise:
            color, depth = kinect(color, depth, self.intrinsics, np.random.default_rng([self.address.seed, index]))
        return Frame(index, index / RATE_HZ, color, depth, c2w.copy())

    def _seen(self, camera: Intrinsics, c2w: NDArray[np.float64]) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        return render(lit_scene(self.address.room), camera, c2w)

    def _look(self, index: int) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """An image whose strips are seen one after the other from where the camera is by then."""
        camera, strips = self.intrinsics, []
        edges = np.linspace(0, camera.height, STRIPS + 1).astype(int)
        for top, bottom in pairwise(edges):
            strip = replace(camera, cy=camera.cy - top, height=bottom - top)
            late = ((top + bottom) / 2 / camera.height - 0.5) * camera.readout_s * RATE_HZ
            strips.append(self._seen(strip, self._pose_at(index + late)))
        color, depth = zip(*strips, strict=True)
        return np.concatenate(color), np.concatenate(depth)

    def _pose_at(self, moment: float) -> NDArray[np.float64]:
        """[4, 4] between two frames."""
        first = int(np.floor(moment))
        before, after = self._round[np.array([first, first + 1]) % len(self._round)]
        motion, share = np.linalg.inv(before) @ after, moment - first
        motion[:3, :3] = cv2.Rodrigues(share * cv2.Rodrigues(motion[:3, :3])[0])[0]
        motion[:3, 3] *= share
        return before @ motion

    def timestamps(self) -> NDArray[np.float64]:
        """[N] seconds, 30 Hz."""
        return np.arange(len(self)) / RATE_HZ

    def poses_gt(self) -> NDArray[np.float64]:
        """[N, 4, 4] camera-to-world, exact."""
        return self._round[np.arange(len(self)) % len(self._round)]

    def reference_mesh(self) -> Mesh:
        """The exact surface with colours."""
        built = room(self.address.room)
        return reference_mesh(built.shapes, lit_scene(self.address.room), built.interior)

    @cached_property
    def _round(self) -> NDArray[np.float64]:
        built = room(self.address.room)
        return closed_path(built.path, built.frames, PATH_SEED)
