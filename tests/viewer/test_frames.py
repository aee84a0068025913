"""Messages of browsers: each is checked, and wrong ones are one sentence."""

import math
from types import SimpleNamespace

import pytest

from tests.faults.viewer_targets import CONTROLS, MESSAGES
from warpgs.errors import DataError
from warpgs.viewer.server import MAX_FRAME, control_value, read_frame, write_frame

pytest.importorskip("msgspec")
CAMERA, CLICK, MOVED, VALUE = (MESSAGES[name] for name in ("camera", "click", "moved", "tick"))
ENDED = {"type": "TransformControlsDragEndMessage", "name": "/crop", "owner": ""}
nan = math.nan


@pytest.mark.parametrize("message", [*MESSAGES.values(), ENDED], ids=lambda m: m["type"])
def test_messages_of_the_page_pass(message):
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
    with pytest.raises(DataError):
        read_frame(write_frame(message))


def test_frames_that_are_no_messages_and_values_of_controls():
    for frame in (b"", b"\xc1", b"\x81", b"\x91" * 5000, b"\xd4\x05a", "text", b"\xc4", b"\x00" * (MAX_FRAME + 1)):
        with pytest.raises(DataError):
            read_frame(frame)
    choice, slider, vector, box = (CONTROLS[name] for name in ("choice", "slider", "vector", "tick"))
    number, text = SimpleNamespace(value=2.0, min=0.1, max=600.0), SimpleNamespace(value="free")
    for control, given_value, taken in (
        (choice, "depth", "depth"), (slider, 2, 2), (slider, 2.0, 2), (slider, 99, 3), (number, 0, 0.1), (number, 7, 7.0),
        (vector, [1, 0, 1e9], [1.0, 1e-3, 1e9]), (box, True, True), (None, True, True),
    ):  # fmt: skip
        assert control_value(given_value, control) == taken and type(control_value(given_value, control)) is type(taken)
    for control, wrong in (
        (choice, "c"), (choice, 1), (choice, True), (slider, "2"), (slider, True), (slider, [1, 1, 1]), (number, None),
        (vector, [1, 1]), (vector, 1), (vector, [1, 1, True]), (vector, [1, 1, "1"]), (box, 1), (box, "x"), (None, "x"),
        (None, 1), (text, "other"),
    ):  # fmt: skip
        with pytest.raises(DataError):
            control_value(wrong, control)
