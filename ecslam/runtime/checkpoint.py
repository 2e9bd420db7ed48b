"""Checkpoints: safetensors for arrays, JSON for the rest, sha256 over both, two generations; never pickle.

``NNNNNN.safetensors`` is written first, then ``NNNNNN.json``, which names its digest and so commits it; generations
older than the newest two are removed last. A kill at any moment leaves at least one whole generation.
"""

from __future__ import annotations

import hashlib
import json
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy
from numpy.typing import NDArray
from safetensors import SafetensorError

from ..types import InputError
from .files import remove_temporaries, to_json, write_atomic

VERSION = 1
GENERATIONS = 2
MAX_MANIFEST_BYTES = 16 << 20


@dataclass(frozen=True)
class Checkpoint:
    """frame: frames of the sequence done so far. arrays: what ``Slam.state`` gave. meta: plain JSON values."""

    frame: int
    arrays: dict[str, NDArray[Any]]
    meta: dict[str, Any] = field(default_factory=dict)


def save_checkpoint(folder: Path, checkpoint: Checkpoint) -> None:
    """Write a generation and remove those older than the newest two. Raises OSError; earlier generations then stay."""
    folder.mkdir(exist_ok=True)
    stem = folder / f"{checkpoint.frame:06d}"
    arrays = {name: np.require(value, requirements="C") for name, value in checkpoint.arrays.items()}
    data = safetensors.numpy.save(arrays)
    body = {
        "version": VERSION,
        "frame": checkpoint.frame,
        "arrays_sha256": hashlib.sha256(data).hexdigest(),
        "meta": checkpoint.meta,
    }
    text = to_json(body)
    manifest = {"sha256": hashlib.sha256(text.encode()).hexdigest(), "body": text}
    write_atomic(stem.with_suffix(".safetensors"), data)
    write_atomic(stem.with_suffix(".json"), to_json(manifest).encode())
    for old in _generations(folder)[GENERATIONS:]:
        old.unlink(missing_ok=True)
    keep = {path.stem for path in _generations(folder)}
    for path in folder.glob("*.safetensors"):
        if path.stem not in keep:
            path.unlink(missing_ok=True)


def load_checkpoint(folder: Path) -> Checkpoint:
    """The newest generation that is whole. Raises InputError when there is none."""
    problems = []
    for path in _generations(folder):
        try:
            return _load(path)
        except (OSError, ValueError, KeyError, TypeError, SafetensorError) as error:
            problems.append(f"{path.name}: {' '.join(str(error).split()) or type(error).__name__}")
    found = "; ".join(problems) or "there is none"
    raise InputError(f"{folder}: no usable checkpoint ({found}); start the run again with ecslam run")


def _load(path: Path) -> Checkpoint:
    if path.stat().st_size > MAX_MANIFEST_BYTES:
        raise ValueError("the manifest is too large")
    manifest = json.loads(path.read_text("utf-8"))
    if hashlib.sha256(manifest["body"].encode()).hexdigest() != manifest["sha256"]:
        raise ValueError("the manifest does not match its checksum")
    body = json.loads(manifest["body"])
    if body["version"] != VERSION:
        raise ValueError(f"written by another version of ecslam (format {body['version']}, this one reads {VERSION})")
    data = path.with_suffix(".safetensors").read_bytes()
    if hashlib.sha256(data).hexdigest() != body["arrays_sha256"]:
        raise ValueError("the arrays do not match their checksum")
    return Checkpoint(body["frame"], safetensors.numpy.load(data), body["meta"])


def _generations(folder: Path) -> list[Path]:
    """Manifests, newest first."""
    return sorted(folder.glob("[0-9]*.json"), reverse=True)


class CheckpointWriter:
    """Writes checkpoints in a thread of its own, at most one at a time, ``every`` so many frames.

    A slow disk does not hold the run up before 2 ``every`` frames hang on the checkpoint being written, which is what a
    kill costs at most. failed: called in the writer's thread with the OSError of a checkpoint that could not be saved;
    saved: with none.
    """

    def __init__(
        self, folder: Path, every: int, failed: Callable[[OSError], None], saved: Callable[[], None], frame: int = 0
    ) -> None:
        self._folder, self._every, self._failed, self._saved = folder, every, failed, saved
        self._thread: threading.Thread | None = None
        self._begun = self._settled = frame
        if folder.is_dir():
            remove_temporaries(folder)

    def due(self, frame: int) -> bool:
        """Whether the state after ``frame`` frames is to be saved; always after the first one, the most expensive."""
        busy = self._thread is not None and self._thread.is_alive()
        late = frame - self._settled >= 2 * self._every
        return self._begun == 0 or (frame - self._begun >= self._every and (late or not busy))

    def save(self, checkpoint: Checkpoint) -> None:
        """Start writing, after the one before is done. The arrays must not be written to afterwards."""
        self.wait()
        self._begun = checkpoint.frame
        self._thread = threading.Thread(target=self._write, args=(checkpoint,), name="checkpoint", daemon=True)
        self._thread.start()

    def wait(self) -> None:
        """Return when everything is on the disk, or reported as failed."""
        if self._thread is not None:
            self._thread.join()

    def _write(self, checkpoint: Checkpoint) -> None:
        try:
            save_checkpoint(self._folder, checkpoint)
        except OSError as error:
            self._failed(error)
        else:
            self._saved()
        self._settled = checkpoint.frame
