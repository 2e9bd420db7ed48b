"""From a path or an address to a sequence. Layouts are the modules of this folder that have ``sniff`` and ``open``.

A new layout is one new file: its docstring's first line says, after the name and a colon, what the folder must hold.
Where a single file can be a sequence, ``SUFFIXES`` are those of such files; ``sniff`` and ``open`` take its path, too.
"""

from __future__ import annotations

import importlib
import os
import pkgutil
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, Protocol, cast
from urllib.parse import parse_qsl

from ..types import InputError, Sequence
from .views import with_readout

SYNTHETIC = "synthetic/"
READOUT, MOST_READOUT_S = "readout", 0.1
ARCHIVES = (".zip", ".tar", ".gz", ".tgz", ".bz2", ".xz", ".7z", ".rar")
MOST_TRIED = 100


class Layout(Protocol):
    """A module of this folder that knows one way of laying a sequence out on disk. ``OPTIONS``, if it has any: what may
    follow a ``?`` after the path beside ``READOUT``, which ``open`` takes by these names."""

    __name__: str
    __doc__: str | None

    def sniff(self, path: Path) -> bool:
        """Whether ``path``, mostly a folder, is laid out this way, from file names only."""

    def open(self, path: Path, **options: str) -> Sequence:
        """Open it. Raises InputError when something is wrong with it."""


@cache
def layouts() -> tuple[Layout, ...]:
    """All layouts, in alphabetical order of their modules."""
    package = importlib.import_module(__name__.rpartition(".")[0])
    names = sorted(info.name for info in pkgutil.iter_modules(package.__path__) if not info.ispkg)
    modules = [importlib.import_module(f"{package.__name__}.{name}") for name in names]
    return tuple(cast(Layout, m) for m in modules if hasattr(m, "sniff") and hasattr(m, "open"))


def summary(layout: Layout) -> str:
    """One line on what such a sequence is made of."""
    return (layout.__doc__ or layout.__name__).strip().splitlines()[0].rstrip(".")


def open_sequence(path_or_address: str | Path, **synthetic_options: Any) -> Sequence:
    """Open a folder or file of any known layout, or a built-in room such as ``synthetic/studio``.

    ``?readout=SECONDS`` after a path says how long its camera takes from the first row of depth to the last.
    ``synthetic_options`` go to the built-in rooms (image size, number of frames ...). Raises InputError, in one line,
    when there is no such folder, it is laid out in no known way, or its parts do not belong together.
    """
    address = str(path_or_address)
    if address.startswith(SYNTHETIC):
        from .synthetic import open_synthetic

        return cast(Sequence, open_synthetic(address.removeprefix(SYNTHETIC), **synthetic_options))
    if synthetic_options:
        raise InputError(
            f"{address}: {', '.join(synthetic_options)} can be set for {SYNTHETIC}... only, not for a folder"
        )
    try:
        path, options = split_address(address)
        return _open_path(_resolve(path), options)
    except OSError as error:
        raise InputError(f"{address}: cannot be opened ({error.strerror}); give a readable folder") from None


def split_address(address: str) -> tuple[str, dict[str, str]]:
    """The path of a recording, and the options that follow it after ``?``."""
    path, mark, query = address.rpartition("?")
    if not mark or os.path.exists(address):
        return address, {}
    return path, dict(parse_qsl(query, keep_blank_values=True))


def _resolve(address: str) -> Path:
    try:
        return Path(address).expanduser().resolve()
    except (ValueError, RuntimeError) as error:  # a null character; ~nobody; a loop of links
        raise InputError(f"{address!r}: not a path ({error}); give the folder of a sequence") from None


def _open_path(path: Path, options: dict[str, str]) -> Sequence:
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(
            f"{path}: no such folder or file; give the folder of a sequence, or {SYNTHETIC}studio for a built-in room"
        ) from None
    layout = _recognise(path)
    if layout is None:
        raise InputError(_why_unknown(path))
    taken = getattr(layout, "OPTIONS", ())
    wrong = next((name for name in options if name not in (READOUT, *taken)), None)
    if wrong is not None:
        raise InputError(f"{path}: takes no option {wrong!r}; {', '.join((READOUT, *taken))} can follow the path")
    given = options.pop(READOUT, None)
    sequence = layout.open(path, **options)
    return sequence if given is None else with_readout(sequence, _read_readout(path, given))


def _read_readout(path: Path, given: str) -> float:
    """Seconds from the first row of a depth image to its last. Raises InputError."""
    try:
        seconds = float(given)
    except ValueError:
        seconds = -1.0
    if not 0 <= seconds <= MOST_READOUT_S:
        raise InputError(
            f"{path}: {READOUT}={given}: write the seconds from a depth image's first row to its last, 0 to "
            f"{MOST_READOUT_S:g}; 0 where the camera sees all of it at once"
        )
    return seconds


def _why_unknown(path: Path) -> str:
    above = _layout_of(path.parent)
    around = f"{path}: not a sequence itself; did you mean {path.parent}?" if above and not suffixes_of(above) else ""
    if not path.is_dir():
        if path.name.lower().endswith(ARCHIVES):
            return f"{path}: packed; unpack it and give the folder that holds the sequence"
        kinds = ", ".join(sorted(suffixes()))
        return around or f"{path}: a file, and not one of {kinds}; give the folder that holds the sequence"
    names = sorted(p.name for p in path.iterdir())
    if not names:
        return f"{path}: an empty folder; give a folder that holds a sequence"
    inside = next((p for p in _within(path) if looks_like_one(p)), None)
    if inside is not None:
        return f"{path}: not a sequence itself; did you mean {inside}?"
    if around:
        return around
    packed = next((name for name in names if name.lower().endswith(ARCHIVES)), None)
    if packed is not None:
        return f"{path}: no sequence, but {packed}; unpack that"
    found = ", ".join(names[:4]) + (" ..." if len(names) > 4 else "")
    known = "; ".join(summary(layout) for layout in layouts())
    return f"{path}: no known layout (it holds {found}); rearrange it as one of these: {known}"


def _within(path: Path) -> Iterator[Path]:
    """What lies in a folder, then what lies in its folders, as far as that can be read; the first hundred of each."""
    inside = sorted(path.iterdir())[:MOST_TRIED]
    yield from inside
    for each in inside:
        if each.is_dir() and os.access(each, os.R_OK | os.X_OK):
            yield from sorted(each.iterdir())[:MOST_TRIED]


def suffixes() -> frozenset[str]:
    """Of files that may be sequences."""
    return frozenset(suffix for layout in layouts() for suffix in suffixes_of(layout))


def suffixes_of(layout: Layout) -> tuple[str, ...]:
    """Of files that may be sequences of this layout; mostly none."""
    return cast("tuple[str, ...]", getattr(layout, "SUFFIXES", ()))


def looks_like_one(path: Path) -> bool:
    """Whether ``path`` seems to be a sequence, by file names alone; not where those cannot be read."""
    return _layout_of(path) is not None


def _layout_of(path: Path) -> Layout | None:
    try:
        return _recognise(path)
    except OSError:
        return None


def _recognise(path: Path) -> Layout | None:
    folder, suffix = path.is_dir(), path.suffix.lower()
    return next((each for each in layouts() if (folder or suffix in suffixes_of(each)) and each.sniff(path)), None)
