"""Checkpoints: safetensors for arrays, JSON for the rest, sha256 over both, two generations; never pickle.

Arrays lie in files that are named by their digest, so none is ever overwritten. ``NNNNNN.json``, written last, names
the files of a generation and so commits it; what the newest two generations do not name is removed after that. A kill
at any moment leaves at least one whole generation. Arrays under ``LASTING`` never change once they are there: only
those that no file holds yet are written, so a checkpoint costs what has changed, not what has been gathered so far.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy
from numpy.typing import NDArray
from safetensors import SafetensorError

from ..atomic import write_atomic
from ..types import InputError
from .files import to_json

VERSION = 8
GENERATIONS = 2
MAX_MANIFEST_BYTES = 16 << 20
LASTING = "keyframes."

Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Checkpoint:
    """frame: frames of the sequence done so far. arrays: what ``Slam.state`` gave. meta: plain JSON values."""

    frame: int
    arrays: Arrays
    meta: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Stored:
    """The lasting arrays that the newest generation holds, and the digests of their files, oldest first."""

    arrays: Arrays = field(default_factory=dict)
    files: tuple[str, ...] = ()


def save_checkpoint(folder: Path, checkpoint: Checkpoint, stored: Stored | None = None) -> Stored:
    """Write a generation and remove those older than the newest two. Raises OSError; earlier generations then stay.

    stored: what the call before returned, None for everything anew. The result is for the next call.
    """
    folder.mkdir(exist_ok=True)
    stored = stored or Stored()
    lasting = {name: value for name, value in checkpoint.arrays.items() if name.startswith(LASTING)}
    fresh = {name: value for name, value in lasting.items() if stored.arrays.get(name) is not value}
    rest = {name: value for name, value in checkpoint.arrays.items() if name not in lasting}
    files = (*stored.files, _write(folder, fresh)) if fresh else stored.files
    body = {
        "version": VERSION,
        "frame": checkpoint.frame,
        "files": [*files, _write(folder, rest)],
        "meta": checkpoint.meta,
    }
    text = to_json(body)
    manifest = {"sha256": hashlib.sha256(text.encode()).hexdigest(), "body": text}
    write_atomic(folder / f"{checkpoint.frame:06d}.json", to_json(manifest).encode())
    _clean(folder)
    return Stored(lasting, files)


def load_checkpoint(folder: Path) -> Checkpoint:
    """The newest generation in a run's folder of checkpoints that is whole. Raises InputError when there is none."""
    if not folder.parent.is_dir():
        raise InputError(f"{folder.parent}: no such folder; give the folder of a run")
    problems = []
    for path in _generations(folder):
        try:
            return _load(path)
        except (OSError, ValueError, KeyError, TypeError, SafetensorError) as error:
            problems.append(f"{path.name}: {' '.join(str(error).split()) or type(error).__name__}")
    found = "; ".join(problems) or "there is none"
    raise InputError(f"{folder}: no usable checkpoint ({found}); start the run again with ecslam run")


def newest_frame(folder: Path) -> int:
    """How many frames the newest generation in a run's folder of checkpoints holds, by its name; 0 without any."""
    return int(next((path.stem for path in _generations(folder)), "0"))


def _write(folder: Path, arrays: Arrays) -> str:
    """Save arrays in a file of their own; its digest."""
    data = safetensors.numpy.save({name: np.require(value, requirements="C") for name, value in arrays.items()})
    digest = hashlib.sha256(data).hexdigest()
    write_atomic(_file(folder, digest), data)
    return digest


def _file(folder: Path, digest: str) -> Path:
    return folder / f"{digest[:16]}.safetensors"


def _load(path: Path) -> Checkpoint:
    body = _read_body(path)
    if body["version"] != VERSION:
        raise ValueError(f"written by another version of ecslam (format {body['version']}, this one reads {VERSION})")
    arrays: Arrays = {}
    for digest in body["files"]:
        data = _file(path.parent, digest).read_bytes()
        if hashlib.sha256(data).hexdigest() != digest:
            raise ValueError("the arrays do not match their checksum")
        arrays |= safetensors.numpy.load(data)
    return Checkpoint(body["frame"], arrays, body["meta"])


def _read_body(path: Path) -> dict[str, Any]:
    if path.stat().st_size > MAX_MANIFEST_BYTES:
        raise ValueError("the manifest is too large")
    manifest = json.loads(path.read_text("utf-8"))
    if hashlib.sha256(manifest["body"].encode()).hexdigest() != manifest["sha256"]:
        raise ValueError("the manifest does not match its checksum")
    body: dict[str, Any] = json.loads(manifest["body"])
    return body


def _generations(folder: Path) -> list[Path]:
    """Manifests, newest first."""
    return sorted((p for p in folder.glob("*.json") if p.stem.isdecimal()), key=lambda p: int(p.stem), reverse=True)


def _clean(folder: Path) -> None:
    """Remove generations older than the newest two, and the arrays that none of these names."""
    for old in _generations(folder)[GENERATIONS:]:
        old.unlink(missing_ok=True)
    named: set[Path] = set()
    for path in _generations(folder):
        try:
            named.update(_file(folder, digest) for digest in _read_body(path)["files"])
        except (OSError, ValueError, KeyError, TypeError):
            continue  # damaged, so nothing can be loaded by it
    for file in folder.glob("*.safetensors"):
        if file not in named:
            file.unlink(missing_ok=True)
