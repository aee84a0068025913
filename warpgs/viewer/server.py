"""The viewer's server: viser's, bound to this machine alone, without tunnels, and closed to pages of other sites."""

from __future__ import annotations

import contextlib
import functools
import io
import socket
import threading
from collections.abc import Callable, Iterator
from http import HTTPStatus
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from warpgs.errors import ResourceError, UsageError, WarpgsError

if TYPE_CHECKING:
    import viser

HOST = "127.0.0.1"
"""Address that the server listens at: nobody but this machine reaches it."""
PORT = 8080
"""Port where none is asked for."""
OWN_NAMES = (HOST, "localhost")
"""Names under which a browser may ask for the server, at any port: that of an SSH tunnel may differ from ours."""
REMEDY = 'install the extra: pip install "warpgs[view]"'
_HOOK = threading.Lock()


def require_viser() -> None:
    """Check that viser is there.

    Raises:
        ResourceError: It is not; the message says what to install.
    """
    try:
        version("viser")
    except PackageNotFoundError:
        raise ResourceError(f"the viewer and scene.html need viser, which is not installed; {REMEDY}") from None


def is_foreign(host: str | None, origins: list[str]) -> bool:
    """Return whether a request comes from another site, or asks under a name that is not this machine's.

    A page of another site can send requests to any port of the machine that its reader sits at, and a browser then names that
    site in ``Origin``. A site whose name resolves to 127.0.0.1 is told by ``Host``.

    Args:
        host: Value of the header ``Host``; None where there is none.
        origins: Values of all headers ``Origin``; a browser sends none with the address that a person typed.
    """
    try:
        if host is None or urlsplit(f"//{host}").hostname not in OWN_NAMES:
            return True
    except ValueError:
        return True
    return any(origin != f"http://{host}" for origin in origins)


@contextlib.contextmanager
def _guarded() -> Iterator[None]:
    """Have every server that websockets starts in the body refuse foreign requests before anything else looks at them.

    viser takes no such check of its own, so the function that it starts its server with is replaced while it starts.
    """
    import websockets.asyncio.server as module

    def guard(inner: Callable[..., Any] | None, connection: Any, request: Any) -> Any:
        hosts = request.headers.get_all("Host")
        if is_foreign(hosts[0] if len(hosts) == 1 else None, request.headers.get_all("Origin")):
            return connection.respond(HTTPStatus.FORBIDDEN, "This page is for the machine that serves it.\n")
        return None if inner is None else inner(connection, request)

    with _HOOK:
        serve = module.serve

        def guarded(*args: Any, process_request: Any = None, **named: Any) -> Any:
            return serve(*args, process_request=functools.partial(guard, process_request), **named)

        module.serve = guarded  # type: ignore[misc, assignment]
        try:
            yield
        finally:
            module.serve = serve  # type: ignore[misc]


def _check_free(port: int) -> None:
    """Raise a UsageError where a port cannot be listened at: viser would take the next one without a word."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except (OSError, OverflowError) as e:
            reason = e.strerror if isinstance(e, OSError) and e.strerror else str(e)
            raise UsageError(
                f"port {port} cannot be used ({reason}); give another with --port (fit: --view-port), or 0 for any free one"
            ) from e


def _refuses_others(port: int) -> bool:
    """Return whether the server answers 403 to a page of another site, asked as a browser would ask."""
    lines = [
        "GET / HTTP/1.1", f"Host: {HOST}:{port}", "Origin: http://example.org", "Upgrade: websocket", "Connection: Upgrade",
        "Sec-WebSocket-Version: 13", "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==", "", "",
    ]  # fmt: skip
    with socket.create_connection((HOST, port), timeout=10) as stream:
        stream.sendall("\r\n".join(lines).encode())
        return stream.recv(64).startswith(b"HTTP/1.1 403 ")


def open_server(port: int = PORT, label: str = "warpgs") -> viser.ViserServer:
    """Start a server that only this machine reaches, and only from its own page; ``server.stop()`` ends it.

    Args:
        port: Port to listen at; 0 for any free one.
        label: Title of the panel.

    Raises:
        ResourceError: viser is not installed, or its version does not let requests be checked.
        UsageError: The port is taken, or no port.
    """
    require_viser()
    _check_free(port)
    import viser

    class LocalServer(viser.ViserServer):
        def request_share_url(self, verbose: bool = True) -> None:
            """Refuse to open a tunnel to the world, whoever asks."""

    with _guarded(), contextlib.redirect_stdout(io.StringIO()):  # it prints its address; the command says it in our words
        server = LocalServer(host=HOST, port=port, label=label, verbose=False)
    failure: WarpgsError | None = None
    if port not in (0, server.get_port()):
        failure = UsageError(
            f"port {port} was taken by another program; give another with --port (fit: --view-port), or 0 for any free one"
        )
    elif not _refuses_others(server.get_port()):
        failure = ResourceError(f"viser {viser.__version__} does not let requests be checked, so it is not used; {REMEDY}")
    if failure is not None:
        stop_server(server)
        raise failure
    server.gui.configure_theme(show_share_button=False, show_logo=False, dark_mode=True, control_width="medium")
    return server


def stop_server(server: viser.ViserServer) -> None:
    """Stop a server without the line that viser prints."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()
