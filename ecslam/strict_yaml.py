"""YAML that is read strictly, and the words for what is wrong with it."""

from __future__ import annotations

import difflib
import re
import sys
from typing import Any

import yaml

from .types import InputError

MAX_BYTES = 64 * 1024


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
    if len(text) > MAX_BYTES:
        raise InputError(f"{source}: over {MAX_BYTES // 1024} KiB of settings; is it the right file?")
    try:
        return yaml.load(text, _StrictLoader)
    except (yaml.YAMLError, ValueError, TypeError) as error:
        raise InputError(f"{source}: not valid YAML: {' '.join(str(error).split())}") from None
    except RecursionError:
        raise InputError(f"{source}: nested too deeply for settings; is it the right file?") from None


def is_number(value: Any) -> bool:
    """Whether it is a finite number that a float can hold."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def kind_of(value: Any) -> str:
    """What a value is, in words."""
    names = {dict: "a group of keys", list: "a list", str: "text", bool: "true/false", type(None): "nothing"}
    return names.get(type(value), "the number" if isinstance(value, (int, float)) else type(value).__name__)


def nearest(word: str, options: list[str]) -> str:
    """A question that suggests the option most like ``word``, to end a message with; empty where none is."""
    near = difflib.get_close_matches(word, options, 1, 0.6)
    if not near:
        near = [o for o in options if o.rsplit(".", 1)[-1] == word.rsplit(".", 1)[-1]][:1]
    return f"; did you mean {near[0]!r}?" if near else ""
