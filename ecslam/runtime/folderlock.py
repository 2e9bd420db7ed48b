"""One process at a time writes a run folder: two would leave neither's run whole."""

from __future__ import annotations

import os
from pathlib import Path
from typing import IO

from ..types import InputError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

NAME = ".lock"


def claim(folder: Path) -> IO[str] | None:
    """Hold ``folder`` until what is returned is closed, or the process ends in whatever way.

    None where the system has no locks, and where this process holds it already. Raises InputError when another process
    does.
    """
    if fcntl is None:
        return None
    lock = (folder / NAME).open("a+")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        lock.seek(0)
        owner = lock.read().strip()
        lock.close()
        if not isinstance(error, BlockingIOError) or owner == str(os.getpid()):
            return None
        raise InputError(
            f"{folder}: a run is at work there (process {owner}); stop it, or begin another with ecslam run --out"
        ) from None
    lock.truncate(0)
    lock.write(str(os.getpid()))
    lock.flush()
    return lock
