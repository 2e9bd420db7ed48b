"""numba's code on disk: it needs a place, and renews itself only when the file of an entry function changes, not when
that of a callee does."""

from __future__ import annotations

import os
from pathlib import Path


def find_place(sources: Path) -> None:
    """Give numba a folder for this process alone where it could write neither beside ``sources`` nor in the person's
    cache, and would refuse to work. Call it before numba is imported."""
    caches = Path(os.path.expanduser(os.environ.get("XDG_CACHE_HOME") or "~/.cache"))
    if "NUMBA_CACHE_DIR" in os.environ or _takes_files(sources / "__pycache__") or _takes_files(caches / "numba"):
        return
    import atexit  # rarely wanted, and this is the first that a command imports
    import shutil
    import tempfile
    import warnings

    place = os.environ["NUMBA_CACHE_DIR"] = tempfile.mkdtemp(prefix="ecslam-")
    atexit.register(shutil.rmtree, place, ignore_errors=True)
    warnings.warn(
        f"kernels are compiled anew each time, for neither {sources} nor {caches} can be written; name a folder for "
        "them in NUMBA_CACHE_DIR",
        stacklevel=2,
    )


def _takes_files(folder: Path) -> bool:
    """Whether ``folder`` can be written, or made."""
    there = next((str(each) for each in (folder, *folder.parents) if os.path.exists(each)), "")
    return folder.is_absolute() and os.access(there, os.W_OK | os.X_OK)


def drop_stale(sources: Path, cache: str | Path, stem: str = "*") -> None:
    """Delete compiled functions from the folder ``cache`` that are older than the newest source they may call.

    sources: the folder of the modules whose name matches ``stem``; they call no others that are compiled.
    """
    newest = max(path.stat().st_mtime for path in sources.glob(f"{stem}.py"))
    for index in Path(cache).glob(f"{stem}.nbi"):
        if index.stat().st_mtime < newest:
            index.unlink(missing_ok=True)
