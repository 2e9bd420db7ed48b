"""Compiles every GPU kernel for one compute capability, without a GPU: ``python gpu_compiled.py 90 [variants]``.

Run by ``test_kernels_gpu_compile.py`` in a process of its own. Every launch of the host code becomes a compilation of
what it would have launched, so arguments are specialised as they are on a GPU. Prints a line of JSON for each kernel.
"""

import io
import json
import re
import sys
from contextlib import redirect_stdout
from types import SimpleNamespace

import torch
import triton
from kernel_cases import ALIGN, WEIGHTS, blank, make_field, make_points, make_rays
from triton.backends.compiler import GPUTarget
from triton.runtime.jit import JITFunction

from ecslam.config import FieldConfig
from ecslam.field_adam import FieldAdam

torch.cuda.is_available, available = lambda: True, torch.cuda.is_available
from ecslam.kernels import PoseMoments, Rules, fusion_gpu, gpu, tracking_gpu  # noqa: E402

torch.cuda.is_available = available
LAUNCH = JITFunction.run
SPILLED = re.compile(r"(\d+) bytes stack frame, (\d+) bytes spill stores, (\d+) bytes spill loads")


def compile_only(self, *args, **kwargs):
    """What a launch does here: compile, and report what ptxas says."""
    said = io.StringIO()
    with redirect_stdout(said):
        kernel = LAUNCH(self, *args, **kwargs | {"warmup": True})
    log = said.getvalue()
    if not log:
        return
    stack, stores, loads = (sum(found) for found in zip(*(map(int, m) for m in SPILLED.findall(log)), strict=True))
    report = {
        "kernel": self.fn.__name__,
        "cubin": len(kernel.asm["cubin"]),
        "registers": max(map(int, re.findall(r"Used (\d+) registers", log))),
        "stack": stack,
        "spilled": stores + loads,
    }
    print(json.dumps(report), flush=True)


def launch_the_map(variants):
    """Every kernel that ``gpu`` launches, as mapping does; with ``variants`` also as tracking and queries do. Those
    that take another number of points every time are compiled once."""
    field, (c2w, rays) = make_field(FieldConfig()), make_rays(64, 64)
    layout, params = field.layout, field.params
    for points in (make_points(count) for count in (100, 96, 1)):
        gpu.gradients(layout, params, points)
        gpu.normal_equations(layout, params, c2w[0], points, points[:, 0].contiguous(), ALIGN)
    gpu.render(layout, params, c2w, rays)
    of_table, of_others = FieldAdam(list(vars(params).values())).steps(torch.tensor(1e-2), 1e-2)
    gpu.step(layout, params, c2w, rays, WEIGHTS, blank(params), True, of_table)
    gpu.map_step(*[[params.w_in, params.w_sdf, params.w_rgb, params.beta]] * 2, of_others)
    poses = torch.eye(4).double().repeat(30, 1, 1)
    mean, square, rates = (torch.zeros(30, 6).double() for _ in range(3))
    moments = PoseMoments(mean, square, torch.zeros(30, 3).double(), (0.5, 0.9), 1e-8)
    gpu.pose_step(poses, torch.zeros(30, 3, 4), moments, rates, 1)
    gpu.importance_depths(torch.zeros(64, 32), torch.zeros(64, 32), torch.zeros(64, 11))
    if variants:
        gpu.importance_depths(torch.zeros(64, 96), torch.zeros(64, 96), torch.zeros(64, 21))
        gpu.values(layout, params, points)
        gpu.step(layout, params, c2w, rays, WEIGHTS, None, True)


def launch_the_volume():
    """Everything that ``fusion_gpu`` and ``tracking_gpu`` launch."""
    blocks, listed = fusion_gpu.allocate(1 << 12, 0.02, 0.06, torch.device("cpu"))
    start, points = fusion_gpu.pack_start(torch.eye(4), 2000), torch.zeros(2048, 4)
    depth, color, numbers = torch.zeros(480, 640), torch.zeros(480, 640, 3, dtype=torch.uint8), torch.zeros(26).double()
    fusion_gpu.enter(blocks, listed, torch.zeros(7, dtype=torch.int64))
    fusion_gpu.fuse(blocks, listed, depth, color, numbers, 4, 3)
    fusion_gpu.distances(blocks, torch.zeros(7, 3).double(), torch.eye(4).double())
    fusion_gpu.descend(blocks, points, start, (ALIGN, ALIGN), 2, 4, Rules(1e-4, 1e-8, 1e4, 1e-4, 0, 0, 6))
    cells, lens = tracking_gpu.Cells(640, 20, 64, 439, 599, 9.1, 9.3), tracking_gpu.Lens(500, 500, 320, 240, 0.1, 8.0)
    pose, luminance = torch.eye(4).double(), (1e-3, 2e-3, 3e-4)
    spread = tracking_gpu.spread(color, depth, torch.zeros(3000, 2), cells, lens, luminance, torch.ones(1).double())
    _, row = tracking_gpu.packed(blocks, spread, pose, 100)
    tracking_gpu.told(blocks, spread, pose, row, 0.03, 0.1)
    marks = tracking_gpu.Marks(torch.zeros(1 << 12, dtype=torch.uint8), 1 << 12, 20.0)
    for order in (torch.zeros(3000, dtype=torch.int64), None):
        given = torch.zeros(1000, 3), torch.zeros(200, dtype=torch.int64), order, cells, lens, marks, pose, 100
        tracking_gpu.chosen(color, depth, *given)


if __name__ == "__main__":
    target = GPUTarget("cuda", int(sys.argv[1]), 32)
    device = SimpleNamespace(
        get_current_device=lambda: 0, get_current_stream=lambda device: 0, get_current_target=lambda: target
    )
    triton.runtime.driver.set_active(device)
    triton.knobs.nvidia.dump_ptxas_log = True
    JITFunction.run = compile_only
    launch_the_volume()
    launch_the_map(variants="variants" in sys.argv)
