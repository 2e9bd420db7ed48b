"""How much memory this process has, and giving back what it has freed."""

from __future__ import annotations

import ctypes
import mmap
import sys
from pathlib import Path

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8
LARGE, HOLES = 4 << 20, 64 << 20


def peak_memory_mb() -> float:
    """The most memory this process has had so far, in 10^6 bytes; NaN where the system does not tell."""
    if resource is None:
        return float("nan")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6


def resident_mb() -> float:
    """Memory of this process now, in 10^6 bytes; the most it has had where the system does not tell."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * mmap.PAGESIZE / 1e6
    except (OSError, IndexError, ValueError):
        return peak_memory_mb()


def keep_no_holes() -> None:
    """From now on give every freed block of ``LARGE`` bytes or more back to the system at once, keep smaller ones for
    whatever comes next until ``return_holes``, and let threads that start later share one heap, where each reuses what
    another has freed.

    Left alone, glibc raises the first limit to 32 MB, and meshes and checkpoints leave 100 MB of holes in a run of the
    studio; but it gives back whatever comes free at the end of its heap. Images of up to a million pixels, which come
    and go there, are below the limit: to have memory cleared anew for each took a third of the time that reading large
    ones takes. Concerns the whole process; does nothing on other systems.
    """
    _glibc("mallopt", M_MMAP_THRESHOLD, LARGE)
    _glibc("mallopt", M_TRIM_THRESHOLD, HOLES)
    _glibc("mallopt", M_ARENA_MAX, 1)


def return_holes() -> None:
    """Give what has been freed between smaller blocks back to the system, in one to three milliseconds."""
    _glibc("malloc_trim", 0)


def _glibc(name: str, *numbers: int) -> None:
    function = getattr(ctypes.CDLL(None), name, None) if sys.platform == "linux" else None
    if function is not None:
        function(*numbers)
