"""The viewer's server: this machine alone, no tunnels, and no pages of other sites."""

import socket

import psutil
import pytest

from warpgs.errors import UsageError
from warpgs.viewer.server import HOST, is_foreign, open_server, stop_server

pytest.importorskip("viser")


@pytest.fixture(scope="module")
def server():
    """A server at a free port."""
    opened = open_server(0)
    yield opened
    stop_server(opened)


def answer(port: int, *headers: str, upgrade: bool = True) -> str:
    """First line of the answer to a request with these headers: a websocket's handshake, or for a page."""
    lines = ["GET / HTTP/1.1", *headers]
    if upgrade:
        lines += ["Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13"]
        lines += ["Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==", "Sec-WebSocket-Protocol: viser-v1.1.1"]
    with socket.create_connection((HOST, port), timeout=10) as stream:
        stream.sendall("\r\n".join([*lines, "", ""]).encode())
        return stream.recv(4096).decode("latin-1").splitlines()[0]


@pytest.mark.parametrize("upgrade", [True, False])
def test_other_sites_are_refused(server, upgrade):
    """By their origin, by the name that they reach this machine under, and where they leave it out; own pages are served."""
    port = server.get_port()
    served = "101" if upgrade else "200"
    own = [f"Host: {HOST}:{port}", f"Origin: http://{HOST}:{port}"]
    assert served in answer(port, *own, upgrade=upgrade)
    assert served in answer(port, "Host: localhost:9000", "Origin: http://localhost:9000", upgrade=upgrade)  # by a tunnel
    assert served in answer(port, own[0], upgrade=upgrade)
    refused = [
        (own[0], "Origin: http://example.org"), (own[0], "Origin: null"), (own[0], f"Origin: https://{HOST}:{port}"),
        (own[0], f"Origin: http://localhost:{port}"), (own[0], own[1], "Origin: http://example.org"),
        (f"Host: example.org:{port}", f"Origin: http://example.org:{port}"), (f"Host: {HOST}.example.org",),
    ]  # fmt: skip
    for headers in refused:
        assert "403" in answer(port, *headers, upgrade=upgrade), headers


def test_only_this_machine_is_listened_to(server):
    """The socket is bound to 127.0.0.1, and nobody gets a tunnel."""
    listening = [c.laddr for c in psutil.Process().net_connections("tcp") if c.status == psutil.CONN_LISTEN]
    assert [a.ip for a in listening if a.port == server.get_port()] == [HOST]
    assert server.request_share_url() is None


def test_a_taken_port_is_one_sentence(server):
    """viser would take the next port without a word."""
    with pytest.raises(UsageError, match=r"port \d+ cannot be used .*--port"):
        open_server(server.get_port())


def test_headers_that_are_no_host():
    """Nothing in them raises."""
    assert is_foreign(None, []) and is_foreign("[", []) and is_foreign("", []) and not is_foreign("localhost", [])
