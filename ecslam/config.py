"""Typed configuration: frozen dataclasses with the paper's lite figures as defaults, and strict loading from YAML.

A file in ``configs/`` holds only what differs. An unknown key, a wrong type or a value out of range is an
``InputError`` that names the key and suggests the nearest one.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import re
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any, Literal

import yaml

from .types import InputError

MAX_CONFIG_BYTES = 64 * 1024


def _number(default: Any, low: float = -math.inf, high: float = math.inf) -> Any:
    """A field that must lie in [low, high]."""
    return field(default=default, metadata={"low": low, "high": high})


@dataclass(frozen=True)
class FieldConfig:
    """The map: multi-resolution hash grid, one-blob encoding, two decoders (paper, section III-A)."""

    levels: int = _number(16, 1, 32)
    log2_table_size: int = _number(16, 8, 24)
    base_resolution: int = _number(16, 2, 512)
    finest_voxel_m: float = _number(0.02, 1e-3, 1.0)
    blob_bins: int = _number(16, 4, 64)
    beta: float = _number(10.0, 0.1, 1e3)
    init_scale: float = _number(1e-4, 0.0, 1.0)
    box: tuple[float, ...] | None = None
    box_margin_m: float = _number(0.3, 0.0, 10.0)

    def __post_init__(self) -> None:
        """Raises InputError for a box that is none."""
        box = self.box
        if box is not None and (len(box) != 6 or any(box[axis] >= box[axis + 3] for axis in range(3))):
            raise InputError(
                f"field.box = {list(box)} takes six numbers: x_min, y_min, z_min, x_max, y_max, z_max (metres), each "
                "minimum below its maximum"
            )


@dataclass(frozen=True)
class SamplingConfig:
    """Depths along a ray: ``uniform`` over it and ``near_depth`` within ``depth_range_m`` of the measured depth.
    without_depth: whether mapping takes rays that have no measured depth."""

    uniform: int = _number(32, 0, 512)
    near_depth: int = _number(11, 1, 512)
    depth_range_m: float = _number(0.10, 1e-3, 1.0)
    near_m: float = _number(0.05, 0.0, 10.0)
    without_depth: bool = True


@dataclass(frozen=True)
class LossWeights:
    """Weights of the paper's losses (equations 4 to 7); feature and uniform rays are weighted apart.

    Each kind is averaged for itself, so with equal weights the few features would outvote the rest: 200 among the 5 %
    of a 640x480 image seventyfold. The paper gives no weights for them; here one ray counts about as much as another.
    """

    free_space: float = _number(5.0, 0.0)
    centre: float = _number(200.0, 0.0)
    tail: float = _number(10.0, 0.0)
    depth_uniform: float = _number(0.1, 0.0)
    depth_feature: float = _number(0.0014, 0.0)
    colour_uniform: float = _number(5.0, 0.0)
    colour_feature: float = _number(0.07, 0.0)


@dataclass(frozen=True)
class AlignConfig:
    """Direct alignment of each frame's measured points (ours), from which rendered tracking starts.

    to: the surface aligned to: the ``fused`` TSDF volume kept beside the map, the ``learned`` map itself, or ``none``,
    which leaves the paper's tracking alone. points: measured points used; iterations: at most, per stage; kernels_m:
    one stage each, coarse to fine; gradient_range: gradient norms trusted in the last stage. The other fields: see
    ``AlignSettings``. voxel_m: edge of the fused volume's voxels.
    """

    to: Literal["fused", "learned", "none"] = "fused"
    voxel_m: float = _number(0.02, 1e-3, 1.0)
    points: int = _number(2000, 64, 200_000)
    iterations: int = _number(10, 1, 100)
    kernels_m: tuple[float, ...] = (0.06, 0.02)
    tsdf_limit: float = _number(1.2, 0.1, 10.0)
    gradient_range: tuple[float, ...] = (0.75, 1.3)
    colour_weight_m: float = _number(0.05, 0.0, 1.0)
    colour_kernel: float = _number(0.2, 1e-3, 10.0)

    def __post_init__(self) -> None:
        """Raises InputError for lists that mean nothing."""
        if not self.kernels_m or min(self.kernels_m) <= 0:
            raise InputError(f"align.kernels_m = {list(self.kernels_m)} takes one or more lengths above 0 (metres)")
        if len(self.gradient_range) != 2 or not 0 <= self.gradient_range[0] < self.gradient_range[1]:
            raise InputError(
                f"align.gradient_range = {list(self.gradient_range)} takes two numbers from 0 on, the lower one first"
            )


@dataclass(frozen=True)
class TrackingConfig:
    """The paper's rendered tracking: Adam on the losses of a frame's rays against the fixed map. ``iterations`` 0
    leaves it out, and direct alignment alone tracks.

    momentum: Adam's first decay for poses. With its usual 0.9 a pose still moves the way of its first gradients when
    the few iterations of a frame end. unaligned_rate: how many times the learning rates count where no alignment comes
    before (``align.to`` none), since constant velocity guesses a pose from farther off.
    """

    iterations: int = _number(8, 0, 500)
    rays: int = _number(1000, 16, 200_000)
    lr_rotation: float = _number(1e-3, 0.0, 1.0)
    lr_translation: float = _number(1e-3, 0.0, 1.0)
    momentum: float = _number(0.5, 0.0, 0.999)
    unaligned_rate: float = _number(4.0, 0.0, 1e3)
    loss: LossWeights = LossWeights(10.0, 200.0, 50.0, 1.0, 0.25, 5.0, 1.25)


@dataclass(frozen=True)
class MappingConfig:
    """Joint optimisation of the map and the poses in the window.

    every: frames from one mapping to the next, which begins with the first keyframe from there on. newest_share: of the
    rays, for the newest keyframe. rim: whether the stored pixels reach into the border of ``border_px`` (ours; without
    them what is only ever seen there stays unmapped). final_iterations: of the map alone, on all keyframes, after the
    last frame, with the weights ``final_loss`` (ours: more for the tail, which brings out edges and thin things).
    """

    every: int = _number(5, 1, 1000)
    first_iterations: int = _number(200, 1, 100_000)
    iterations: int = _number(10, 0, 10_000)
    final_iterations: int = _number(100, 0, 100_000)
    rays: int = _number(2000, 16, 1_000_000)
    newest_share: float = _number(0.2, 0.0, 1.0)
    rim: bool = True
    lr_grid: float = _number(1e-2, 0.0, 1.0)
    lr_decoder: float = _number(1e-2, 0.0, 1.0)
    lr_rotation: float = _number(1e-4, 0.0, 1.0)
    lr_translation: float = _number(1e-4, 0.0, 1.0)
    loss: LossWeights = LossWeights()
    final_loss: LossWeights = LossWeights(tail=50.0)
    smooth_weight: float = _number(1e-6, 0.0)
    smooth_points: int = _number(32, 2, 256)
    smooth_voxel_m: float = _number(0.1, 1e-3, 1.0)


@dataclass(frozen=True)
class WindowConfig:
    """Which keyframes take part in bundle adjustment (paper, section III-B)."""

    size: int = _number(30, 2, 1000)
    max_angle_deg: float = _number(60.0, 1.0, 180.0)
    recent: int = _number(5, 1, 100)
    historic: int = _number(3, 0, 100)


@dataclass(frozen=True)
class Config:
    """Everything a run depends on besides the sequence. Defaults are the paper's lite preset on Replica."""

    preset: str = "lite"
    seed: int = _number(0, 0, 2**31 - 1)
    schedule: Literal["strict", "overlap"] = "strict"
    fus: bool = True
    eba: bool = True
    truncation_m: float = _number(0.06, 1e-3, 1.0)
    centre_share: float = _number(0.4, 0.01, 1.0)
    depth_near_m: float = _number(0.1, 0.0, 10.0)
    depth_far_m: float = _number(8.0, 0.1, 100.0)
    border_px: int = _number(20, 0, 200)
    feature_count: int = _number(200, 0, 10_000)
    feature_quality: float = _number(0.03, 1e-6, 1.0)
    feature_distance_px: int = _number(5, 1, 100)
    keyframe_every: int = _number(5, 1, 1000)
    keyframe_share: float = _number(0.05, 1e-4, 1.0)
    field: FieldConfig = FieldConfig()
    sampling: SamplingConfig = SamplingConfig()
    align: AlignConfig = AlignConfig()
    tracking: TrackingConfig = TrackingConfig()
    mapping: MappingConfig = MappingConfig()
    window: WindowConfig = WindowConfig()

    def __post_init__(self) -> None:
        """Raises InputError where settings contradict each other."""
        if self.depth_near_m >= self.depth_far_m:
            raise InputError("depth_near_m must be smaller than depth_far_m")
        if self.align.to == "none" and self.tracking.iterations == 0:
            raise InputError("align.to is none and tracking.iterations is 0, so nothing tracks; change one of them")


