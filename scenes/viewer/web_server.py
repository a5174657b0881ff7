"""Web server of the viewer: viser on the loopback interface, with access checks before each answer.

viser itself answers every request: a page of another site in the same browser could move the tool, and every client
could open a public tunnel to this computer. This server requires that each HTTP request and each websocket handshake
names this server (`Host`, against DNS rebinding), comes from its own page (`Origin`), and contains its token if it has
one. Sharing and printing of viser are switched off.

Only browsers that know the printed address may open a page with a token, as with Jupyter. The address transmits the
token once. Afterwards, a cookie transmits it; pages of other sites cannot send this cookie (SameSite=Strict), and
scripts cannot read it (HttpOnly).

The checks use private parts of viser, so the server starts only with the version `VISER_VERSION`.
"""

from __future__ import annotations

import asyncio
import errno
import hmac
import ipaddress
import logging
import os
import platform
import re
import secrets
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from types import SimpleNamespace
from typing import Any
from urllib.parse import parse_qs, urlencode, urlsplit

import rich
import viser
import websockets
import websockets.asyncio.server
from websockets.exceptions import WebSocketException

from scenes.viewer.shell import LARGEST_UPLOAD, insert_page_additions
from tissue_sim.errors import InputError, MissingBackendError

#: Answer to a request without a valid token.
REFUSAL = ("The token is missing or wrong. Open this page with the complete address that was printed when the page was "
           "started.")


def make_access_token() -> str:
    """Return a random token of 192 bits."""
    return secrets.token_urlsafe(24)


def has_valid_token(token: str, port: int, path: str, cookies: Sequence[str]) -> bool:
    """Return whether a request contains the token, in its query or in a cookie.

    Args:
        token: Token of the page.
        port: Port of the server, which is part of the cookie's name because all ports of a computer share cookies.
        path: Path of the request with its query.
        cookies: Values of all ``Cookie`` headers.
    """
    try:
        given = parse_qs(urlsplit(path).query).get("token", [])
        for each in cookies:
            if (morsel := SimpleCookie(each).get(_make_cookie_name(port))) is not None:
                given.append(morsel.value)
    except (ValueError, CookieError):
        return False
    return any(hmac.compare_digest(candidate.encode(), token.encode()) for candidate in given)


def make_cookie_header(token: str, port: int) -> str:
    """Return the ``Set-Cookie`` header that stores the token until the browser is closed."""
    return f"{_make_cookie_name(port)}={token}; Path=/; HttpOnly; SameSite=Strict"


def _make_cookie_name(port: int) -> str:
    return f"tissue_sim_{port}"


#: Port of an address without a port number.
_HTTP_PORT = 80
#: ``name`` or ``name:port`` in a `Host` or `Origin` header.
_ADDRESS = re.compile(r"(?P<name>\[[0-9a-f:.]+\]|[a-z0-9._-]+)(?::(?P<port>[1-9][0-9]{0,4}))?",
                      re.ASCII | re.IGNORECASE)


def find_refusal_reason(hosts: list[str], origins: list[str], allowed: frozenset[str], port: int) -> str | None:
    """Check the headers `Host` and `Origin` of a request.

    Browsers derive `Host` from the address of the page and `Origin` from the requesting page, and no page can change
    them. A request without `Origin` is a visit of the page, or comes from a program, which can send any headers.

    Args:
        hosts: Values of all `Host` headers.
        origins: Values of all `Origin` headers.
        allowed: Names of this server in lower case, without brackets and final dot.
        port: Port of this server.

    Returns:
        Reason to refuse the request, one sentence; None if the request is allowed.
    """
    host = _parse_host_and_port_or_none(hosts[0]) if len(hosts) == 1 else None
    if host is None or host[0] not in allowed or host[1] != port:
        return f"This server answers only requests to http://localhost:{port} and its own addresses."
    if not origins:
        return None
    scheme, _, address = origins[0].partition("://")
    if len(origins) > 1 or scheme.lower() != "http" or _parse_host_and_port_or_none(address) != host:
        return "This server answers only requests from this page, not from pages of other sites."
    return None


def _parse_host_and_port_or_none(text: str) -> tuple[str, int] | None:
    """Return the normalised name and the port of ``name`` or ``name:port``; None for any other text."""
    match = _ADDRESS.fullmatch(text)
    return (normalise_host_name(match["name"].strip("[]")), int(match["port"] or _HTTP_PORT)) if match else None


def normalise_host_name(name: str) -> str:
    """Return a name in lower case without final dot, an IP address in its shortest form."""
    name = name.lower().removesuffix(".")
    try:
        address = ipaddress.ip_address(name)
    except ValueError:
        return name
    return str(getattr(address, "ipv4_mapped", None) or address)


