"""CUDA graphs without CUDA: what is recorded, and what must not be."""

import torch
from torch.utils._python_dispatch import TorchDispatchMode

WAITS = ("_local_scalar_dense", "nonzero", "masked_select", "unique", "item", "equal")
PRODUCTS = ("mm", "bmm", "addmm", "baddbmm")


class FakeGraphs:
    """Stands in for CUDA: recording runs nothing, replaying runs the recorded function on the recorded inputs."""

    def __init__(self):
        self.recorded = self.replayed = 0

    def capture(self, function, device):
        self.recorded += 1
        outputs = []

        def replay():
            self.replayed += 1
            outputs[:] = function()

        return replay, outputs


class Forbidding(TorchDispatchMode):
    """Raises when an operation would wait for the device, take another number of values each time, or move between
    devices: what no CUDA graph can record. Nor does it let cuBLAS multiply, which keeps its workspace in the memory of
    the graph that first asks and may refuse more than 65,535 products at a time."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        name = func.overloadpacket.__name__
        if name in WAITS or (name.startswith("index") and any(_is_mask(t) for t in _tensors(args[1:2]))):
            raise AssertionError(f"{func} waits for the device")
        if name in PRODUCTS:
            raise AssertionError(f"{func} leaves the work to cuBLAS")
        found = func(*args, **kwargs)
        devices = {t.device.type for t in (*_tensors(args), *_tensors((found,))) if t.dim() > 0}
        if len(devices) > 1:
            raise AssertionError(f"{func} moves between {devices}")
        return found


def _tensors(values):
    for value in values:
        if isinstance(value, torch.Tensor):
            yield value
        elif isinstance(value, (list, tuple)):
            yield from _tensors(value)


def _is_mask(tensor):
    return tensor.dtype in (torch.bool, torch.uint8)


class Unlaunched:
    """A Triton kernel that is not run."""

    def __getitem__(self, grid):
        return lambda *args, **kwargs: None


def launch_nothing(monkeypatch, module):
    """From here on the kernels that a module launches are not run."""
    for name in [name for name in vars(module) if name.endswith("_kernel")]:
        monkeypatch.setattr(module, name, Unlaunched())
