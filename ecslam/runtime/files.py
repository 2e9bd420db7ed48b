"""Files that survive a full disk and a kill at any moment: room for them, and logs of one JSON object a line."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from ..atomic import write_atomic
from ..types import InputError


def require_space(folder: Path, needed_mb: float) -> None:
    """Create ``folder`` and make sure that it takes files and has space. Raises InputError when not."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_atomic(folder / "probe", b"writable")
        (folder / "probe").unlink()
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError(
            f"{folder}: cannot write there ({reason}); begin one elsewhere with ecslam run --out"
        ) from None
    free_mb = shutil.disk_usage(folder).free / 1e6
    if free_mb < needed_mb:
        raise InputError(
            f"{folder}: {free_mb:.0f} MB free, but a run may need {needed_mb:.0f} MB; make room, or begin one "
            "elsewhere with ecslam run --out"
        )


def require_place(file: Path, option: str) -> None:
    """Make sure that ``file``, which ``option`` named, can be written. Raises InputError when not."""
    if not file.parent.is_dir():
        raise InputError(f"{option} {file}: there is no folder {file.parent}; make it first")
    if file.is_dir():
        raise InputError(f"{option} {file}: a folder; give the name of a file")
    if not os.access(file.parent, os.W_OK | os.X_OK):
        raise InputError(f"{option} {file}: cannot write in {file.parent}; give a file elsewhere")


def beside(folder: Path) -> Path:
    """A folder that does not exist yet: ``runs/a`` -> ``runs/a-2`` -> ``runs/a-3``."""
    stem, dash, number = folder.name.rpartition("-")
    base = stem if dash and number.isdigit() else folder.name
    count = 2
    while (candidate := folder.with_name(f"{base}-{count}")).exists():
        count += 1
    return candidate


def to_json(value: Any) -> str:
    """One line of JSON; numpy numbers and arrays become plain ones, NaN becomes null (JSON has no NaN)."""
    try:
        return _dumps(value)
    except ValueError:
        return _dumps(_without_nan(value))


def _listed(value: Any) -> Any:
    """A numpy number or array as a plain one. Raises TypeError for anything else."""
    if not hasattr(value, "tolist"):
        raise TypeError(f"{type(value).__name__} cannot be written as JSON")
    return value.tolist()


_dumps = json.JSONEncoder(separators=(",", ":"), allow_nan=False, default=_listed).encode


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _without_nan(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_without_nan(v) for v in value]
    if hasattr(value, "tolist"):
        return _without_nan(value.tolist())
    return None if isinstance(value, float) and value - value != 0 else value


class LineLog:
    """An append-only file with one JSON object a line. A line is written whole or not at all, also on a full disk."""

    def __init__(self, path: Path) -> None:
        self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)

    def append(self, value: dict[str, Any]) -> None:
        """Add one line. Raises OSError when it could not be written; the file is then as it was before."""
        line = (to_json(value) + "\n").encode()
        size = os.fstat(self._descriptor).st_size
        try:
            if os.write(self._descriptor, line) != len(line):
                raise OSError(28, "No space left on device")
        except OSError:
            os.ftruncate(self._descriptor, size)
            raise

    def close(self) -> None:
        """Flush to the disk and close."""
        try:
            os.fsync(self._descriptor)
        finally:
            os.close(self._descriptor)


def read_lines(path: Path) -> Iterator[dict[str, Any]]:
    """The objects of a ``LineLog``; a torn last line (killed while writing) is left out. A missing file is empty."""
    if not path.is_file():
        return
    with open(path, encoding="utf-8", errors="replace") as file:
        for line in file:
            try:
                value = json.loads(line)
            except ValueError:
                continue
            if isinstance(value, dict):
                yield value


def keep_lines(path: Path, keep: Callable[[dict[str, Any]], bool]) -> None:
    """Drop the lines of a ``LineLog`` for which ``keep`` is False."""
    if path.is_file():
        kept = [to_json(value) + "\n" for value in read_lines(path) if keep(value)]
        write_atomic(path, "".join(kept).encode())
