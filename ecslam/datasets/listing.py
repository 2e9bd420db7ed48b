"""Lists that begin each line with a time: of images, or of poses."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..types import InputError
from .reading import read_text

DECIMAL_COMMA = re.compile(r"(?<!\S)-?\d+,\d+(?!\S)")


def read_rows(path: Path, columns: int, may_break_off: bool = False) -> list[list[str]]:
    """The first ``columns`` fields of each line that is no comment. may_break_off: whether a last line without its end
    is left out, as where a recorder was killed. Raises InputError."""
    rows, lines = [], read_text(path).splitlines(keepends=True)
    if may_break_off and lines and not lines[-1].endswith("\n"):
        lines.pop()
    for number, line in enumerate(lines, 1):
        written = line.split("#")[0]
        fields = written.replace(",", " ").split()
        if fields and len(fields) < columns:
            raise InputError(f"{path}: line {number} has {len(fields)} of {columns} fields; complete or remove it")
        if len(written.split()) >= columns and DECIMAL_COMMA.search(written):
            raise InputError(f"{path}: line {number} has decimal commas; write decimal points")
        if fields:
            rows.append(fields[:columns])
    if not rows:
        raise InputError(f"{path}: lists nothing; it needs lines of {columns} fields, the first a time in seconds")
    return rows


def to_numbers(rows: list[list[str]], path: Path) -> NDArray[np.float64]:
    """[N, M] of the rows of ``path``. Raises InputError."""
    try:
        return np.array(rows, np.float64)
    except ValueError as error:
        raise InputError(f"{path}: {error}, where a number is due; correct that line, or begin it with #") from None


def to_times(fields: list[str], path: Path) -> NDArray[np.float64]:
    """[N] seconds, all finite. Raises InputError."""
    times = to_numbers([[field] for field in fields], path)[:, 0]
    if not np.isfinite(times).all():
        raise InputError(f"{path}: a time is not finite; correct or remove that line")
    return times


def listed_file(folder: Path, name: str) -> Path:
    """The file that a list in ``folder`` names, perhaps as Windows writes it."""
    return folder / name.replace("\\", "/")
