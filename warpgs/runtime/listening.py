"""Guards of all servers: sockets that only this machine reaches, and checks of requests for a served page.

Any web page can send requests to every port of the machine that shows the page, and so can every program of every user of the
machine. So a server of warpgs binds the loopback address, answers below a random path that is new at every start, and checks
``Host`` and ``Origin`` first.
"""

from __future__ import annotations

import contextlib
import hmac
import ipaddress
import re
import secrets
import socket
import sys
import time
from collections.abc import Callable, Sequence

from warpgs.errors import ResourceError, UsageError
from warpgs.runtime.terminal import say

HOST = "127.0.0.1"
"""Address that servers listen at: only this machine reaches it."""
NAMES = (HOST, "localhost")
"""Host names that a browser may request, at any port: the port of an SSH tunnel may differ from the server's."""
TOKEN_BYTES = 24
"""Random bytes of a token: 32 letters."""
_PLAIN = re.compile(r"[A-Za-z0-9._/-]*")


def loopback_socket(port: int, fix: str, host: str = HOST) -> socket.socket:
    """Return a socket that is bound to the loopback address and does not listen yet.

    Args:
        port: Port; 0 for any free one.
        fix: What the user can do where the port is taken.
        host: 127.0.0.1 or ::1.

    Raises:
        UsageError: The port is taken, or is not a valid port.
    """
    opened = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET)
    # on Windows SO_REUSEADDR would let another program bind the same port beside us
    name = "SO_EXCLUSIVEADDRUSE" if sys.platform == "win32" else "SO_REUSEADDR"
    try:
        opened.setsockopt(socket.SOL_SOCKET, getattr(socket, name), 1)
        opened.bind((host, port))
    except (OSError, OverflowError) as e:
        opened.close()
        reason = e.strerror if isinstance(e, OSError) and e.strerror else str(e)
        raise UsageError(f"port {port} cannot be used ({reason}); {fix}") from e
    return opened


def loopback_of(name: str) -> str | None:
    """Return the loopback address of a host name or address, 127.0.0.1 rather than ::1; None for other hosts."""
    try:
        found = [str(info[4][0]) for info in socket.getaddrinfo(name, None, type=socket.SOCK_STREAM)]
    except (OSError, UnicodeError):  # the name cannot be resolved; connecting raises the error
        return None
    if not found or not all(map(is_loopback, found)):
        return None
    return min(found, key=lambda a: (":" in a, a))


def loopback_interface(host: str = HOST) -> str:
    """Return the name of the network interface that has a loopback address, such as lo.

    Raises:
        ResourceError: No interface has the address.
    """
    import psutil

    for name, addresses in psutil.net_if_addrs().items():
        if any(a.address == host for a in addresses):
            return str(name)
    raise ResourceError(f"no network interface has the address {host}; bring up the loopback interface (ip link set lo up)")


def listening_at(process: int | None = None) -> list[tuple[str, int]]:
    """Return the addresses and ports at which a process listens, sorted; none where the system denies access.

    Args:
        process: Number of the process; None for this one.
    """
    import psutil

    try:
        found = psutil.Process(process).net_connections("inet")
    except psutil.Error:  # it has ended, or belongs to another user
        return []
    return sorted({(c.laddr.ip, c.laddr.port) for c in found if c.status == psutil.CONN_LISTEN})


def listeners() -> list[tuple[str, str, int]]:
    """Return program name, address and port of every listening socket of this process and its children."""
    import psutil

    found = [("this process", *at) for at in listening_at()]
    for child in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.Error):  # it has ended
            found += [(child.name(), *at) for at in listening_at(child.pid)]
    return found


def say_what_is_open(found: Sequence[tuple[str, str, int]]) -> None:
    """Print in one line which of the found sockets other machines can reach, if any.

    Args:
        found: Program name, address and port of each listening socket.
    """
    reached = [f"{who} at {ip}, port {port}" for who, ip, port in found if not is_loopback(ip)]
    if reached:
        say(f"open to other machines, without encryption: {'; '.join(reached)}; use a network that you trust")


