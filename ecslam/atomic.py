"""Files that are replaced whole: whatever happens, a reader finds the old bytes or the new ones."""

from __future__ import annotations

import os
import threading
from pathlib import Path

from .types import InputError

TEMPORARY = ".tmp"


def write_atomic(path: Path, data: bytes) -> None:
    """Replace ``path`` by ``data``: whenever a crash comes, it holds either the old or the new bytes.

    Raises OSError, with no temporary file left behind.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}-{threading.get_ident()}{TEMPORARY}")
    try:
        with open(temporary, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def write_named(path: Path, data: bytes) -> None:
    """``write_atomic`` for a file that somebody has named. Raises InputError when it cannot be written."""
    try:
        write_atomic(path, data)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); make room, or name another place") from None


def sync_folder(folder: Path) -> None:
    """Make renames in ``folder`` survive a power cut, where the system can do that."""
    if os.name == "posix":
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def remove_temporaries(folder: Path) -> None:
    """Delete what interrupted ``write_atomic`` calls left in ``folder``."""
    for path in folder.glob(f".*{TEMPORARY}"):
        path.unlink(missing_ok=True)
