"""Sockets of this machine alone, and the rules for requests to a page that is served there."""

import socket

import pytest

from warpgs import ranks
from warpgs.errors import UsageError
from warpgs.ranks import WebGuard, listeners, loopback_interface, loopback_of, loopback_socket, say_what_is_open

OWN = "127.0.0.1:8080"


def test_taken_ports_and_hosts_that_are_this_machine(monkeypatch):
    with loopback_socket(0, "give another") as taken:
        taken.listen()
        port = taken.getsockname()[1]
        assert taken.getsockname()[0] == "127.0.0.1"
        for wrong in (port, 70000):
            with pytest.raises(UsageError, match=rf"port {wrong} cannot be used .*; give another"):
                loopback_socket(wrong, "give another")
    assert loopback_of("127.0.0.1") == "127.0.0.1" and loopback_of("::1") == "::1" and loopback_of("192.0.2.1") is None
    known = {"both": ["::1", "127.0.0.1"], "mixed": ["127.0.0.1", "192.0.2.1"], "far": ["192.0.2.1"]}

    def found(name, *_, **__):
        if name not in known:
            raise socket.gaierror(-2, "not known")
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (address, 0)) for address in known[name]]

    monkeypatch.setattr(ranks.socket, "getaddrinfo", found)
    assert [loopback_of(name) for name in (*known, "none")] == ["127.0.0.1", None, None, None]
    assert loopback_interface()


def test_a_request_needs_the_token_and_our_names():
    """A page may lack an origin, a websocket never; queries, other paths and other hosts are refused."""
    guard = WebGuard()
    token = guard.token
    assert guard.address(8080) == f"http://{OWN}/{token}/" and len(token) >= 32 and token != WebGuard().token
    own, tunnel = f"http://{OWN}", "http://localhost:9000"
    for target, host, origins, upgrade, path in (
        (f"/{token}/", OWN, [], False, "/"),
        (f"/{token}", OWN, [own], False, "/"),
        (f"/{token}/index.html", "localhost:9000", [tunnel], False, "/index.html"),
        (f"/{token}", OWN, [own], True, "/"),
        (f"/{token}", "localhost:9000", [tunnel], True, "/"),
        (f"/{token}", "localhost", ["http://localhost"], True, "/"),
    ):
        assert guard.admitted_path(target, [host], origins, upgrade) == path, target
    refused = [
        ("/", [OWN], []), ("", [OWN], []), (token, [OWN], []), (f"//{token}/", [OWN], []), (f"/{token[:-1]}/", [OWN], []),
        (f"/{token}x/", [OWN], []), (f"/{token}/?websocket=ws://example.org", [OWN], []), (f"/{token}?", [OWN], []),
        (f"/?{token}", [OWN], []), (f"/{token}/../x", [OWN], []), (f"/{token}/%2e%2e/x", [OWN], []),
        (f"/{token}/a\\b", [OWN], []),
        (f"http://{OWN}/{token}/", [OWN], []), (f"/{token}/", [], []), (f"/{token}/", [OWN, OWN], []),
        (f"/{token}/", ["example.org"], []), (f"/{token}/", ["127.0.0.1.example.org"], []), (f"/{token}/", ["[::1]:8080"], []),
        (f"/{token}/", [f"user@{OWN}"], []), (f"/{token}/", ["127.0.0.1:80;x"], []), (f"/{token}/", [""], []),
        (f"/{token}/", [OWN], ["null"]), (f"/{token}/", [OWN], ["http://example.org"]), (f"/{token}/", [OWN], [own, "http://a"]),
        ("/\udcff", [OWN], []),
    ]  # fmt: skip
    for target, hosts, origins in refused:
        for upgrade in (False, True):
            assert guard.admitted_path(target, hosts, origins or [own] * upgrade, upgrade) is None, (target, hosts, origins)
    for origins in ([], [own, own], [tunnel], [f"https://{OWN}"], ["null"]):
        assert guard.admitted_path(f"/{token}", [OWN], origins, True) is None
    assert guard.admitted_path(f"/{token}/index.html", [OWN], [own], True) is None


def test_what_others_can_reach_is_printed(capsys):
    """All of it in one line, but for sockets of the loopback address; and what listens in this process is found."""
    opened = [("rank 0", "127.0.0.1", 1), ("rank 0", "192.0.2.1", 2), ("gloo", "::ffff:127.0.0.1", 3), ("torchrun", "::", 4)]
    say_what_is_open(opened)
    line = "open to other machines, without encryption: rank 0 at 192.0.2.1, port 2; torchrun at ::, port 4; "
    assert capsys.readouterr().out.startswith(line)
    say_what_is_open(opened[::2])
    assert capsys.readouterr().out == ""
    with loopback_socket(0, "") as own:
        own.listen()
        assert ("this process", *own.getsockname()) in listeners()
    # a host that is not ours does not come into a header
    policy = WebGuard.headers(OWN, "word")["Content-Security-Policy"]
    assert "connect-src 'self' ws://127.0.0.1:8080 data: blob:" in policy and "frame-ancestors 'none'" in policy
    assert "default-src 'none'" in policy and "script-src 'nonce-word' " in policy
    assert "script-src 'unsafe-inline'" not in policy
    assert "ws:" not in WebGuard.headers("example.org; script-src *", "word")["Content-Security-Policy"]
