"""The viewer's web server: viser on loopback, with a check of who asks before anything is answered.

viser answers everybody: a page of any other site that is open in the same browser could move the tool, and every client
could have a public tunnel opened to this computer. Here each request and each websocket handshake must name this server
(`Host`, against DNS rebinding), come from its own page (`Origin`) and show its token, where it has one; nothing is
shared, and nothing is printed.

This touches private parts of viser. They are those of one version, `VISER_VERSION`; with another nothing is served.
"""

from __future__ import annotations

import asyncio
import errno
import ipaddress
import logging
import os
import platform
import re
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from http import HTTPStatus
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlencode

import rich
import viser
import websockets
import websockets.asyncio.server
from websockets.exceptions import WebSocketException

from scenes.viewer.page_token import REFUSAL, admits, cookie
from scenes.viewer.shell import LARGEST_UPLOAD, dress
from tissue_sim.errors import InputError, MissingBackendError

VISER_VERSION = "1.1.1"
LOOPBACK, PORT = "127.0.0.1", 8080
_LOCAL_NAMES = frozenset({"localhost", "127.0.0.1", "::1"})
_START_S = 10.0
#: Bytes of a part of an upload of viser's page; only the last is smaller.
_PART = 512 * 1024
_HTTP_PORT = 80
_PLACE = re.compile(r"(?P<name>\[[0-9a-f:.]+\]|[a-z0-9._-]+)(?::(?P<port>[1-9][0-9]{0,4}))?", re.ASCII | re.IGNORECASE)
#: What is put in place of module state while a server starts or stops is one server's at a time.
_alone = threading.RLock()


def open_server(host: str = LOOPBACK, port: int = PORT, *, exposed: bool = False,
                title: str = "tissue_sim", token: str = "") -> ViewerServer:
    """A viser server that answers its own page only; it listens when this returns.

    Args:
        host: address of the network interface; one that other computers reach needs `exposed`.
        port: 1 to 65535, or 0 for any free one (`get_port()` says which).
        title: of the browser's tab and of the panel.
        token: that a visitor must show; empty: none.

    Raises:
        InputError: `host` is no address of this computer or is reached by others without `exposed`; the port is taken.
        MissingBackendError: this version of viser is not the one whose private parts are known here.
    """
    host = LOOPBACK if host == "localhost" else host
    if not _is_loopback(host) and not exposed:
        raise InputError(f"{exposure(host, port)}; say --expose if that is meant, or leave --host out for {LOOPBACK}",
                         field="host")
    if not 0 <= port <= 65535:
        raise InputError(f"{port} is not a port; give 1 to 65535, or 0 for any free one", field="port")
    _require_known_viser()
    return ViewerServer(host, port, title, token)


def exposure(host: str, port: int) -> str:
    """What it means to serve on `host`, in one sentence without a full stop.

    Raises:
        InputError: `host` is not an address.
    """
    if _is_loopback(host):
        return f"{host} is reached by programs of this computer only"
    who = "any address of this computer" if ipaddress.ip_address(host).is_unspecified else host
    where = f"port {port}" if port else "the port that is chosen"
    return (f"anybody who reaches {who} at {where} can watch, move the tool, change the material, and read and "
            "save recordings and materials, without a password")


