"""The viewer's server: this machine alone, no tunnels, no pages of other sites, and nobody without its address."""

import base64
import os
import socket
import struct
import threading
from importlib.metadata import version

import psutil
import pytest

from tests.viewer.test_frames import CAMERA, VALUE
from warpgs.ranks import HOST
from warpgs.viewer import server as connections
from warpgs.viewer.server import MAX_FRAME, address, guarded, open_server, stop_server, write_frame

pytest.importorskip("viser")


@pytest.fixture(scope="module")
def server():
    opened = open_server(0)
    yield opened
    stop_server(opened)


def asked(server, target=None, *, upgrade=True, host=None, origin="own", method="GET", more=()) -> socket.socket:
    """A connection on which a request was sent: by default that of the page for its websocket."""
    port = server.get_port()
    host = f"{HOST}:{port}" if host is None else host
    target = f"/{server.rules.guard.token}" if target is None else target
    lines = [f"{method} {target} HTTP/1.1", f"Host: {host}", *more]
    lines += [f"Origin: http://{host}" if origin == "own" else f"Origin: {origin}"] if origin else []
    if upgrade:
        lines += ["Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13"]
        lines += [f"Sec-WebSocket-Key: {base64.b64encode(os.urandom(16)).decode()}"]
        lines += [f"Sec-WebSocket-Protocol: viser-v{version('viser')}"]
    stream = socket.create_connection((HOST, port), timeout=30)
    stream.sendall("\r\n".join([*lines, "", ""]).encode("latin-1"))
    return stream


def read(stream: socket.socket, until=None) -> bytes:
    found = b""
    while until is None or until not in found:
        try:
            part = stream.recv(2**16)
        except ConnectionResetError:
            part = b""
        if not part:
            break
        found += part
    return found


def answer(server, *args, **named) -> bytes:
    with asked(server, *args, **named) as stream:
        return read(stream)


def opened(server) -> socket.socket:
    stream = asked(server)
    assert read(stream, b"\r\n\r\n").startswith(b"HTTP/1.1 101 ")
    return stream


def framed(data: bytes, kind=2) -> bytes:
    return bytes([0x80 | kind]) + struct.pack("!BQ", 0xFF, len(data)) + bytes(4) + data


def closes(stream: socket.socket) -> bool:
    """Whether the other side closes; messages of the scene that come before are passed over."""
    stream.settimeout(30)
    try:
        while stream.recv(2**16):
            pass
    except ConnectionResetError:
        pass
    except TimeoutError:
        return False
    return True


def test_who_lacks_the_address_gets_nothing(server):
    """Foreign names and origins, no origin, no token, a wrong one, a query: 403, for pages and for websockets."""
    token, port = server.rules.guard.token, server.get_port()
    page = f"/{token}/"
    for target, upgrade, named in (
        (None, True, {"origin": ""}), (None, True, {"origin": "http://example.org"}), (None, True, {"origin": "null"}),
        (None, True, {"origin": f"http://localhost:{port}"}), (None, True, {"host": f"example.org:{port}"}),
        ("/", True, {}), ("/" + "A" * len(token), True, {}), (f"{page}?websocket=ws://example.org", True, {}),
        (None, True, {"more": [f"Origin: http://{HOST}:{port}"]}), (None, True, {"more": ["Host: localhost"]}),
        ("/", False, {}), ("/index.html", False, {"origin": ""}),
        (f"{page}?websocket=ws://example.org:9001", False, {"origin": ""}),
        (f"{page}?playbackPath=http://example.org/a", False, {"origin": ""}), (page, False, {"host": f"example.org:{port}"}),
        (page, False, {"origin": "http://example.org"}), ("/" + "A" * len(token) + "/", False, {}),
    ):  # fmt: skip
        found = answer(server, target, upgrade=upgrade, **named)
        head, _, body = found.partition(b"\r\n\r\n")
        assert head.startswith(b"HTTP/1.1 403 ") and body == connections.REFUSED.encode(), (target, named, found)
        assert b"frame-ancestors 'none'" in head and b"no-store" in head and token.encode() not in head
    for method in ("POST", "HEAD", "OPTIONS"):  # a form, or a question whether a request is allowed
        assert answer(server, page, upgrade=False, method=method) == b""


