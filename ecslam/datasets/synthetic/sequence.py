"""The built-in rooms as sequences: frames are rendered when they are asked for."""

from __future__ import annotations

import importlib
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray

from ...types import Frame, Intrinsics, Mesh
from .address import PREFIX, Address, check, parse_address
from .lighting import bake
from .mesh import reference_mesh
from .noise import kinect
from .path import closed_path
from .render import render
from .rooms import Room
from .scene import Scene, pack
from .store import kept

RATE_HZ = 30.0
FOCAL = 0.8
MARGIN_M = 0.05
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
    name: str, width: int = 640, height: int = 480, frames: int | None = None, noise: bool = False, seed: int = 0
) -> SyntheticSequence:
    """Open a built-in room: ``studio``, ``apartment`` or ``corridor``, also as an address with options (see address).

    The camera's path is closed: ``frames`` beyond one round (the default) go round again. ``noise`` imitates a Kinect;
    ``seed`` changes that noise and nothing else. Raises InputError for an unknown room or values out of range.
    """
    defaults = check(Address("studio", width, height, frames, noise, seed))
    return SyntheticSequence(parse_address(name, defaults))


@dataclass(eq=False)
class SyntheticSequence:
    """A ``Sequence`` whose frames are rendered exactly: depth, pose and mesh are the truth itself."""

    address: Address

    def __post_init__(self) -> None:
        a = self.address
        self.name: str = PREFIX + a.room
        self.layout: str = "synthetic"
        self.preset: str = "lite"
        focal = FOCAL * a.width
        self.intrinsics: Intrinsics = Intrinsics(focal, focal, (a.width - 1) / 2, (a.height - 1) / 2, a.width, a.height)
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
        color, depth = render(lit_scene(self.address.room), self.intrinsics, c2w)
        if self.address.noise:
            color, depth = kinect(color, depth, self.intrinsics, np.random.default_rng([self.address.seed, index]))
        return Frame(index, index / RATE_HZ, color, depth, c2w.copy())

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