class ViewerServer(viser.ViserServer):
    """A running server; use `open_server`. It is a context manager, and `stop` may be called twice."""

    def __init__(self, host: str, port: int, title: str, token: str):
        self._token, door = token, _Door(host, port, title, token)
        with _silence(), door.instead_of_serve():
            super().__init__(host=host, port=port, label=title, verbose=False)
        try:
            if door.failure is not None:
                raise door.failure
            self._unregister_sharing()
            self._bound_uploads()
            self.set_theme()
            # Nobody waits for it yet.
            self._websock_server.get_message_buffer().message_event = _WakeUp()
            door.listen()
        except OSError as error:
            self.stop()
            raise _unusable(host, port, error) from None
        except BaseException:
            self.stop()
            raise

    @property
    def url(self) -> str:
        """Address of the server, for a browser on this computer."""
        host = self.get_host()
        if ipaddress.ip_address(host).is_unspecified:
            host = LOOPBACK if ":" not in host else "::1"
        return f"http://{f'[{host}]' if ':' in host else host}:{self.get_port()}"

    def address(self, **query: str) -> str:
        """Address of the page with its token, and with what else the page is asked."""
        asked = urlencode(({"token": self._token} if self._token else {}) | query)
        return f"{self.url}/?{asked}" if asked else self.url

    def set_theme(self, **theme: Any) -> None:
        """`configure_theme` of viser, always without a logo and a share button."""
        self.gui.configure_theme(**theme, show_logo=False, show_share_button=False)

    def stop(self) -> None:
        """Close the port and all connections."""
        with _silence():
            super().stop()

    def __enter__(self) -> ViewerServer:
        return self

    def __exit__(self, *_) -> None:
        self.stop()

    def _unregister_sharing(self) -> None:
        for message in (viser._messages.ShareUrlRequest, viser._messages.ShareUrlDisconnect):
            if message not in self._websock_server._incoming_handlers:
                raise _unknown_viser(f"it has no handler of {message.__name__} to take away")
            self._websock_server.unregister_handler(message)


    def _bound_uploads(self) -> None:
        """Keep nothing of files above `LARGEST_UPLOAD`, which the page does not send: viser would keep all of it."""
        messages = viser._messages

        def only(kind: type, fits: Callable[[Any], bool]) -> None:
            handlers = self._websock_server._incoming_handlers.get(kind, [])
            if len(handlers) != 1:
                raise _unknown_viser("it does not take uploads in the way that it is known for")
            take = handlers[0]
            handlers[0] = lambda client, message: take(client, message) if fits(message) else None

        only(messages.FileTransferStartUpload, lambda start: start.size_bytes <= LARGEST_UPLOAD
             and start.part_count <= LARGEST_UPLOAD // _PART + 1)
        only(messages.FileTransferPart, lambda part: len(part.content) <= _PART)


class _WakeUp(asyncio.Event):
    """What browsers' tasks wait for when there is nothing to send.

    viser sets it in the thread that has something to say, and once more in the loop. Python's event would go through
    the tasks that wait while others begin to, "deque mutated during iteration", which ended that thread.
    """

    def set(self) -> None:
        """From any thread; tasks are woken in the loop only."""
        try:
            asyncio.get_running_loop()
        except RuntimeError:
            self._value = True
            return
        # Set already by the other thread, it would wake nobody.
        self._value = False
        super().set()


class _Door:
    """Takes the place of `websockets.asyncio.server.serve` while viser starts: binds, and listens only when told."""

    def __init__(self, host: str, port: int, title: str, token: str):
        self.host, self.port, self.title, self._token = host, port, title, token
        self.failure: Exception | None = _unknown_viser("it does not start the websocket server that it is known for")
        self._server: Any = None

    @contextmanager
    def instead_of_serve(self) -> Iterator[None]:
        """viser's view of websockets, and no other module's, has this door for the time."""
        infra: Any = viser.infra._infra
        view = SimpleNamespace(**vars(websockets))
        view.asyncio = SimpleNamespace(server=SimpleNamespace(
            serve=self.serve, ServerConnection=websockets.asyncio.server.ServerConnection))
        with _alone:
            usual, infra.websockets = infra.websockets, view
            try:
                yield
            finally:
                infra.websockets = usual

    @asynccontextmanager
    async def serve(self, handler: Callable, *_address: Any, process_request: Callable | None = None, **options: Any):
        """What viser enters in its thread: the server, or a stand-in where there is none.

        After an OSError viser would try the next port, and after any other its constructor would wait for ever.
        """
        try:
            if process_request is None:
                raise _unknown_viser("it has no answer to HTTP requests before which a check could stand")
            options.update(logger=_logger, start_serving=False)
            self._server = await websockets.asyncio.server.serve(
                _of_this_version(handler), self.host, self.port,
                process_request=self._checked(process_request), **options)
        except Exception as error:
            self.failure = error
            yield SimpleNamespace(server=SimpleNamespace(sockets=()))
            return
        self.port = self._server.sockets[0].getsockname()[1]
        self.failure = None
        try:
            yield self._server
        finally:
            self._server.close()
            await self._server.wait_closed()

    def listen(self) -> None:
        """Listen. Raises OSError where another program has come to listen there in the meantime."""
        loop = self._server.get_loop()
        asyncio.run_coroutine_threadsafe(self._server.start_serving(), loop).result(_START_S)

    def _checked(self, answer: Callable) -> Callable:
        def process_request(connection, request):
            allowed = self._allowed_names(connection)
            refusal = refuse(request.headers.get_all("Host"), request.headers.get_all("Origin"), allowed, self.port)
            if refusal:
                return connection.respond(HTTPStatus.FORBIDDEN, refusal + "\n")
            if self._token and not admits(self._token, self.port, request.path, request.headers.get_all("Cookie")):
                return connection.respond(HTTPStatus.FORBIDDEN, REFUSAL + "\n")
            _drop(request.headers, "Accept-Encoding")  # the title is written into the page below
            response = answer(connection, request)
            if response is not None:
                self._finish(response, request.headers["Host"])
            return response

        return process_request

    def _allowed_names(self, connection) -> frozenset[str]:
        if _is_loopback(self.host):
            return _LOCAL_NAMES | {_normal(self.host)}
        name = platform.node().lower()
        reached = _normal(str(connection.local_address[0]))
        return _LOCAL_NAMES | {_normal(self.host), reached, name, f"{name.removesuffix('.local')}.local"} - {""}

    def _finish(self, response, place: str) -> None:
        """No other page may frame this one and catch its clicks, and this one fetches nothing from elsewhere."""
        response.body = dress(response.body, self.title)
        if self._token:
            response.headers["Set-Cookie"] = cookie(self._token, self.port)
        _drop(response.headers, "Content-Length")
        response.headers.update({
            "Content-Length": str(len(response.body)),
            "X-Frame-Options": "DENY",
            "Content-Security-Policy": "default-src 'self' 'unsafe-inline' 'unsafe-eval' blob: data:; "
                                       f"connect-src 'self' ws://{place} blob: data:; frame-ancestors 'none'; "
                                       "object-src 'none'; base-uri 'none'; form-action 'none'"})


def refuse(hosts: list[str], origins: list[str], allowed: frozenset[str], port: int) -> str | None:
    """Why a request is not answered, in one sentence; None: it is.

    A browser writes `Host` from the address of the page and `Origin` from the page that asks, and no page can change
    them. A request without an origin is the visit of the page itself, or of a program, which could write anything.

    Args:
        hosts, origins: values of all headers of that name.
        allowed: names of this server, lower case, without brackets and final dot.
        port: of this server.
    """
    host = _place(hosts[0]) if len(hosts) == 1 else None
    if host is None or host[0] not in allowed or host[1] != port:
        return f"This server answers to http://localhost:{port} and its own addresses only."
    if not origins:
        return None
    scheme, _, place = origins[0].partition("://")
    if len(origins) > 1 or scheme.lower() != "http" or _place(place) != host:
        return "This server answers its own page only, not a page of another site."
    return None


def _place(text: str) -> tuple[str, int] | None:
    """Normal name and port of ``name:port``; None where it is not one."""
    match = _PLACE.fullmatch(text)
    return (_normal(match["name"].strip("[]")), int(match["port"] or _HTTP_PORT)) if match else None


def _normal(name: str) -> str:
    name = name.lower().removesuffix(".")
    try:
        address = ipaddress.ip_address(name)
    except ValueError:
        return name
    return str(getattr(address, "ipv4_mapped", None) or address)


def _drop(headers, name: str) -> None:
    if name in headers:
        del headers[name]


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        raise InputError(f"{host!r} is not an address; give one such as {LOOPBACK}", field="host") from None


def _of_this_version(handler: Callable) -> Callable:
    """The handler, after a check that viser makes too, but prints."""

    async def handle(connection) -> None:
        if connection.subprotocol == f"viser-v{VISER_VERSION}":
            await handler(connection)
        else:
            version = (connection.subprotocol or "viser-vunknown").removeprefix("viser-v")
            await connection.close(1002, f"Version mismatch. Client: {version}, Server: {VISER_VERSION}")

    return handle


def _require_known_viser() -> None:
    if viser.__version__ != VISER_VERSION:
        raise _unknown_viser(f"this is {viser.__version__}")


def _unknown_viser(what: str) -> MissingBackendError:
    return MissingBackendError(f"the viewer keeps other sites out with private parts of viser {VISER_VERSION}, and "
                               f"{what}; python -m pip install viser=={VISER_VERSION}")


def _unusable(host: str, port: int, error: OSError) -> InputError:
    remedy = "give another with --port, or 0 for any free one"
    if error.errno == errno.EADDRINUSE:
        return InputError(f"port {port} of {host} is taken by another program; close that, or {remedy}", field="port")
    if error.errno == errno.EACCES:
        return InputError(f"port {port} needs rights that this user lacks; {remedy}", field="port")
    why = os.strerror(error.errno) if error.errno else str(error)
    return InputError(f"{host}, port {port} cannot be used ({why}); give an address of this computer with --host, or "
                      f"leave it out for {LOOPBACK}", field="host")


@contextmanager
def _silence() -> Iterator[None]:
    """viser prints where it listens and that it stopped, through rich's own console, which is nobody else's here."""
    console = rich.get_console()
    with _alone:
        before, console.quiet = console.quiet, True
        try:
            yield
        finally:
            console.quiet = before


def _is_news(record: logging.LogRecord) -> bool:
    """Not: somebody knocked and left, or spoke something else than HTTP."""
    error = record.exc_info[1] if record.exc_info else None
    # What comes while a request is answered, and is none, breaks an assertion of websockets' own.
    return not (isinstance(error, WebSocketException | OSError | EOFError)
                or (isinstance(error, AssertionError) and _raised_in(error).startswith("websockets.")))


def _raised_in(error: BaseException) -> str:
    """The module."""
    *_, (frame, _) = traceback.walk_tb(error.__traceback__)
    return str(frame.f_globals.get("__name__", ""))


_logger = logging.getLogger(__name__)
_logger.addFilter(_is_news)
