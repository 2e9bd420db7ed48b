"""From a path or an address to a sequence. Layouts are the modules of this folder that have ``sniff`` and ``open``.

A new layout is one new file: its docstring's first line says, after the name and a colon, what the folder must hold.
Where a single file can be a sequence, ``SUFFIXES`` are those of such files; ``sniff`` and ``open`` take its path, too.
"""

from __future__ import annotations

import importlib
import os
import pkgutil
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any, Protocol, cast

from ..types import InputError, Sequence
from .addresses import CALIBRATION, CAMERA, COMMON, NONE, READOUT, SYNTHETIC, absolute, split_address
from .calibration import FILE, calibrated_by
from .views import with_readout

MOST_READOUT_S = 0.1
ARCHIVES = (".zip", ".tar", ".gz", ".tgz", ".bz2", ".xz", ".7z", ".rar")
MOST_TRIED = 100


class Layout(Protocol):
    """A module of this folder that knows one way of laying a sequence out on disk. ``OPTIONS``, if it has any: what may
    follow a ``?`` after the path beside ``COMMON``, which ``open`` takes by these names."""

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
    ``?calibration=FILE`` names what the camera is really like (see ``calibration``), after the name of a room, too; a
    path without it takes ``calibration_place``, where there is such a file, and none with ``?calibration=none``.
    ``synthetic_options`` go to the built-in rooms (image size, number of frames ...). Raises InputError, in one line,
    when there is no such folder, it is laid out in no known way, or its parts do not belong together.
    """
    address = str(path_or_address)
    if address.startswith(SYNTHETIC):
        from .synthetic import open_synthetic

        room = open_synthetic(address.removeprefix(SYNTHETIC), **synthetic_options)
        given = room.address.calibration
        return _as_told(cast(Sequence, room), address, {} if given is None else {CALIBRATION: given})
    if address.startswith(CAMERA):
        raise InputError(f"{address}: a camera can be run and recorded only; open what has been recorded")
    if synthetic_options:
        raise InputError(
            f"{address}: {', '.join(synthetic_options)} can be set for {SYNTHETIC}... only, not for a folder"
        )
    try:
        path, options = split_address(address)
        return _open_path(absolute(path), options)
    except OSError as error:
        raise InputError(f"{address}: cannot be opened ({error.strerror}); give a readable folder") from None


def calibration_place(address: str) -> Path:
    """The calibration that a recording has by itself, whether it exists or not: in its folder, or beside its file.

    Raises InputError for a built-in room.
    """
    path = split_address(address)[0]
    if path.startswith(SYNTHETIC):
        raise InputError(f"{path}: a built-in room has no folder for a calibration; name a file with --out")
    return _place_beside(absolute(path))


def _place_beside(path: Path) -> Path:
    return path.with_name(f"{path.name}.{FILE}") if path.is_file() else path / FILE


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
    wrong = next((name for name in options if name not in (*COMMON, *taken)), None)
    if wrong is not None:
        raise InputError(f"{path}: takes no option {wrong!r}; {', '.join((*COMMON, *taken))} can follow the path")
    sequence = layout.open(path, **{name: value for name, value in options.items() if name not in COMMON})
    beside = _place_beside(path)
    return _as_told(sequence, path, ({CALIBRATION: str(beside)} if beside.exists() else {}) | options)


def _as_told(sequence: Sequence, place: Path | str, options: Mapping[str, str]) -> Sequence:
    """The sequence at ``place`` with what those of ``options`` that are ``COMMON`` say of its camera. Raises
    InputError."""
    calibration, readout = options.get(CALIBRATION, NONE), options.get(READOUT)
    if not calibration:
        raise InputError(f"{place}: {CALIBRATION}=: name a file, or {NONE} to leave out the one that lies there")
    if calibration != NONE:
        sequence = calibrated_by(sequence, absolute(calibration))
    return sequence if readout is None else with_readout(sequence, _read_readout(place, readout))


def _read_readout(path: Path | str, given: str) -> float:
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
