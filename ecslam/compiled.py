"""numba's code on disk renews itself when the file of an entry function changes, not when that of a callee does."""

from __future__ import annotations

from pathlib import Path


def drop_stale(sources: Path, cache: str | Path, stem: str = "*") -> None:
    """Delete compiled functions from the folder ``cache`` that are older than the newest source they may call.

    sources: the folder of the modules whose name matches ``stem``; they call no others that are compiled.
    """
    newest = max(path.stat().st_mtime for path in sources.glob(f"{stem}.py"))
    for index in Path(cache).glob(f"{stem}.nbi"):
        if index.stat().st_mtime < newest:
            index.unlink(missing_ok=True)
