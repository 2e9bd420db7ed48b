"""Addresses of sequences: a path or the name of a built-in room, and options after ``?``."""

from __future__ import annotations

import os
from pathlib import Path
from urllib.parse import parse_qsl, quote, urlencode

from ..types import InputError

SYNTHETIC, CAMERA = "synthetic/", "camera/"
ROOMS = ("studio", "apartment", "corridor", "gallery")
BUILT_IN = tuple(SYNTHETIC + room for room in ROOMS)
READOUT, CALIBRATION, NONE = "readout", "calibration", "none"
COMMON = (READOUT, CALIBRATION)  # what any recording takes


def split_address(address: str) -> tuple[str, dict[str, str]]:
    """The path of a recording, or the name of a room, and the options that follow it after ``?``."""
    path, mark, query = address.rpartition("?")
    if not mark or os.path.exists(address):
        return address, {}
    return path, dict(parse_options(query))


def parse_options(query: str) -> list[tuple[str, str]]:
    """Names and values; a ``+`` is one, as file names have it."""
    return parse_qsl(query.replace("+", "%2B"), keep_blank_values=True)


def absolute(path: str) -> Path:
    """A path that holds in any folder. Raises InputError for what is none."""
    try:
        return Path(path).expanduser().resolve()
    except (ValueError, RuntimeError) as error:  # a null character; ~nobody; a loop of links
        raise InputError(f"{path!r}: not a path ({error}); give the folder of a sequence, or a file") from None


def lasting_address(address: str) -> str:
    """The address of a sequence as it can be opened from any folder, with any file that it names. Raises InputError."""
    path, options = split_address(address)
    if not path.startswith(SYNTHETIC):
        path = str(absolute(path))
    if options.get(CALIBRATION, NONE) != NONE:
        options[CALIBRATION] = str(absolute(options[CALIBRATION]))
    return _joined(path, options)


def calibrated_address(address: str, file: Path) -> str:
    """The address of the same sequence with the calibration in ``file``, and its other options."""
    path, options = split_address(address)
    return _joined(path, options | {CALIBRATION: str(file)})


def named_calibration_only(address: str) -> str:
    """The address of the same sequence without the calibration that it has by itself."""
    path, options = split_address(address)
    return _joined(path, {CALIBRATION: NONE} | options)


def _joined(path: str, options: dict[str, str]) -> str:
    return f"{path}?{urlencode(options, safe='/', quote_via=quote)}" if options else path
