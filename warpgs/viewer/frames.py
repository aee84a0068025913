"""Messages that a browser sends to the viewer: read from websocket frames, and checked before viser sees them."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from typing import Any

from warpgs import schema
from warpgs.errors import DataError
from warpgs.schema import Schema, SchemaError

MAX_FRAME = 2**16
"""Largest frame [bytes]; a camera takes 300."""
MAX_COORDINATE = 1e9
"""Largest coordinate [u]."""
MAX_TEXT = 4096
"""Longest text: names of images are among the values of controls."""


def _within(low: float, high: float) -> Schema:
    """Return the schema of finite numbers from ``low`` to ``high``."""

    def check(value: Any, place: str) -> None:
        schema.number(low)(value, place)
        if value > high:
            raise SchemaError(f"{place} must be at most {high:g}, not {value:g}")

    return check


def _short(value: Any, place: str) -> None:
    schema.text(value, place)
    if len(value) > MAX_TEXT:
        raise SchemaError(f"{place} must be at most {MAX_TEXT} letters long")


def _rotation(value: Any, place: str) -> None:
    """Allow unit quaternions."""
    schema.items(_within(-1.01, 1.01), 4)(value, place)
    if abs(math.hypot(*value) - 1) > 0.01:
        raise SchemaError(f"{place} must be a unit quaternion")


def _value(value: Any, place: str) -> None:
    """Allow what a control can hold."""
    if isinstance(value, list):
        schema.items(_coordinate, 3)(value, place)
    elif isinstance(value, str):
        _short(value, place)
    elif not isinstance(value, bool):
        _coordinate(value, place)


_coordinate = _within(-MAX_COORDINATE, MAX_COORDINATE)
_point = schema.items(_coordinate, 3)
_size = schema.whole(0, 2**15)
_node = {"name": _short, "owner": _short}
_only = functools.partial(schema.fields, others=False)
MESSAGES: Mapping[str, Schema] = {
    "ViewerCameraMessage": _only(
        {
            "wxyz": _rotation, "position": _point, "look_at": _point, "up_direction": _point, "fov": _within(1e-3, 3.1),
            "near": _within(0, MAX_COORDINATE), "far": _within(0, MAX_COORDINATE), "image_height": _size, "image_width": _size,
        }
    ),
    "GuiUpdateMessage": _only({"uuid": _short, "updates": _only({"value": _value})}),
    "SceneNodeClickMessage": _only(
        {
            **_node, "instance_index": schema.or_null(schema.whole(0)), "ray_origin": _point, "ray_direction": _point,
            "screen_pos": schema.items(_coordinate, 2), "modifier": schema.or_null(_short),
        }
    ),
    "TransformControlsUpdateMessage": _only({**_node, "wxyz": _rotation, "position": _point}),
    "TransformControlsDragStartMessage": _only(_node),
    "TransformControlsDragEndMessage": _only(_node),
}  # fmt: skip
"""Messages that the viewer needs, by type, with the schema of the other fields; viser has more, such as uploads and tunnels."""


def read_frame(frame: bytes | str) -> dict[str, Any]:
    """Return the message of a websocket frame, with ``type`` and checked fields.

    Args:
        frame: MessagePack, as viser's page sends it.

    Raises:
        DataError: The frame is not a message, not one of `MESSAGES`, or a field has an invalid value.
    """
    import msgspec

    if not isinstance(frame, bytes) or len(frame) > MAX_FRAME:
        raise DataError(f"a message must be binary and at most {MAX_FRAME} bytes long")
    try:
        message = msgspec.msgpack.decode(frame)
    except (ValueError, TypeError, RecursionError) as e:
        raise DataError(f"a message is not MessagePack: {e}") from e
    if not isinstance(message, dict) or not isinstance(message.get("type"), str):
        raise DataError("a message has no type")
    kind = message["type"]
    if kind not in MESSAGES:
        raise DataError(f"a message has the unknown type {kind[:60]!r}")
    fields = {name: value for name, value in message.items() if name != "type"}
    if not all(isinstance(name, str) for name in fields):
        raise DataError(f"{kind}: a field's name is not text")
    try:
        MESSAGES[kind](fields, kind)
    except SchemaError as e:
        raise DataError(f"a message is malformed: {e}") from e
    return {"type": kind, **fields}


def write_frame(message: Mapping[str, Any]) -> bytes:
    """Return a message as a frame: viser reads checked messages only."""
    import msgspec

    return bytes(msgspec.msgpack.encode(message))


def control_value(value: Any, control: Any) -> Any:
    """Return a message's value as a value for a control, clamped to the control's limits.

    Args:
        value: Value of a message, as `read_frame` returns it.
        control: A control of viser, with its present ``value`` and perhaps ``options``, ``min`` and ``max``; None for an
            unknown one, which can only be a button.

    Raises:
        DataError: The control cannot have the value.
    """
    present = True if control is None else control.value
    options = getattr(control, "options", None)
    low, high = getattr(control, "min", None), getattr(control, "max", None)
    if isinstance(present, bool):
        if isinstance(value, bool):
            return value
    elif isinstance(present, str) and options is not None:
        if value in options:
            return value
    elif isinstance(present, (int, float)):
        if _is_number(value):
            return type(present)(_limited(value, low, high))
    elif isinstance(present, tuple) and isinstance(value, list) and len(value) == len(present) and all(map(_is_number, value)):
        lows, highs = (limits if limits is not None else (None,) * len(present) for limits in (low, high))
        return [float(_limited(v, a, b)) for v, a, b in zip(value, lows, highs)]
    raise DataError(f"a control cannot have the value {str(value)[:60]!r}")


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= MAX_COORDINATE


def _limited(value: float, low: float | None, high: float | None) -> float:
    value = value if low is None else max(value, low)
    return value if high is None else min(value, high)
