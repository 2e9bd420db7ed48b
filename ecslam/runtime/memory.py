"""How much memory this process has, and giving back what it no longer uses."""

from __future__ import annotations

import ctypes
import resource
import sys
from pathlib import Path


def peak_memory_mb() -> float:
    """The most memory this process has had so far, in 10^6 bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6


def resident_mb() -> float:
    """Memory of this process now, in 10^6 bytes; the most it has had where the system does not tell."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 1e6
    except (OSError, IndexError, ValueError):
        return peak_memory_mb()


def give_back() -> None:
    """Return to the system what large jobs have freed, which glibc keeps otherwise. Takes milliseconds."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)