#: Version of viser whose private parts this module uses.
VISER_VERSION = "1.1.1"
#: Default address.
LOOPBACK = "127.0.0.1"


@dataclass(frozen=True)
class ServerPortAndLimits:
    """Port and limits of the web server.

    Attributes:
        port: default TCP port of the page.
        start_timeout: time limit for the start of listening, s.
        max_part_size: largest part in which viser's page sends an upload, bytes.
    """

    port: int = 8080
    start_timeout: float = 10.0
    max_part_size: int = 512 * 1024


#: Settings of every page.
SERVER = ServerPortAndLimits()
#: Names of this computer on the loopback interface.
_LOCAL_NAMES = frozenset({"localhost", "127.0.0.1", "::1"})
#: Lock for changes of module state of viser and rich while a server starts or stops.
_module_state = threading.RLock()


def open_viewer_server(host: str = LOOPBACK, port: int = SERVER.port, *, exposed: bool = False,
                       title: str = "tissue_sim", token: str = "") -> ViewerServer:
    """Start a viser server that answers only its own page; the server listens when the function returns.

    Args:
        host: Address of the network interface. An address that other computers can reach requires `exposed`.
        port: Port, 1 to 65535, or 0 for any free port (see `get_port()`).
        exposed: Allow an address that other computers can reach.
        title: Title of the browser tab and of the panel.
        token: Token that a request must contain; empty: no token.

    Raises:
        InputError: `host` is not an address of this computer, other computers can reach it without `exposed`, or the
            port is in use.
        MissingBackendError: The installed version of viser is not `VISER_VERSION`.
    """
    host = LOOPBACK if host == "localhost" else host
    if not _is_loopback_ip_or_raise(host) and not exposed:
        raise InputError(f"{describe_network_access(host, port)}. Use --expose to allow this, or omit --host for "
                         f"{LOOPBACK}.",
                         field="host")
    if not 0 <= port <= 65535:
        raise InputError(f"must be between 1 and 65535, or 0 for any free port; got {port}", field="port")
    _require_tested_viser()
    return ViewerServer(host, port, title, token)


def describe_network_access(host: str, port: int) -> str:
    """Describe who can access a server on `host`, in one sentence without a full stop.

    Raises:
        InputError: `host` is neither an address nor ``localhost``.
    """
    if _is_loopback_ip_or_raise(host):
        return f"only programs of this computer can reach {host}"
    address = "any address of this computer" if ipaddress.ip_address(host).is_unspecified else host
    at_port = f"port {port}" if port else "the chosen port"
    return (f"anyone who can reach {address} at {at_port} can watch, move the tool, change the material, and read and "
            "save recordings and materials, without a password")