# ---- loading ------------------------------------------------------------------------------------------------------


class _StrictLoader(yaml.SafeLoader):
    """YAML without aliases and duplicate keys, and with ``1e-3`` read as the number it looks like."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.events.AliasEvent):
            raise yaml.YAMLError("aliases (*name) are not allowed")
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[Any] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if key in seen:
                raise yaml.YAMLError(f"the key {key!r} stands twice (line {key_node.start_mark.line + 1})")
            seen.add(key)
        return super().construct_mapping(node, deep)


_StrictLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"),
    list("-+0123456789."),
)


def parse_yaml(text: str, source: str) -> Any:
    """Parse strict YAML. Raises InputError naming ``source``."""
    if len(text) > MAX_CONFIG_BYTES:
        raise InputError(
            f"{source}: over {MAX_CONFIG_BYTES // 1024} KiB, which no configuration needs; is it the right file?"
        )
    try:
        return yaml.load(text, _StrictLoader)
    except (yaml.YAMLError, ValueError, TypeError) as error:
        raise InputError(f"{source}: not valid YAML: {' '.join(str(error).split())}") from None
    except RecursionError:
        raise InputError(f"{source}: nested too deeply for a configuration; is it the right file?") from None


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
            f"preset {name!r}: no such preset{_suggest(name, preset_names())}; there are: {', '.join(preset_names())}"
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
        raise InputError(f"{source}: {prefix.rstrip('.') or 'the file'} must hold keys and values, not {_kind(values)}")
    hints = typing.get_type_hints(type(node))
    by_name = {f.name: f for f in fields(node)}
    changes: dict[str, Any] = {}
    for key, value in values.items():
        path = f"{prefix}{key}"
        if key not in by_name:
            raise InputError(f"{source}: unknown key {path!r}{_suggest(path, _all_keys(Config))}")
        current = getattr(node, key)
        if is_dataclass(current):
            changes[key] = _apply(current, value, source, f"{path}.")
        else:
            changes[key] = _convert(value, hints[key], by_name[key].metadata, source, path)
    try:
        return dataclasses.replace(node, **changes)
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
        if not isinstance(value, (list, tuple)) or not all(_is_number(v) for v in value):
            raise InputError(f"{source}: {path} must be a list of numbers, not {_kind(value)} {value!r}")
        return tuple(float(v) for v in value)
    wanted = {int: "a whole number", float: "a number", bool: "true or false", str: "text"}[hint]
    ok = {
        int: isinstance(value, int) and not isinstance(value, bool),
        float: _is_number(value),
        bool: isinstance(value, bool),
        str: isinstance(value, str),
    }[hint]
    if not ok:
        raise InputError(f"{source}: {path} must be {wanted}, not {_kind(value)} {value!r}")
    low, high = limits.get("low", -math.inf), limits.get("high", math.inf)
    if hint in (int, float) and not low <= value <= high:
        raise InputError(f"{source}: {path} = {value} is out of range; it must lie in {low:g} .. {high:g}")
    return float(value) if hint is float else value


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _kind(value: Any) -> str:
    names = {dict: "a group of keys", list: "a list", str: "text", bool: "true/false", type(None): "nothing"}
    return names.get(type(value), "the number" if isinstance(value, (int, float)) else type(value).__name__)


def _all_keys(node: type, prefix: str = "") -> list[str]:
    keys: list[str] = []
    hints = typing.get_type_hints(node)
    for f in fields(node):
        keys.append(prefix + f.name)
        if is_dataclass(hints[f.name]):
            keys += _all_keys(hints[f.name], f"{prefix}{f.name}.")
    return keys


def _suggest(word: str, options: list[str]) -> str:
    near = difflib.get_close_matches(word, options, 1, 0.6)
    if not near:
        near = [o for o in options if o.rsplit(".", 1)[-1] == word.rsplit(".", 1)[-1]][:1]
    return f"; did you mean {near[0]!r}?" if near else ""