def test_who_has_the_address_gets_page_and_scene(server):
    """Without an origin for the page, by a tunnel with another port, with every header; and a websocket with the scene."""
    page = f"/{server.rules.guard.token}/"
    assert address(server).endswith(f":{server.get_port()}{page}")
    for host, origin in ((None, ""), (None, "own"), ("localhost:9000", "own")):
        found = answer(server, page, upgrade=False, host=host, origin=origin, more=["Accept-Encoding: gzip"])
        head, _, body = found.partition(b"\r\n\r\n")
        head = head.decode()
        assert head.startswith("HTTP/1.1 200 ") and b"</html>" in body and f"Content-Length: {len(body)}" in head
        nonce = head.partition("'nonce-")[2].partition("'")[0]
        assert body.count(b"<script") == body.count(f'<script nonce="{nonce}"'.encode()) >= 2
        for line in (
            "X-Frame-Options: DENY", "Referrer-Policy: no-referrer", "X-Content-Type-Options: nosniff",
            "Cache-Control: no-store",
            f"connect-src 'self' ws://{host or f'{HOST}:{server.get_port()}'} ", "default-src 'none'", "form-action 'none'",
        ):  # fmt: skip
            assert line in head
    assert answer(server, f"{page}missing.js", upgrade=False).startswith(b"HTTP/1.1 404 ")
    for host in (None, "localhost:9000"):
        with asked(server, host=host) as stream:
            assert read(stream, b"\r\n\r\n\x82").startswith(b"HTTP/1.1 101 ")  # and a message of the scene


@pytest.mark.parametrize(
    "data",
    [
        b"", b"\xc1", b"\x91" * 5000, write_frame({"type": "RunJavascriptMessage", "source": "1"}),
        write_frame({**CAMERA, "position": [float("nan"), 0, 0]}), write_frame({**VALUE, "updates": {"removed": True}}),
        bytes(MAX_FRAME + 1),
    ],
    ids=["empty", "invalid", "deep", "unknown", "nan", "property", "large"],
)  # fmt: skip
def test_a_wrong_message_closes_its_connection_alone(server, data, capfd):
    """With one line on stderr at most, and no traceback; the next browser is served."""
    with opened(server) as other:
        with opened(server) as stream:
            stream.sendall(framed(data))
            assert closes(stream)
        other.sendall(framed(write_frame(CAMERA)))
        opened(server).close()
    lines = capfd.readouterr().err.splitlines()
    assert len(lines) == (len(data) <= MAX_FRAME) and all(line.startswith("the viewer closed the connection") for line in lines)


def test_text_and_garbage_close_the_connection(server, capfd):
    with opened(server) as stream:
        stream.sendall(framed(b"text", kind=1))
        assert closes(stream)
    for data in (b"\xff" * 64, b"\x00" * 64):
        with opened(server) as stream:
            stream.sendall(data)
            assert closes(stream)
    with socket.create_connection((HOST, server.get_port())) as stream:
        stream.sendall(b"\x16\x03\x01\x00\n\r\n\r\n")
        assert closes(stream)
    assert len(capfd.readouterr().err.splitlines()) == 1

    def wrong(_):
        raise KeyError("no\nsuch thing")

    guarded(wrong)(None)
    assert capfd.readouterr().err == "the viewer could not serve a request of a browser (KeyError: 'no\\nsuch thing')\n"


def test_values_that_a_control_cannot_have_are_passed_over(server, capfd):
    """An unknown choice changes nothing; a number beyond its range becomes the last one in it; the connection stays."""
    chooser = server.gui.add_dropdown("show", ("a", "b"))
    slider = server.gui.add_slider("degree", 0, 3, 1, 1)
    changed = threading.Event()
    slider.on_update(guarded(lambda _: changed.set()))
    with opened(server) as stream:
        stream.sendall(framed(write_frame(CAMERA)))
        for handle, value in ((chooser, "unknown"), (chooser, 5), (slider, "x"), (slider, 99)):
            uuid = next(u for u, h in server.gui._gui_input_handle_from_uuid.items() if h is handle)
            stream.sendall(framed(write_frame({**VALUE, "uuid": uuid, "updates": {"value": value}})))
        assert changed.wait(30) and slider.value == 3 and chooser.value == "a"
    chooser.remove()
    slider.remove()
    assert capfd.readouterr().err == ""


def test_connections_are_bounded(monkeypatch):
    server = open_server(0)
    try:
        monkeypatch.setattr(connections, "MAX_CONNECTIONS", 2)
        with socket.create_connection((HOST, server.get_port())) as idle, opened(server):  # the place of a third is the idle's
            assert answer(server, f"/{server.rules.guard.token}/", upgrade=False).startswith(b"HTTP/1.1 200 ") and closes(idle)
        monkeypatch.setattr(connections, "MAX_CONNECTIONS", 0)
        with socket.create_connection((HOST, server.get_port())) as stream:
            assert closes(stream)
    finally:
        stop_server(server)


def test_only_this_machine_is_listened_to(server):
    """Every socket of this process is bound to the loopback address, and nobody gets a tunnel."""
    listening = [c.laddr for c in psutil.Process().net_connections("inet") if c.status == psutil.CONN_LISTEN]
    assert [a.ip for a in listening if a.port == server.get_port()] == [HOST]
    assert {a.ip for a in listening} == {HOST}
    assert server.request_share_url() is None
