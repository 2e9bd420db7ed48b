"""What made a result: the software, what it stands on, and the machine."""

from __future__ import annotations

import platform
import subprocess
from importlib.metadata import version
from pathlib import Path

from . import __version__
from .cores import cores


def software() -> str:
    """The version of this software and, in a clone, the commit and whether files were changed since."""
    clone = Path(__file__).parents[1]
    if not (clone / ".git").exists():
        return __version__
    describe = ["git", "-C", str(clone), "describe", "--always", "--dirty"]
    try:  # a run that is asked to end waits for this
        told = subprocess.run(describe, capture_output=True, text=True, timeout=1)
    except (OSError, subprocess.TimeoutExpired):
        return __version__
    return f"{__version__} ({told.stdout.strip()})" if told.returncode == 0 else __version__


def machine(device: str) -> str:
    """The GPU, or the processor and how many of its cores this process may use."""
    if not device.startswith("cuda"):
        return f"{_processor()}, {cores()} cores"
    import torch

    try:
        return str(torch.cuda.get_device_name(device))
    except (RuntimeError, AssertionError):  # what a GPU that has broken down leaves is written all the same
        return device


def provenance(device: str) -> dict[str, str]:
    """Names and versions, to stand beside the figures of what ran on ``device``."""
    return {
        "ecslam": software(),
        "python": platform.python_version(),
        "torch": version("torch"),
        "numba": version("numba"),
        "system": platform.platform(),
        "machine": machine(device),
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8", "replace").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
