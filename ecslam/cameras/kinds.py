"""From an address such as ``camera/realsense?fps=15`` to a camera. A new kind is one new file that has ``OPTIONS`` and
``open``."""

from __future__ import annotations

import importlib
import pkgutil
from datetime import datetime
from functools import cache
from typing import Protocol, cast

from ..datasets import split_address
from ..datasets.addresses import CAMERA
from ..types import InputError
from .camera import Camera


class Kind(Protocol):
    """A module of this folder that knows one kind of camera. ``OPTIONS``: what may follow a ``?`` after its name."""

    __name__: str
    OPTIONS: tuple[str, ...]

    def open(self, **options: str) -> Camera:
        """Switch it on. Raises InputError, in one line, where there is none or it cannot do what is asked."""


@cache
def kinds() -> dict[str, Kind]:
    """All kinds by name."""
    package = importlib.import_module(__name__.rpartition(".")[0])
    names = sorted(info.name for info in pkgutil.iter_modules(package.__path__))
    modules = {name: importlib.import_module(f"{package.__name__}.{name}") for name in names}
    return {name: cast(Kind, m) for name, m in modules.items() if hasattr(m, "OPTIONS") and hasattr(m, "open")}


def is_camera(address: str) -> bool:
    """Whether the address is that of a camera."""
    return address.startswith(CAMERA)


def recording_name(address: str, now: datetime) -> str:
    """What a folder for what the camera records may be called."""
    return f"{_kind(address)[0]}-{now:%Y%m%d-%H%M%S}"


def open_camera(address: str) -> Camera:
    """Switch on the camera at ``address``. Raises InputError, in one line."""
    name, options = _kind(address)
    kind = kinds()[name]
    wrong = next((each for each in options if each not in kind.OPTIONS), None)
    if wrong is not None:
        raise InputError(f"{address}: takes no option {wrong!r}; {', '.join(kind.OPTIONS)} can follow its name")
    return kind.open(**options)


def _kind(address: str) -> tuple[str, dict[str, str]]:
    """The name of its kind, and options. Raises InputError."""
    path, options = split_address(address)
    name = path.removeprefix(CAMERA)
    if name not in kinds():
        known = ", ".join(CAMERA + each for each in kinds())
        raise InputError(f"{address}: no such camera; there are: {known}")
    return name, options
