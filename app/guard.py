"""What a browser may say. viser trusts its clients; this decides, message by message, what reaches it.

Only the message types a page of ours needs are let through; a GUI update may carry nothing but a ``value`` that the
control itself could have produced. Everything else is dropped before viser decodes it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import msgspec
import viser

MAX_TEXT = 200
MAX_PAYLOAD = 24 * 1024 * 1024

Values = Callable[[str, Any], bool]


def make_check(gui: viser.GuiApi) -> Callable[[bytes], bool]:
    """A function that says whether a raw message from a browser may pass to the server whose GUI this is."""

    def allowed_value(uuid: str, value: Any) -> bool:
        handle = gui._gui_input_handle_from_uuid.get(uuid)
        return handle is not None and value_fits(handle, value)

    return lambda raw: message_passes(raw, allowed_value)


def message_passes(raw: bytes, allowed_value: Values) -> bool:
    """Decode one message and check its type, its exact fields and its values."""
    try:
        message = msgspec.msgpack.decode(raw)
    except (msgspec.DecodeError, RecursionError):
        return False
    if not isinstance(message, dict):
        return False
    kind = message.pop("type", None)
    check = _CHECKS.get(kind) if isinstance(kind, str) else None
    return check is not None and check(message, allowed_value)


def value_fits(handle: Any, value: Any) -> bool:
    """Whether the control ``handle`` could have produced ``value``: right type, in range, one of the options."""
    if getattr(handle, "disabled", False) or not getattr(handle, "visible", True):
        return False
    if isinstance(handle, (viser.GuiButtonHandle, viser.GuiCheckboxHandle)):
        return isinstance(value, bool)
    if isinstance(handle, (viser.GuiDropdownHandle, viser.GuiButtonGroupHandle)):
        return isinstance(value, str) and value in handle.options
    if isinstance(handle, (viser.GuiSliderHandle, viser.GuiNumberHandle)):
        low = -math.inf if handle.min is None else handle.min
        high = math.inf if handle.max is None else handle.max
        whole = isinstance(handle.value, int) and not isinstance(handle.value, bool)
        return _finite(value) and low <= value <= high and (not whole or value == int(value))
    if isinstance(handle, viser.GuiTextHandle):
        return isinstance(value, str) and len(value) <= MAX_TEXT
    return False


def _finite(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e12


def _vector(value: Any, size: int) -> bool:
    return isinstance(value, list) and len(value) == size and all(map(_finite, value))


def _gui_update(m: Mapping[str, Any], allowed_value: Values) -> bool:
    updates = m.get("updates")
    if set(m) != {"uuid", "updates"} or not isinstance(m["uuid"], str) or not isinstance(updates, dict):
        return False
    return set(updates) == {"value"} and allowed_value(m["uuid"], updates["value"])


def _camera(m: Mapping[str, Any], _: Values) -> bool:
    sizes = {"wxyz": 4, "position": 3, "look_at": 3, "up_direction": 3}
    numbers = {"fov", "near", "far", "image_height", "image_width"}
    if set(m) != {*sizes, *numbers} or not all(_vector(m[k], n) for k, n in sizes.items()):
        return False
    return all(_finite(m[k]) and m[k] >= (k.startswith("image_")) for k in numbers)


def _click(m: Mapping[str, Any], _: Values) -> bool:
    vectors = {"ray_origin": 3, "ray_direction": 3, "screen_pos": 2}
    others = {"name", "instance_index", "modifier", "owner"}
    index = m.get("instance_index")
    return (
        set(m) <= {*vectors, *others}
        and all(_vector(m.get(k), n) for k, n in vectors.items())
        and isinstance(m.get("name"), str)
        and (index is None or (isinstance(index, int) and 0 <= index < 1_000_000))
    )


def _pointer(m: Mapping[str, Any], _: Values) -> bool:
    """A click anywhere in the scene: no rectangle, no modifier, and a ray of unit direction."""
    points = m.get("screen_pos")
    return (
        set(m) == {"event_type", "ray_origin", "ray_direction", "screen_pos", "modifier"}
        and m["event_type"] == "click"
        and m["modifier"] is None
        and _vector(m["ray_origin"], 3)
        and _vector(m["ray_direction"], 3)
        and abs(math.hypot(*m["ray_direction"]) - 1) < 1e-3
        and isinstance(points, list)
        and len(points) == 1
        and _vector(points[0], 2)
    )


def _command(m: Mapping[str, Any], _: Values) -> bool:
    return set(m) == {"uuid"} and isinstance(m["uuid"], str)


def _render(m: Mapping[str, Any], _: Values) -> bool:
    payload = m.get("payload")
    return set(m) == {"render_uuid", "payload"} and isinstance(payload, bytes) and len(payload) <= MAX_PAYLOAD


def _acknowledge(m: Mapping[str, Any], _: Values) -> bool:
    fields = {"source_component_uuid", "transfer_uuid", "transferred_bytes", "total_bytes"}
    return set(m) == fields and _finite(m["transferred_bytes"]) and isinstance(m["transfer_uuid"], str)


_CHECKS: dict[str, Callable[[Mapping[str, Any], Values], bool]] = {
    "GuiUpdateMessage": _gui_update,
    "ViewerCameraMessage": _camera,
    "SceneNodeClickMessage": _click,
    "ScenePointerMessage": _pointer,
    "CommandTriggerMessage": _command,
    "GetRenderResponseMessage": _render,
    "FileTransferPartAck": _acknowledge,
}
