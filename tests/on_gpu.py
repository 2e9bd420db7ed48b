"""The GPU kernels for tensors on the CPU: they go to a GPU and come back, or stay where Triton's interpreter runs."""

import os
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from typing import Any

import torch

from ecslam.kernels import FieldParams, GridLayout

INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
DEVICE = torch.device("cpu" if INTERPRETED else "cuda")


def moved(value: Any, device: torch.device) -> Any:
    """A tensor, or a dataclass of tensors, on that device; a layout stays on the CPU."""
    if isinstance(value, torch.Tensor):
        return value.to(device)
    if is_dataclass(value) and not isinstance(value, GridLayout):
        return type(value)(*(moved(getattr(value, f.name), device) for f in fields(value)))
    return tuple(moved(v, device) for v in value) if isinstance(value, tuple) else value


def run(function: Callable[..., Any], *args: Any) -> Any:
    """``function`` of the back end with its arguments on the device; what it writes into parameters comes back too."""
    there = [moved(value, DEVICE) for value in args]
    found = function(*there)
    for given, mine in zip(args, there, strict=True):
        if isinstance(given, FieldParams):
            for f in fields(FieldParams):
                getattr(given, f.name).copy_(getattr(mine, f.name))
    return moved(found, torch.device("cpu"))
