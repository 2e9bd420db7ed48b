"""Configurations from strict YAML, and back: presets, files, layouts and single settings, each laid over another.

A file in ``configs/`` holds only what differs from the defaults in ``config``. An unknown key, a wrong type or a value
out of range is an ``InputError`` that names the key and suggests the nearest one.
"""

from __future__ import annotations

import dataclasses
import math
import re
import types
import typing
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, Literal

import yaml

from .config import Config
from .strict_yaml import is_number, kind_of, nearest, parse_yaml
from .types import InputError


def config_folder() -> Path:
    """Where the presets lie: beside the package in a checkout, inside it when installed from a wheel."""
    inside = Path(__file__).parent / "configs"
    return inside if inside.is_dir() else Path(__file__).parent.parent / "configs"


def preset_names() -> list[str]:
    """Names that ``--preset`` takes."""
    return sorted(p.stem for p in config_folder().glob("*.yaml"))


def load_preset(name: str) -> Config:
    """The named preset. Raises InputError with the nearest name when there is none."""
    path = config_folder() / f"{name}.yaml"
    if not re.fullmatch(r"[\w-]+", name) or not path.is_file():
        raise InputError(
            f"preset {name!r}: no such preset{nearest(name, preset_names())}; there are: {', '.join(preset_names())}"
        )
    return apply(Config(preset=name), parse_yaml(path.read_text("utf-8"), str(path)) or {}, str(path))


def for_layout(config: Config, layout: str) -> Config:
    """The configuration with what a data-set layout asks for (``configs/layouts/LAYOUT.yaml``, if there is one)."""
    path = config_folder() / "layouts" / f"{layout}.yaml"
    return apply(config, parse_yaml(path.read_text("utf-8"), str(path)), str(path)) if path.is_file() else config


def load_config(path: Path, base: Config | None = None, layout: str = "") -> Config:
    """Read a YAML file over ``base`` (default: lite); where it names another preset over that one, with what ``layout``
    asks for. Raises InputError."""
    try:
        values = parse_yaml(path.read_text("utf-8"), str(path)) or {}
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); give --config an existing YAML file") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file; give --config a YAML file") from None
    given = base.preset if base else "lite"
    named = str(values.get("preset", given)) if isinstance(values, dict) else given
    if base is None or named != given:
        base = for_layout(load_preset(named), layout)
    return apply(base, values, str(path))


def apply_settings(config: Config, settings: list[str]) -> Config:
    """Apply ``key=value`` strings with dotted keys, e.g. ``mapping.iterations=20``. Raises InputError."""
    values: Any = {}
    for setting in settings:
        key, equals, text = setting.partition("=")
        if not equals:
            raise InputError(f"--set {setting}: write it as key=value, e.g. --set mapping.iterations=20")
        if key.strip() == "preset":
            raise InputError(f"--set {setting}: a preset is more than one setting; choose it with --preset")
        nested: Any = parse_yaml(text, f"--set {key}")
        for part in reversed(key.strip().split(".")):
            nested = {part: nested}
        values = _merged(values, nested)
    return apply(config, values, "--set")


def apply(config: Config, values: Mapping[str, Any], source: str) -> Config:
    """A copy of ``config`` with ``values`` (nested mappings) laid over it. Raises InputError."""
    result: Config = _apply(config, values, source, "")
    return result


def changes(before: Any, after: Any) -> dict[str, Any]:
    """What ``apply`` lays over ``before`` to get ``after``: nested plain dictionaries of the values that differ."""
    out: dict[str, Any] = {}
    for f in fields(before):
        was, now = getattr(before, f.name), getattr(after, f.name)
        if was != now:
            out[f.name] = changes(was, now) if is_dataclass(was) else now
    return out


def to_dict(config: Any) -> dict[str, Any]:
    """Nested plain dictionaries, ready for YAML or JSON."""
    out: dict[str, Any] = {}
    for f in fields(config):
        value = getattr(config, f.name)
        out[f.name] = to_dict(value) if is_dataclass(value) else list(value) if isinstance(value, tuple) else value
    return out


def to_yaml(config: Config) -> str:
    """The resolved configuration as YAML that ``load_config`` reads back to an equal object."""
    return yaml.safe_dump(to_dict(config), sort_keys=False)


def _merged(under: Any, over: Any) -> Any:
    """The keys of both, at all depths; where both have a value, that of ``over``."""
    if not (isinstance(under, Mapping) and isinstance(over, Mapping)):
        return over
    return {**under, **{key: _merged(under.get(key), value) for key, value in over.items()}}


def _apply(node: Any, values: Any, source: str, prefix: str) -> Any:
    if not isinstance(values, Mapping):
        raise InputError(
            f"{source}: {prefix.rstrip('.') or 'the file'} must hold keys and values, not {kind_of(values)}"
        )
    hints = typing.get_type_hints(type(node))
    by_name = {f.name: f for f in fields(node)}
    laid: dict[str, Any] = {}
    for key, value in values.items():
        path = f"{prefix}{key}"
        if key not in by_name:
            known = _all_keys(Config)
            advice = f"; write it as {_nested(path)}" if path in known else nearest(path, known)
            raise InputError(f"{source}: unknown key {path!r}{advice}")
        current = getattr(node, key)
        if is_dataclass(current):
            laid[key] = _apply(current, value, source, f"{path}.")
        else:
            laid[key] = _convert(value, hints[key], by_name[key].metadata, source, path)
    try:
        return dataclasses.replace(node, **laid)
    except InputError as error:
        raise InputError(f"{source}: {error}") from None


def _convert(value: Any, hint: Any, limits: Mapping[str, Any], source: str, path: str) -> Any:
    origin = typing.get_origin(hint)
    if origin in (types.UnionType, typing.Union):
        if value is None:
            return None
        hint = next(a for a in typing.get_args(hint) if a is not type(None))
        origin = typing.get_origin(hint)
    if origin is Literal:
        options = typing.get_args(hint)
        if value not in options:
            raise InputError(f"{source}: {path} must be one of {', '.join(map(str, options))}, not {value!r}")
        return value
    if origin is tuple:
        if not isinstance(value, (list, tuple)) or not all(is_number(v) for v in value):
            raise InputError(f"{source}: {path} must be a list of numbers, not {kind_of(value)} {value!r}")
        return tuple(float(v) for v in value)
    wanted = {int: "a whole number", float: "a number", bool: "true or false", str: "text"}[hint]
    ok = {
        int: isinstance(value, int) and not isinstance(value, bool),
        float: is_number(value),
        bool: isinstance(value, bool),
        str: isinstance(value, str),
    }[hint]
    if not ok:
        raise InputError(f"{source}: {path} must be {wanted}, not {kind_of(value)} {value!r}")
    low, high = limits.get("low", -math.inf), limits.get("high", math.inf)
    if hint in (int, float) and not low <= value <= high:
        raise InputError(f"{source}: {path} = {value} is out of range; it must lie in {low:g} .. {high:g}")
    return float(value) if hint is float else value


def _all_keys(node: type, prefix: str = "") -> list[str]:
    keys: list[str] = []
    hints = typing.get_type_hints(node)
    for f in fields(node):
        keys.append(prefix + f.name)
        if is_dataclass(hints[f.name]):
            keys += _all_keys(hints[f.name], f"{prefix}{f.name}.")
    return keys


def _nested(path: str) -> str:
    """How YAML writes a dotted key that stands for a group and a key of it."""
    group, _, key = path.partition(".")
    return f"{group}: {{{_nested(key)}}}" if key else f"{group}: ..."
