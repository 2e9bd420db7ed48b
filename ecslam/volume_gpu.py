"""The fused TSDF volume on a GPU: frames are averaged in and poses aligned there, without waiting for the host."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .descent import COARSE_STRIDE, RULES, Alignment
from .kernels import AlignSettings, NormalEquations, fusion_gpu
from .kernels.fusion import EDGE
from .kernels.graphs import Recorder
from .pixels import Points
from .pixels_gpu import DeviceFrame
from .sending import Letter
from .shutter import STILL, Sweep
from .types import Frame, Intrinsics
from .volume import STRIDE

SLOTS = 1 << 16
MOST_TAKEN = 0.5
LEAST_POINTS = 2048
COPIED = 4096  # blocks at a time
NUMBERS = 26  # see ``fusion_gpu.View``


class GpuVolume:
    """See ``FusedVolume``; the same on a GPU, up to rounding. blocks: the table, which the kernels read."""

    def __init__(
        self, voxel_m: float, truncation_m: float, device: torch.device, recorder: Recorder | None = None
    ) -> None:
        """recorder: of the alignments; used by no other thread."""
        self.voxel_m, self.truncation_m, self._device = voxel_m, truncation_m, device
        self._record = recorder or Recorder()
        self._now = 0
        self._shown: tuple[Frame, DeviceFrame] | None = None
        self._letter = Letter(NUMBERS, device)
        self._taken = torch.zeros(2, dtype=torch.int32, pin_memory=device.type == "cuda")
        self._allocate(SLOTS)

    def _allocate(self, slots: int) -> None:
        self.blocks, self._listed = fusion_gpu.allocate(slots, self.voxel_m, self.truncation_m, self._device)
        self._record.forget()

    @property
    def used(self) -> int:
        """How many blocks there are. Waits for the device."""
        return int(self._listed.counts[1])

    def integrate(
        self,
        frame: Frame,
        camera: Intrinsics,
        c2w: NDArray[np.float64],
        near_m: float,
        far_m: float,
        sweep: Sweep = STILL,
    ) -> None:
        """See ``FusedVolume.integrate``. A block that finds no place in the table is left to a later frame."""
        self._grow_in_time()
        self._now += 1
        lens = camera.fx, camera.fy, camera.cx, camera.cy
        letter = self._letter.send(c2w[:3], lens, (near_m, far_m, self._now), sweep, frame.gain)
        steps = int(np.ceil(2 * self.truncation_m / (0.5 * EDGE * self.voxel_m))) + 1
        blocks, listed, shown = self.blocks, self._listed, self.show(frame)

        def whole() -> tuple[Tensor]:
            fusion_gpu.fuse(blocks, listed, shown.depth, shown.color, letter, STRIDE, steps)
            return (listed.counts,)

        self._record(whole, key=steps, over=(blocks, shown), device=self._device, lent=True)
        self._taken.copy_(listed.counts, non_blocking=True)

    def show(self, frame: Frame) -> DeviceFrame:
        """The frame's images on the device, until the next one's, which take their place."""
        before, place = self._shown or (None, None)
        if before is not frame:
            self._shown = frame, DeviceFrame.of(frame, self._device, place)
        assert self._shown is not None
        return self._shown[1]

    def _upload(self, tensor: Tensor) -> Tensor:
        return tensor.to(self._device, non_blocking=True)

    def _grow_in_time(self) -> None:
        """Double a table that was over half full when the device last told; nothing waits for the newest number."""
        if int(self._taken[1]) > MOST_TAKEN * self.blocks.slots:
            keys, voxels, rows = self.blocks.keys, self.blocks.voxels, fusion_gpu.taken_slots(self.blocks)
            self._load(keys[rows], voxels, rows, 2 * self.blocks.slots)

    def _load(self, keys: Tensor, voxels: Tensor, rows: Tensor, slots: int) -> None:
        """Start again with blocks ``keys`` [N], whose voxels are the ``rows`` [N] of ``voxels``."""
        self._allocate(slots)
        found = fusion_gpu.enter(self.blocks, self._listed, keys)
        while bool((found < 0).any()):
            self._allocate(2 * self.blocks.slots)
            found = fusion_gpu.enter(self.blocks, self._listed, keys)
        for part, into in zip(rows.split(COPIED), found.split(COPIED), strict=True):
            self.blocks.voxels[into] = voxels[part].to(self._device)
        self._taken.copy_(self._listed.counts)

    def state(self) -> dict[str, NDArray[Any]]:
        """See ``FusedVolume.state``; blocks come in the order of the table."""
        rows = fusion_gpu.taken_slots(self.blocks)
        return {"place": self.blocks.keys[rows].cpu().numpy(), "voxels": self.blocks.voxels[rows].cpu().numpy()}

    def load(self, state: dict[str, NDArray[Any]]) -> None:
        """Go on from what ``state`` gave, here or in a ``FusedVolume``."""
        keys, voxels = torch.tensor(state["place"]), torch.tensor(state["voxels"])
        slots = max(SLOTS, 1 << int(len(keys) / MOST_TAKEN).bit_length())
        self._load(keys.to(self._device), voxels, torch.arange(len(keys)), slots)

    def distances(self, points: NDArray[np.floating]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """See ``FusedVolume.distances``; 0 where nothing is known."""
        at = self._upload(torch.from_numpy(np.ascontiguousarray(points, np.float64)))
        found = fusion_gpu.distances(self.blocks, at, torch.eye(4, dtype=at.dtype, device=at.device)).cpu().numpy()
        known = ~np.isnan(found)
        return np.where(known, found, np.float32(0)), known

    def normal_equations(self, c2w: NDArray[np.float64], points: Points, settings: AlignSettings) -> NormalEquations:
        """See ``FusedVolume.normal_equations``."""
        packed, start = self._packed(points), self._start(c2w, points)
        sums = fusion_gpu.sums_at(self.blocks, packed, start, settings).cpu()
        products, (cost, used, inliers) = sums[:64].view(8, 8), sums[64:].tolist()
        return NormalEquations(products[:6, :6].clone(), products[:6, 6].clone(), cost, int(used), int(inliers))

    def descend(
        self, points: Points, guess: NDArray[np.float64], settings: Sequence[AlignSettings], iterations: int
    ) -> Alignment:
        """See ``descent.descend``: one launch of a recorded graph, and one wait, for its result."""
        blocks, stages = self.blocks, tuple(settings)

        def whole(packed: Tensor, start: Tensor) -> tuple[Tensor]:
            return (fusion_gpu.descend(blocks, packed, start, stages, iterations, COARSE_STRIDE, RULES),)

        packed, start = self._packed(points), self._start(guess, points)
        (row,) = self._record(whole, packed, start, key=(stages, iterations), over=(blocks,))
        c2w, cost = fusion_gpu.unpack_pose(row.cpu())
        return Alignment(c2w.numpy(), float(cost) / max(len(points.local), 1))

    def _packed(self, points: Points) -> Tensor:
        """Points and luminance [N, 4], padded to one of few sizes."""
        count = len(points.local)
        packed = torch.zeros(max(LEAST_POINTS, 1 << max(count - 1, 0).bit_length()), 4)
        packed[:count, :3], packed[:count, 3] = points.local, points.light
        return self._upload(packed)

    def _start(self, c2w: NDArray[np.float64], points: Points) -> Tensor:
        return self._upload(fusion_gpu.pack_start(torch.from_numpy(c2w), len(points.local)))
