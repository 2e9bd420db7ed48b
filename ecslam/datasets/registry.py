"""From a path or an address to a sequence. Layouts are the modules of this folder that have ``sniff`` and ``open``.

A new layout is one new file: its docstring's first line says, after the name and a colon, what the folder must hold.
Where a single file can be a sequence, ``SUFFIXES`` are those of such files; ``sniff`` and ``open`` take its path, too.
"""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache
from pathlib import Path
from typing import Any, Protocol, cast

from ..types import InputError, Sequence

SYNTHETIC = "synthetic/"


class Layout(Protocol):
    """A module of this folder that knows one way of laying a sequence out on disk."""

    __name__: str
    __doc__: str | None

    def sniff(self, path: Path) -> bool:
        """Whether ``path``, mostly a folder, is laid out this way, from file names only."""

    def open(self, path: Path) -> Sequence:
        """Open it. Raises InputError when something is wrong with it."""


@cache
def layouts() -> tuple[Layout, ...]:
    """All layouts, in alphabetical order of their modules."""
    package = importlib.import_module(__name__.rpartition(".")[0])
    names = sorted(info.name for info in pkgutil.iter_modules(package.__path__) if not info.ispkg)
    modules = [importlib.import_module(f"{package.__name__}.{name}") for name in names]
    return tuple(cast(Layout, m) for m in modules if hasattr(m, "sniff") and hasattr(m, "open"))


def summary(layout: Layout) -> str:
    """One line on what a folder of this layout holds."""
    return (layout.__doc__ or layout.__name__).strip().splitlines()[0].rstrip(".")


def open_sequence(path_or_address: str | Path, **synthetic_options: Any) -> Sequence:
    """Open a folder of any known layout, or a built-in room such as ``synthetic/studio``.

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
        return _open_path(_resolve(address))
    except OSError as error:
        raise InputError(f"{address}: cannot be opened ({error.strerror}); give a readable folder") from None


def _resolve(address: str) -> Path:
    try:
        return Path(address).expanduser().resolve()
    except (ValueError, RuntimeError) as error:  # a null character; ~nobody; a loop of links
        raise InputError(f"{address!r}: not a path ({error}); give the folder of a sequence") from None


def _open_path(folder: Path) -> Sequence:
    if not folder.exists():
        raise InputError(
            f"{folder}: no such folder or file; give the folder of a sequence, or {SYNTHETIC}studio for a built-in room"
        )
    layout = _recognise(folder)
    if layout is not None:
        return layout.open(folder)
    if not folder.is_dir():
        known = ", ".join(sorted(suffixes()))
        raise InputError(f"{folder}: a file, and not one of {known}; give the folder that holds the sequence")
    names = sorted(p.name for p in folder.iterdir())
    if not names:
        raise InputError(f"{folder}: an empty folder; give a folder that holds a sequence")
    inside = next((p for p in sorted(folder.iterdir())[:100] if looks_like_one(p)), None)
    if inside is not None:
        raise InputError(f"{folder}: not a sequence itself; did you mean {inside}?")
    found = ", ".join(names[:4]) + (" ..." if len(names) > 4 else "")
    known = "; ".join(summary(layout) for layout in layouts())
    raise InputError(f"{folder}: no known layout (it holds {found}); rearrange it as one of these: {known}")


def looks_like_one(path: Path) -> bool:
    """Whether a sequence seems to lie in the folder, or to be the file, by names alone; not where those cannot be
    read."""
    try:
        return _recognise(path) is not None
    except OSError:
        return False


def suffixes() -> frozenset[str]:
    """Of files that may be sequences, in lower case."""
    return frozenset(suffix for layout in layouts() for suffix in getattr(layout, "SUFFIXES", ()))


def _recognise(path: Path) -> Layout | None:
    if not path.is_dir() and path.suffix.lower() not in suffixes():
        return None
    return next((layout for layout in layouts() if layout.sniff(path)), None)
