"""Connections of browsers to the viewer: which may connect, how much they may send, and how wrong messages are handled."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import logging
import secrets
import socket
import threading
from collections.abc import Callable, Iterator
from http import HTTPStatus
from typing import Any

from warpgs.errors import DataError
from warpgs.runtime.listening import Allowance, WebGuard
from warpgs.runtime.terminal import say
from warpgs.viewer.callbacks import said
from warpgs.viewer.frames import MAX_FRAME, control_value, read_frame, write_frame
from warpgs.viewer.page import live_page

MAX_BROWSERS = 16
"""Largest number of websockets at a time."""
MAX_CONNECTIONS = 64
"""Largest number of connections at a time, including connections that have sent no request yet."""
MESSAGES_PER_SECOND = 200.0
"""Rate of messages of one browser; moving a camera sends 50 a second."""
MAX_BURST = 2000.0
"""Largest number of messages at once: a delayed page sends a burst."""
REFUSED = "Open the address that the viewer printed.\n"
_HOOK = threading.Lock()


class Rules:
    """Rules for connections and messages, and the open connections."""

    def __init__(self) -> None:
        """Begin without controls."""
        self.guard = WebGuard()
        self.control_of: Callable[[str], Any] = lambda uuid: None
        """Function that returns a control by its identifier in messages."""
        self.connected: set[Any] = set()
        """Connections of all kinds."""
        self.browsers: set[Any] = set()
        """Websockets."""

    def checked(self, frame: bytes | str) -> bytes | None:
        """Return a frame as viser may read it, or None for a value that its control cannot have.

        Raises:
            DataError: The frame is malformed.
        """
        message = read_frame(frame)
        if message["type"] == "GuiUpdateMessage":
            try:
                value = control_value(message["updates"]["value"], self.control_of(message["uuid"]))
            except DataError:  # empty for a moment while the user types
                return None
            message["updates"] = {"value": value}
        return write_frame(message)

    def answer(self, inner: Callable[..., Any] | None, protocol: str, connection: Any, request: Any) -> Any:
        """Return the answer to a request; None if its websocket may be opened.

        Args:
            inner: viser's own function, which returns files.
            protocol: Name of the protocol that a websocket must speak.
            connection: The connection.
            request: The request, as websockets passes it.
        """
        from websockets.datastructures import Headers

        headers = request.headers
        upgrade = "Upgrade" in headers
        path = self.guard.admitted_path(request.path, headers.get_all("Host"), headers.get_all("Origin"), upgrade)
        if path is None or (upgrade and headers.get_all("Sec-WebSocket-Protocol") != [protocol]):
            return connection.respond(HTTPStatus.FORBIDDEN, REFUSED)
        if upgrade:
            if len(self.browsers) >= MAX_BROWSERS:
                return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, "Too many browsers.\n")
            self.browsers.add(connection)
            return None
        if inner is None:
            return connection.respond(HTTPStatus.NOT_FOUND, REFUSED)
        response = inner(connection, dataclasses.replace(request, path=path, headers=Headers()))  # no compression
        if response.headers.get("Content-Type", "").startswith("text/html"):
            response.body = live_page(response.body.decode("utf-8"), connection.nonce).encode()
            del response.headers["Content-Length"]
            response.headers["Content-Length"] = str(len(response.body))
        return response

    def add_headers(self, connection: Any, request: Any, response: Any) -> None:
        """Add the headers of every answer."""
        hosts = request.headers.get_all("Host")
        for name, value in self.guard.headers(hosts[0] if hosts else "", connection.nonce).items():
            response.headers[name] = value


def connection_class(rules: Rules) -> type:
    """Return the class of connections that follow rules."""
    from websockets.asyncio.server import ServerConnection

    class Connection(ServerConnection):
        """A connection that checks messages before viser reads them."""

        def __init__(self, *args: Any, **named: Any):
            super().__init__(*args, **named)
            self.nonce = secrets.token_urlsafe(16)
            self.refused = False
            self.allowance = Allowance(MESSAGES_PER_SECOND, MAX_BURST)

        def connection_made(self, transport: Any) -> None:
            super().connection_made(transport)
            rules.connected.add(self)
            if len(rules.connected) > MAX_CONNECTIONS:
                transport.abort()

        def connection_lost(self, exc: Exception | None) -> None:
            rules.connected.discard(self)
            rules.browsers.discard(self)
            super().connection_lost(exc)

        async def recv(self, *args: Any, **named: Any) -> bytes:
            """Return the next message that viser may read; a malformed one closes the connection."""
            while True:
                frame = await super().recv(*args, **named)
                if self.refused:  # messages from before the connection ended, too
                    continue
                try:
                    if not self.allowance.take():
                        raise DataError(f"more than {MESSAGES_PER_SECOND:.0f} messages a second")
                    checked = rules.checked(frame)
                except DataError as e:
                    self.refused = True
                    say(f"the viewer closed the connection of a browser: {e}", error=True)
                    self.transport.abort()  # a client that sends such a message may ignore a normal close
                    continue
                if checked is not None:
                    return checked

    return Connection


def _silent() -> logging.Logger:
    """Return a logger that writes nothing: websockets would print tracebacks of invalid requests."""
    logger = logging.Logger("warpgs.viewer", logging.CRITICAL + 1)
    logger.addHandler(logging.NullHandler())
    return logger


def _failed(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Print an error of viser's own in one line."""
    error = context.get("exception")
    say(f"the viewer ignored a message ({said(error) if error else context.get('message')})", error=True)


@contextlib.contextmanager
def guarded_server(rules: Rules, bound: socket.socket, protocol: str) -> Iterator[None]:
    """Make the server that viser starts in the block follow rules, and listen at the socket ``bound``.

    viser has no option for such checks, so the function that starts its server is replaced in the block.

    Args:
        rules: The rules.
        bound: The socket.
        protocol: Name of the protocol that a websocket must speak.
    """
    import websockets.asyncio.server as module

    with _HOOK:
        serve = module.serve

        def guarded(handler: Any, *_: Any, process_request: Any = None, **named: Any) -> Any:
            async def handle(connection: Any) -> None:
                try:
                    await handler(connection)
                except Exception as e:
                    say(f"the viewer closed the connection of a browser ({said(e)})", error=True)

            asyncio.get_running_loop().set_exception_handler(_failed)
            limits = {"max_size": MAX_FRAME, "server_header": None, "logger": _silent()}
            return serve(
                handle, sock=bound, create_connection=connection_class(rules), process_response=rules.add_headers,
                process_request=lambda connection, request: rules.answer(process_request, protocol, connection, request),
                **{**named, **limits},
            )  # fmt: skip

        module.serve = guarded  # type: ignore[misc, assignment]
        try:
            yield
        finally:
            module.serve = serve  # type: ignore[misc]
