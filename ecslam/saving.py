"""The whole engine as plain arrays and back, for checkpoints. Names are flat, e.g. ``mapper.field.table``."""

from __future__ import annotations

import json
from dataclasses import fields
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from .field import TsdfField
from .kernels import FieldParams, GridLayout
from .keyframes import Keyframe

Arrays = dict[str, NDArray[Any]]


def prefixed(prefix: str, arrays: Arrays) -> Arrays:
    """The same arrays under ``prefix.name``."""
    return {f"{prefix}.{name}": value for name, value in arrays.items()}


def part(prefix: str, arrays: Arrays) -> Arrays:
    """The inverse of ``prefixed``: what stands under ``prefix.``."""
    return {name[len(prefix) + 1 :]: value for name, value in arrays.items() if name.startswith(prefix + ".")}


def pack_field(field: TsdfField) -> Arrays:
    """Copies of the learnt numbers and the layout."""
    out: Arrays = {f.name: getattr(field.params, f.name).cpu().numpy().copy() for f in fields(FieldParams)}
    for f in fields(GridLayout):
        out[f"layout_{f.name}"] = np.asarray(getattr(field.layout, f.name))
    out["table_size"] = np.array(field.table_size)
    return out


def unpack_field(arrays: Arrays, device: torch.device) -> TsdfField:
    """The inverse of ``pack_field``."""
    params = FieldParams(*(torch.from_numpy(arrays[f.name].copy()).to(device) for f in fields(FieldParams)))
    parts = {f.name: arrays[f"layout_{f.name}"] for f in fields(GridLayout)}
    bins = int(parts.pop("bins"))
    layout = GridLayout(**{k: torch.from_numpy(v.copy()) for k, v in parts.items()}, bins=bins)
    return TsdfField(layout, params, int(arrays["table_size"]))


def pack_keyframes(keyframes: list[Keyframe]) -> Arrays:
    """The record of each keyframe under its frame, not copied: it never changes."""
    return {str(k.frame): k.record for k in keyframes}


def unpack_keyframes(arrays: Arrays) -> list[Keyframe]:
    """The inverse of ``pack_keyframes``, in the order of frames."""
    return [Keyframe(frame, arrays[str(frame)]) for frame in sorted(map(int, arrays))]


def pack_random(rng: np.random.Generator, generator: torch.Generator) -> Arrays:
    """Both random states, so that a resumed run draws what the interrupted one would have."""
    text = json.dumps(rng.bit_generator.state).encode()
    return {"numpy": np.frombuffer(text, np.uint8).copy(), "torch": generator.get_state().numpy().copy()}


def unpack_random(arrays: Arrays, rng: np.random.Generator, generator: torch.Generator) -> None:
    """Set both random states."""
    rng.bit_generator.state = json.loads(arrays["numpy"].tobytes())
    generator.set_state(torch.from_numpy(arrays["torch"].copy()))
