"""Messages of browsers: each is checked, and wrong ones are one sentence."""

import math
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from warpgs.errors import DataError
from warpgs.viewer.server import MAX_FRAME, control_value, read_frame, write_frame

msgspec = pytest.importorskip("msgspec")
CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [1, 0.0, 0, 0], "position": [0.5, 1, -2], "look_at": [0, 0, 0],
    "up_direction": [0, 0, 1], "fov": 0.8, "near": 0.01, "far": 1e5, "image_height": 600, "image_width": 800,
}  # fmt: skip
VALUE = {"type": "GuiUpdateMessage", "uuid": "u", "updates": {"value": True}}
MOVED = {"type": "TransformControlsUpdateMessage", "name": "/crop", "owner": "", "wxyz": [0, 1, 0, 0], "position": [1, 2, 3]}
CLICK = {
    "type": "SceneNodeClickMessage", "name": "/cameras/0", "owner": "", "instance_index": None, "ray_origin": [0, 0, 0],
    "ray_direction": [0, 0, 1], "screen_pos": [0.5, 0.5], "modifier": None,
}  # fmt: skip
ENDED = {"type": "TransformControlsDragEndMessage", "name": "/crop", "owner": ""}
GOOD = (CAMERA, VALUE, MOVED, CLICK, ENDED)
nan = math.nan


@pytest.mark.parametrize("message", GOOD, ids=lambda m: m["type"])
def test_messages_of_the_page_pass(message):
    """And come out as they went in."""
    assert read_frame(write_frame(message)) == message


@pytest.mark.parametrize(
    "message",
    [
        {**CAMERA, "wxyz": [0, 0, 0, 0]}, {**CAMERA, "wxyz": [1, 0, 0]}, {**CAMERA, "position": [nan, 0, 0]},
        {**CAMERA, "position": [1e10, 0, 0]}, {**CAMERA, "position": None}, {**CAMERA, "fov": 0}, {**CAMERA, "fov": math.inf},
        {**CAMERA, "image_width": 2**16}, {**CAMERA, "image_width": 1.5}, {**CAMERA, "image_height": -1}, {**CAMERA, "more": 1},
        {k: v for k, v in CAMERA.items() if k != "far"}, {**CAMERA, 7: 7},
        {**VALUE, "updates": {"removed": True}}, {**VALUE, "updates": {"value": True, "update_cb": []}},
        {**VALUE, "updates": {}},         {**VALUE, "updates": {"value": {}}}, {**VALUE, "updates": {"value": nan}},
        {**VALUE, "updates": {"value": [1, 2, 3, 4]}}, {**VALUE, "updates": {"value": "x" * 5000}}, {**VALUE, "uuid": 5},
        {**MOVED, "position": [0, 0, "0"]}, {**MOVED, "name": "x\0"}, {**CLICK, "screen_pos": [0]},
        {**CLICK, "instance_index": -1},
        {"type": "RunJavascriptMessage", "source": "alert(1)"}, {"type": "ShareUrlRequest"},
        {"type": "FileTransferStartUpload"}, {"type": "__init__"}, {"type": 7}, {}, [], 7, None, "text",
    ],
    ids=lambda m: str(m)[:40],
)  # fmt: skip
def test_other_messages_are_refused(message):
    """Unknown types, fields that are missing, unknown or of another kind, numbers out of range."""
    with pytest.raises(DataError):
        read_frame(write_frame(message))


@pytest.mark.parametrize(
    "frame", [b"", b"\xc1", b"\x81", b"\x91" * 5000, b"\xd4\x05a", "text", b"\xc4", b"\x00" * (MAX_FRAME + 1)]
)
def test_frames_that_are_no_messages(frame):
    """Cut off, nested without end, not MessagePack, text, or too long."""
    with pytest.raises(DataError):
        read_frame(frame)


@given(st.sampled_from(GOOD), st.data())
def test_damaged_frames_are_refused_or_pass(message, data):
    """A changed byte or a cut makes no other error."""
    frame = bytearray(write_frame(message))
    for _ in range(data.draw(st.integers(1, 3))):
        frame[data.draw(st.integers(0, len(frame) - 1))] = data.draw(st.integers(0, 255))
    try:
        read_frame(bytes(frame[: data.draw(st.integers(0, len(frame)))]))
    except DataError:
        pass


def test_controls_take_values_within_their_limits():
    """A choice is one of the options, numbers are moved to the nearest limit, all else is refused."""
    choice = SimpleNamespace(value="a", options=("a", "b"))
    slider = SimpleNamespace(value=1, min=0, max=3)
    number = SimpleNamespace(value=2.0, min=0.1, max=600.0)
    vector = SimpleNamespace(value=(1.0, 1.0, 1.0), min=(0.5,) * 3, max=None)
    box = SimpleNamespace(value=False)
    text = SimpleNamespace(value="free")
    for control, given_value, taken in (
        (choice, "b", "b"), (slider, 2, 2), (slider, 2.0, 2), (slider, 99, 3), (number, 0, 0.1), (number, 7, 7.0),
        (vector, [1, 0, 1e9], [1.0, 0.5, 1e9]), (box, True, True), (None, True, True),
    ):  # fmt: skip
        assert control_value(given_value, control) == taken and type(control_value(given_value, control)) is type(taken)
    for control, wrong in (
        (choice, "c"), (choice, 1), (choice, True), (slider, "2"), (slider, True), (slider, [1, 1, 1]), (number, None),
        (vector, [1, 1]), (vector, 1), (vector, [1, 1, True]), (vector, [1, 1, "1"]), (box, 1), (box, "x"), (None, "x"),
        (None, 1), (text, "other"),
    ):  # fmt: skip
        with pytest.raises(DataError):
            control_value(wrong, control)