def is_loopback(address: str) -> bool:
    """Return whether only this machine can reach a socket's address."""
    found = ipaddress.ip_address(address.partition("%")[0])
    return (getattr(found, "ipv4_mapped", None) or found).is_loopback


class Allowance:
    """Rate limit: a number of allowed messages that grows with time up to a maximum."""

    def __init__(self, per_second: float, most: float, clock: Callable[[], float] = time.monotonic):
        """Start with the largest number of messages.

        Args:
            per_second: Messages that are added in a second.
            most: Largest number of messages at once.
            clock: Returns the time [s].
        """
        self._per_second, self._most, self._clock = per_second, most, clock
        self._left, self._last = most, clock()

    def take(self) -> bool:
        """Take one message; return False if none is left."""
        now = self._clock()
        self._left = min(self._most, self._left + self._per_second * (now - self._last))
        self._last = now
        if self._left < 1:
            return False
        self._left -= 1
        return True


class WebGuard:
    """Rules for requests to a web server of this machine: its secret path, its names, and the headers of its answers."""

    def __init__(self) -> None:
        """Choose a random token, which is valid until the process ends."""
        self.token = secrets.token_urlsafe(TOKEN_BYTES)

    def address(self, port: int) -> str:
        """Return the address to open in a browser."""
        return f"http://{HOST}:{port}/{self.token}/"

    def admitted_path(self, target: str, hosts: Sequence[str], origins: Sequence[str], upgrade: bool) -> str | None:
        """Return the requested path below the token, or None if the request must be rejected.

        Args:
            target: Target of the request line. A target with a query is rejected: a foreign link must not choose parameters of
                the page.
            hosts: Values of all headers ``Host``. There must be one, with one of `NAMES`: a foreign name that resolves to
                127.0.0.1 is rejected.
            origins: Values of all headers ``Origin``. Each must be the server's own, and a websocket must have exactly one.
            upgrade: True if a websocket is requested, which only exists at the top path.
        """
        if len(hosts) != 1 or not _is_own(hosts[0]):
            return None
        if any(origin != f"http://{hosts[0]}" for origin in origins) or (upgrade and len(origins) != 1):
            return None
        first, _, rest = target.removeprefix("/").partition("/")
        if not target.startswith("/") or not hmac.compare_digest(_bytes(first), _bytes(self.token)):
            return None
        if not _PLAIN.fullmatch(rest) or ".." in rest or (upgrade and rest):
            return None
        return f"/{rest}"

    @staticmethod
    def headers(host: str, nonce: str) -> dict[str, str]:
        """Return the headers of every answer.

        Args:
            host: Value of the request's header ``Host``; any text for a rejected request.
            nonce: Nonce of the scripts of the page; other scripts do not run.
        """
        # in Safari, 'self' covers http only; a foreign host must not get into the header
        sockets = f" ws://{host}" if _is_own(host) else ""
        policy = {
            "default-src": "'none'",
            "script-src": f"'nonce-{nonce}' 'unsafe-eval'",  # of the worker that sorts Gaussians
            "worker-src": "blob:",
            "style-src": "'unsafe-inline'",
            "img-src": "'self' data: blob:",
            "font-src": "data:",
            "connect-src": f"'self'{sockets} data: blob:",
            "base-uri": "'none'",
            "form-action": "'none'",
            "frame-ancestors": "'none'",
        }
        return {
            "Content-Security-Policy": "; ".join(f"{name} {value}" for name, value in policy.items()),
            "X-Frame-Options": "DENY",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
            "Cache-Control": "no-store",
            "Cross-Origin-Opener-Policy": "same-origin",
            "Cross-Origin-Resource-Policy": "same-origin",
        }


def _is_own(host: str) -> bool:
    """Return whether a value of ``Host`` is one of `NAMES`, with or without a port."""
    name, colon, port = host.partition(":")
    return name in NAMES and (not colon or (port.isascii() and port.isdecimal() and len(port) <= 5))


def _bytes(text: str) -> bytes:
    return text.encode("utf-8", "surrogateescape")
