"""The sequences below a folder, for a dashboard to choose from."""

from __future__ import annotations

import os
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

from ..types import InputError
from .registry import looks_like_one, suffixes

DEEPEST, MOST_PLACES = 3, 2000


def sequences_under(root: Path) -> tuple[str, ...]:
    """Addresses of the sequences that are ``root`` itself or lie up to ``DEEPEST`` levels below it, in order.

    Recognised by file names alone, so one that is damaged is among them. Raises InputError when there is no such
    folder, or nothing in it that is recognised.
    """
    place = root.expanduser().resolve()
    if not place.exists():
        raise InputError(f"--data {root}: no such folder; give one that holds sequences")
    found = tuple(str(each) for each in islice(_places(place, DEEPEST), MOST_PLACES) if looks_like_one(each))
    if not found:
        raise InputError(f"--data {root}: no sequence in it; `ecslam check FOLDER` says what is wrong with one")
    return found


def _places(path: Path, deeper: int) -> Iterator[Path]:
    """``path``, and the folders and files below it that may be a sequence; nothing lies inside one."""
    yield path
    if deeper == 0 or looks_like_one(path):
        return
    files = suffixes()
    try:
        inside = sorted(
            entry.path
            for entry in os.scandir(path)
            if entry.name[0] != "." and (entry.is_dir() or Path(entry.name).suffix.lower() in files)
        )
    except OSError:
        return
    for each in inside:
        yield from _places(Path(each), deeper - 1)