class ViewerServer(viser.ViserServer):
    """Running web server with access checks, which `open_viewer_server` starts.

    As a context manager it stops at the end of the block.
    """

    def __init__(self, host: str, port: int, title: str, token: str):
        self._token, listener = token, _CheckedListener(host, port, title, token)
        with _suppressed_viser_output(), listener.replace_viser_serve():
            super().__init__(host=host, port=port, label=title, verbose=False)
        try:
            if listener.failure is not None:
                raise listener.failure
            self._unregister_sharing()
            self._limit_uploads()
            self.set_page_theme()
            # Safe to replace here: no task waits for the event before the server listens.
            self._websock_server.get_message_buffer().message_event = _MessageEvent()
            listener.start_listening_or_raise()
        except OSError as error:
            self.stop()
            raise _make_address_error(host, port, error) from None
        except BaseException:
            self.stop()
            raise

    @property
    def local_url(self) -> str:
        """Address of the server for a browser on this computer, without the token."""
        host = self.get_host()
        if ipaddress.ip_address(host).is_unspecified:
            host = LOOPBACK if ":" not in host else "::1"
        return f"http://{f'[{host}]' if ':' in host else host}:{self.get_port()}"

    def make_page_address(self, **query: str) -> str:
        """Return the address of the page with its token and with additional query parameters."""
        parameters = urlencode(({"token": self._token} if self._token else {}) | query)
        return f"{self.local_url}/?{parameters}" if parameters else self.local_url

    def set_page_theme(self, **theme: Any) -> None:
        """Call viser's `configure_theme` without logo and share button."""
        self.gui.configure_theme(**theme, show_logo=False, show_share_button=False)

    def stop(self) -> None:
        """Stop the server and close all connections; a second call does nothing."""
        with _suppressed_viser_output():
            super().stop()

    def __enter__(self) -> ViewerServer:
        return self

    def __exit__(self, *_) -> None:
        self.stop()

    def _unregister_sharing(self) -> None:
        """Remove viser's handlers of sharing requests, which would open a public tunnel."""
        for message in (viser._messages.ShareUrlRequest, viser._messages.ShareUrlDisconnect):
            if message not in self._websock_server._incoming_handlers:
                raise _make_version_error(f"viser has no handler for {message.__name__}")
            self._websock_server.unregister_handler(message)

    def _limit_uploads(self) -> None:
        """Ignore uploads above `LARGEST_UPLOAD`, which a manipulated client could send and viser would store."""
        messages = viser._messages

        def add_filter_to_handler(kind: type, is_acceptable: Callable[[Any], bool]) -> None:
            handlers = self._websock_server._incoming_handlers.get(kind, [])
            if len(handlers) != 1:
                raise _make_version_error(f"viser has {len(handlers)} handlers for {kind.__name__} instead of one")
            handle = handlers[0]
            handlers[0] = lambda client, message: handle(client, message) if is_acceptable(message) else None

        add_filter_to_handler(messages.FileTransferStartUpload, lambda start: start.size_bytes <= LARGEST_UPLOAD
                              and start.part_count <= LARGEST_UPLOAD // SERVER.max_part_size + 1)
        add_filter_to_handler(messages.FileTransferPart, lambda part: len(part.content) <= SERVER.max_part_size)


class _MessageEvent(asyncio.Event):
    """Event for which the tasks of the browsers wait when there is nothing to send; `set` is thread-safe.

    viser sets the event in the thread that queues a message, and again in the event loop. The event of Python would
    iterate over the waiting tasks in the first thread while tasks are added, which ends that thread with the error
    "deque mutated during iteration".
    """

    def set(self) -> None:
        """Set the event; only a call in the event loop wakes the waiting tasks."""
        try:
            asyncio.get_running_loop()
        except RuntimeError:
            self._value = True
            return
        # `Event.set` wakes the tasks only if the event is not set, but the other thread has set it already.
        self._value = False
        super().set()


class _CheckedListener:
    """Replacement for `websockets.asyncio.server.serve` that checks the requests.

    The server listens from the call of `start_listening_or_raise` on.
    """

    def __init__(self, host: str, port: int, title: str, token: str):
        self.host, self.port, self.title, self._token = host, port, title, token
        self.failure: Exception | None = _make_version_error("viser does not start a websocket server with serve")
        self._server: Any = None

    @contextmanager
    def replace_viser_serve(self) -> Iterator[None]:
        """Replace `serve` in viser, but not in other modules, inside a with statement."""
        infra: Any = viser.infra._infra
        view = SimpleNamespace(**vars(websockets))
        view.asyncio = SimpleNamespace(server=SimpleNamespace(
            serve=self.serve, ServerConnection=websockets.asyncio.server.ServerConnection))
        with _module_state:
            original, infra.websockets = infra.websockets, view
            try:
                yield
            finally:
                infra.websockets = original

    @asynccontextmanager
    async def serve(self, handler: Callable, *_address: Any, process_request: Callable | None = None, **options: Any):
        """Bind the server in viser's thread; on an error, store the error in `failure` and yield a dummy server.

        The error must not reach viser, which would try the next port after an OSError, and would wait without end in
        its constructor after any other error.
        """
        try:
            if process_request is None:
                raise _make_version_error("viser passes no function for HTTP requests to serve")
            options.update(logger=_logger, start_serving=False)
            self._server = await websockets.asyncio.server.serve(
                _wrap_with_client_version_check(handler), self.host, self.port,
                process_request=self._wrap_request_function_with_checks(process_request), **options)
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

    def start_listening_or_raise(self) -> None:
        """Start to listen.

        Raises:
            OSError: Another program has started to listen at this address.
        """
        loop = self._server.get_loop()
        asyncio.run_coroutine_threadsafe(self._server.start_serving(), loop).result(SERVER.start_timeout)

    def _wrap_request_function_with_checks(self, answer: Callable) -> Callable:
        """Return viser's function for HTTP requests with the access checks before it."""
        def check_and_process_request(connection, request):
            allowed = self._list_allowed_hosts(connection)
            headers = request.headers
            refusal = find_refusal_reason(headers.get_all("Host"), headers.get_all("Origin"), allowed, self.port)
            if refusal:
                return connection.respond(HTTPStatus.FORBIDDEN, refusal + "\n")
            if self._token and not has_valid_token(self._token, self.port, request.path, headers.get_all("Cookie")):
                return connection.respond(HTTPStatus.FORBIDDEN, REFUSAL + "\n")
            _delete_header(request.headers, "Accept-Encoding")  # the page must be uncompressed to be changed
            response = answer(connection, request)
            if response is not None:
                self._insert_page_additions_and_headers(response, request.headers["Host"])
            return response

        return check_and_process_request

    def _list_allowed_hosts(self, connection) -> frozenset[str]:
        """Return the host names and addresses by which a request may address this server."""
        if _is_loopback_ip_or_raise(self.host):
            return _LOCAL_NAMES | {normalise_host_name(self.host)}
        name = platform.node().lower()
        reached = normalise_host_name(str(connection.local_address[0]))
        return _LOCAL_NAMES | {normalise_host_name(self.host), reached, name,
                               f"{name.removesuffix('.local')}.local"} - {""}

    def _insert_page_additions_and_headers(self, response, address: str) -> None:
        """Insert the shell into the page, and set the cookie and the security headers.

        The headers forbid other pages to embed this page (clickjacking), and forbid this page to load anything from
        other servers.
        """
        response.body = insert_page_additions(response.body, self.title)
        if self._token:
            response.headers["Set-Cookie"] = make_cookie_header(self._token, self.port)
        _delete_header(response.headers, "Content-Length")
        response.headers.update({
            "Content-Length": str(len(response.body)),
            "X-Frame-Options": "DENY",
            "Content-Security-Policy": "default-src 'self' 'unsafe-inline' 'unsafe-eval' blob: data:; "
                                       f"connect-src 'self' ws://{address} blob: data:; frame-ancestors 'none'; "
                                       "object-src 'none'; base-uri 'none'; form-action 'none'"})


def _delete_header(headers, name: str) -> None:
    """Delete a header if it exists."""
    if name in headers:
        del headers[name]


def _is_loopback_ip_or_raise(host: str) -> bool:
    """Return whether only this computer can reach an IP address or ``localhost``; other text is an `InputError`."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        raise InputError(f"must be an IP address such as {LOOPBACK}; got {host!r}", field="host") from None


def _wrap_with_client_version_check(handler: Callable) -> Callable:
    """Return viser's connection handler with a check of the client's version, because viser's own check prints."""

    async def handle_connection(connection) -> None:
        if connection.subprotocol == f"viser-v{VISER_VERSION}":
            await handler(connection)
        else:
            version = (connection.subprotocol or "viser-vunknown").removeprefix("viser-v")
            await connection.close(1002, f"Version mismatch. Client: {version}, Server: {VISER_VERSION}")

    return handle_connection


def _require_tested_viser() -> None:
    """Raise a `MissingBackendError` unless `VISER_VERSION` is installed."""
    if viser.__version__ != VISER_VERSION:
        raise _make_version_error(f"viser {viser.__version__} is installed")


def _make_version_error(reason: str) -> MissingBackendError:
    """Return the error for a version of viser in which the access checks do not work."""
    return MissingBackendError(f"The access checks of the viewer require viser {VISER_VERSION}: {reason}. Install it "
                               f"with: python -m pip install viser=={VISER_VERSION}")


def _make_address_error(host: str, port: int, error: OSError) -> InputError:
    """Convert an error of binding or listening to a message with a remedy."""
    remedy = "choose another port with --port, or 0 for any free port"
    if error.errno == errno.EADDRINUSE:
        return InputError(f"port {port} of {host} is in use by another program. Close that program, or {remedy}.",
                          field="port")
    if error.errno == errno.EACCES:
        return InputError(f"port {port} requires rights that this user does not have. Please {remedy}.", field="port")
    reason = os.strerror(error.errno) if error.errno else str(error)
    return InputError(f"{host}, port {port} cannot be used ({reason}). Give an address of this computer with --host, "
                      f"or omit --host for {LOOPBACK}.", field="host")


@contextmanager
def _suppressed_viser_output() -> Iterator[None]:
    """Suppress the messages that viser prints at start and stop through the global console of rich."""
    console = rich.get_console()
    with _module_state:
        before, console.quiet = console.quiet, True
        try:
            yield
        finally:
            console.quiet = before


def _is_relevant_record(record: logging.LogRecord) -> bool:
    """Return whether a log record reports more than a broken connection or a client that does not speak HTTP."""
    error = record.exc_info[1] if record.exc_info else None
    # Data that arrive while a request is answered fail an assertion inside websockets.
    return not (isinstance(error, WebSocketException | OSError | EOFError)
                or (isinstance(error, AssertionError) and _find_raising_module(error).startswith("websockets.")))


def _find_raising_module(error: BaseException) -> str:
    """Return the name of the module that raised an error."""
    *_, (frame, _) = traceback.walk_tb(error.__traceback__)
    return str(frame.f_globals.get("__name__", ""))


_logger = logging.getLogger(__name__)
_logger.addFilter(_is_relevant_record)
