"""The viewer's server: viser's server without tunnels, open only to this machine and only at its full address."""

from __future__ import annotations

import contextlib
import io
import socket
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

from warpgs.errors import ResourceError
from warpgs.runtime.listening import HOST, loopback_socket
from warpgs.suggestion import install_extras
from warpgs.viewer.connections import Rules, guarded_server

if TYPE_CHECKING:
    import viser

PORT = 8080
"""Default port."""
REMEDY = install_extras("view")
OTHER_PORT = "choose another port with --port (fit: --view-port), or 0 for any free one"


def require_viser() -> None:
    """Check that viser is installed.

    Raises:
        ResourceError: viser is not installed; the message names the package.
    """
    try:
        version("viser")
    except PackageNotFoundError:
        raise ResourceError(f"the viewer and scene.html need viser, which is not installed; {REMEDY}") from None


def _refuses_others(port: int) -> bool:
    """Return whether the server answers 403 to a request without the token."""
    request = f"GET / HTTP/1.1\r\nHost: {HOST}:{port}\r\n\r\n"
    with socket.create_connection((HOST, port), timeout=10) as stream:
        stream.sendall(request.encode())
        return stream.recv(64).startswith(b"HTTP/1.1 403 ")


def _control_of(server: viser.ViserServer, uuid: str) -> Any:
    """Return the shared control with an identifier; None for buttons of a single browser."""
    return server.gui._gui_input_handle_from_uuid.get(uuid)  # viser has no public way to it


def open_server(port: int = PORT, label: str = "warpgs") -> viser.ViserServer:
    """Start a server that only this machine reaches, at an address with a secret (`address`); ``server.stop()`` ends it.

    Args:
        port: Port to listen at; 0 for any free one.
        label: Title of the panel.

    Raises:
        ResourceError: viser is not installed, or its version offers no way to check requests.
        UsageError: The port is taken or invalid.
    """
    require_viser()
    import viser

    class LocalServer(viser.ViserServer):
        rules: Rules

        def request_share_url(self, verbose: bool = True) -> None:
            """Refuse to open a tunnel to the internet."""

    rules, bound = Rules(), loopback_socket(port, OTHER_PORT)
    port = bound.getsockname()[1]
    # viser would print its address; the command prints it instead
    with guarded_server(rules, bound, f"viser-v{viser.__version__}"), contextlib.redirect_stdout(io.StringIO()):
        server = LocalServer(host=HOST, port=port, label=label, verbose=False)
    server.rules = rules
    if server.get_port() != port or not _refuses_others(port) or not hasattr(server.gui, "_gui_input_handle_from_uuid"):
        stop_server(server)
        why = "because requests to its server cannot be checked"
        raise ResourceError(f"viser {viser.__version__} is not supported, {why}; {REMEDY}")
    rules.control_of = lambda uuid: _control_of(server, uuid)
    server.gui.configure_theme(show_share_button=False, show_logo=False, dark_mode=True, control_width="medium")
    return server


def address(server: viser.ViserServer) -> str:
    """Return the address to open in a browser, with the secret that grants access."""
    return str(server.rules.guard.address(server.get_port()))


def stop_server(server: viser.ViserServer) -> None:
    """Stop a server without the line that viser prints."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()
