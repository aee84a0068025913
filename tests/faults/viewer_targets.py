"""Messages and requests of browsers to the viewer, for the fuzzer, as the bytes of websocket frames and of HTTP."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from tests.faults.mutations import changed_value, flip, number, text_line
from tests.faults.targets import Target, register, writing
from warpgs import ranks
from warpgs.errors import DataError
from warpgs.viewer import server

PLACE = {"name": "/crop", "owner": ""}
MESSAGES = {
    "camera": {
        "type": "ViewerCameraMessage", "wxyz": [1.0, 0.0, 0.0, 0.0], "position": [0.5, 1.0, -2.0], "look_at": [0.0, 0.0, 0.0],
        "up_direction": [0.0, 0.0, 1.0], "fov": 0.8, "near": 0.01, "far": 1e5, "image_height": 600, "image_width": 800,
    },
    "click": {
        "type": "SceneNodeClickMessage", **PLACE, "instance_index": None, "ray_origin": [0.0, 0.0, 0.0],
        "ray_direction": [0.0, 0.0, 1.0], "screen_pos": [0.5, 0.5], "modifier": None,
    },
    "pointer": {
        "type": "ScenePointerMessage", "event_type": "click", "ray_origin": [0.0, 0.0, 0.0], "ray_direction": [0.0, 0.0, 1.0],
        "screen_pos": [[0.5, 0.5]], "modifier": None,
    },
    "moved": {"type": "TransformControlsUpdateMessage", **PLACE, "wxyz": [0.0, 1.0, 0.0, 0.0], "position": [1.0, 2.0, 3.0]},
    "tick": {"type": "GuiUpdateMessage", "uuid": "tick", "updates": {"value": True}},
    "choice": {"type": "GuiUpdateMessage", "uuid": "choice", "updates": {"value": "depth"}},
    "slider": {"type": "GuiUpdateMessage", "uuid": "slider", "updates": {"value": 2}},
    "vector": {"type": "GuiUpdateMessage", "uuid": "vector", "updates": {"value": [1.0, 2.0, 0.5]}},
    "button": {"type": "GuiUpdateMessage", "uuid": "button", "updates": {"value": True}},
}  # fmt: skip
CONTROLS = {
    "tick": SimpleNamespace(value=False),
    "choice": SimpleNamespace(value="render", options=("render", "depth")),
    "slider": SimpleNamespace(value=1, min=0, max=3),
    "vector": SimpleNamespace(value=(1.0, 1.0, 1.0), min=(1e-3,) * 3, max=None),
}
TOKEN = "a" * 43


def frame_files(root: Path) -> list[Path]:
    return sorted(writing({f"{name}.frame": server.write_frame(message) for name, message in MESSAGES.items()})(root))


def frame_value(data: bytes, rng: np.random.Generator) -> bytes:
    import msgspec

    try:
        message = msgspec.msgpack.decode(data)
        if rng.random() < 0.1 and isinstance(message, dict):
            message["type"] = list(MESSAGES.values())[int(rng.integers(len(MESSAGES)))]["type"]
            return msgspec.msgpack.encode(message)
        return msgspec.msgpack.encode(changed_value(message, rng))
    except (ValueError, TypeError, RecursionError, OverflowError):
        return flip(data, rng)


def message_of(root: Path, path: Path) -> object | None:
    """Read a frame as the viewer does, and what is left of it as viser does; None where the viewer drops it."""
    from viser.infra._messages import Message

    data = path.read_bytes() if path.is_file() else b""
    rules = server.Rules()
    rules.control_of = CONTROLS.get
    try:
        frame = rules.checked(data)
    except DataError as e:  # the connection is named where it is closed
        raise DataError(f"{path}: a browser's message was refused: {e}") from e
    return None if frame is None else Message.deserialize(frame)


# ---- requests ----------------------------------------------------------------------------------------------------------

HEADERS = (b"Host: 127.0.0.1:8080", b"Origin: http://127.0.0.1:8080", b"Upgrade: websocket", b"Connection: Upgrade")
OTHERS = (
    b"Host: example.org", b"Host: localhost:8080", b"Origin: null", b"Origin: http://example.org", b"Origin: ",
    b"Host: 127.0.0.1:x", b"X: \xff", b"Host", b": x", b"Content-Length: 5", b"Cookie: " + b"a" * 9000,
)  # fmt: skip
SECRET = b"/" + TOKEN.encode()
TARGETS = (b"/", b"//", b"*", b"http://x/", SECRET, SECRET + b"/../x", b"/?a=b", b"/\xff", b"/" * 9000)


def request_files(root: Path) -> list[Path]:
    asked = {"page": (b"/", HEADERS[:1]), "script": (b"/assets/a.js", HEADERS[:2]), "socket": (b"/", HEADERS)}
    first = {name: b"GET " + SECRET + path + b" HTTP/1.1" for name, (path, _) in asked.items()}
    return writing({f"{name}.http": b"\r\n".join([first[name], *asked[name][1], b"", b""]) for name in asked})(root)


def request_line(data: bytes, rng: np.random.Generator) -> bytes:
    lines = data.split(b"\r\n")
    kind, at = int(rng.integers(4)), int(rng.integers(1, max(2, len(lines) - 2)))
    if kind == 0:
        lines[0] = b"GET " + TARGETS[int(rng.integers(len(TARGETS)))] + b" HTTP/1.1"
    elif kind == 1 and at < len(lines):
        del lines[at]
    else:
        new = (*OTHERS, *HEADERS)[int(rng.integers(len(OTHERS) + len(HEADERS)))]
        lines[at : at + kind - 2] = [new]
    return b"\r\n".join(lines)


def admitted(root: Path, path: Path) -> str | None:
    """Read a request with websockets, and admit it or not; None where it is refused."""
    from websockets.http11 import Request
    from websockets.streams import StreamReader

    reader = StreamReader()
    reader.feed_data(path.read_bytes() if path.is_file() else b"")
    reader.feed_eof()
    parsing = Request.parse(reader.read_line)
    try:
        while True:
            next(parsing)
    except StopIteration as e:
        request = e.value
    except Exception as e:  # of websockets, which closes the connection
        raise DataError(f"{path}: is no request that websockets reads ({e})") from e
    guard = ranks.WebGuard()
    guard.token = TOKEN
    headers = request.headers
    return guard.admitted_path(request.path, headers.get_all("Host"), headers.get_all("Origin"), "Upgrade" in headers)


if importlib.util.find_spec("viser"):
    checks = (server.Rules.checked, server.read_frame, server.control_value, server._value, server._rotation, server._limited)
    register(Target("frame of a websocket", frame_files, message_of, checks, (frame_value, frame_value, number)))
    checks = (ranks.WebGuard.admitted_path, ranks._is_own)
    register(Target("request to the viewer", request_files, admitted, checks, (request_line, request_line, text_line)))
