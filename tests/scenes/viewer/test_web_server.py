"""Web server of the viewer on real sockets: access checks, disabled sharing, and errors of ports and addresses."""

import asyncio
import http.client
import logging
import platform
import re
import socket
import subprocess
import sys
import threading
from types import FunctionType

import msgspec
import pytest
import viser
from hypothesis import given
from hypothesis import strategies as st
from websockets.exceptions import InvalidStatus
from websockets.server import ServerProtocol
from websockets.sync.client import connect

from scenes.viewer import web_server
from scenes.viewer.web_server import (
    VISER_VERSION,
    ViewerServer,
    describe_network_access,
    find_refusal_reason,
    open_viewer_server,
)
from tissue_sim.errors import InputError, MissingBackendError

PROTOCOL = f"viser-v{VISER_VERSION}"
NAMES = frozenset({"localhost", "127.0.0.1", "::1"})


@pytest.fixture(scope="module")
def server():
    with open_viewer_server(port=0, title="needle & <tissue>") as running:
        yield running


def ask(port, *headers, path="/", address="127.0.0.1"):
    """Send one request with exactly these headers; return status, body and headers of the response."""
    connection = http.client.HTTPConnection(address, port, timeout=120)
    connection.putrequest("GET", path, skip_host=True, skip_accept_encoding=True)
    for name, value in headers:
        connection.putheader(name, value)
    connection.endheaders()
    reply = connection.getresponse()
    answer = reply.status, reply.read().decode("utf-8"), dict(reply.getheaders())
    connection.close()
    return answer


def websocket(port, name="127.0.0.1", **options):
    """HTTP client that sends `name` as the name of the server."""
    stream = socket.create_connection(("127.0.0.1", port), timeout=120)
    try:
        return connect(f"ws://{name}:{port}/", sock=stream, subprotocols=[PROTOCOL], compression=None, **options)
    except BaseException:
        stream.close()
        raise


def is_answered(port, **options):
    """Open a websocket; return whether viser accepts it, or the status of the refusal."""
    try:
        with websocket(port, **options) as client:
            return isinstance(client.recv(timeout=120), bytes)
    except InvalidStatus as refused:
        return refused.response.status_code


def is_open(port):
    with socket.socket() as probe:
        probe.settimeout(120)
        return probe.connect_ex(("127.0.0.1", port)) == 0


class TestToken:
    """Access by programs of this computer that do not know the printed address."""

    TOKEN = "t0k-en_of_a_test"

    @pytest.fixture
    def guarded(self):
        with open_viewer_server(port=0, token=self.TOKEN) as running:
            yield running

    def host(self, server):
        return "Host", f"127.0.0.1:{server.get_port()}"

    def test_the_printed_address_opens_the_page_and_sets_a_cookie(self, guarded):
        port = guarded.get_port()
        assert guarded.make_page_address() == f"http://127.0.0.1:{port}/?token={self.TOKEN}"
        assert guarded.make_page_address(fixedDpr="0.5").endswith(f"?token={self.TOKEN}&fixedDpr=0.5")
        status, page, headers = ask(port, self.host(guarded), path=f"/?token={self.TOKEN}")
        assert status == 200 and "</html>" in page
        name, _, attributes = headers["Set-Cookie"].partition(";")
        assert "HttpOnly" in attributes and "SameSite=Strict" in attributes
        assert ask(port, self.host(guarded), ("Cookie", f"other=1; {name}"))[0] == 200
        assert is_answered(port, additional_headers={"Cookie": name}) is True

    @pytest.mark.parametrize("path", ["/", "/?token=", "/?token=wrong", "/?token=%ff%00", "/?fixedDpr=1",
                                      "/assets/x"])
    def test_a_request_without_the_token_is_refused(self, guarded, path):
        status, page, _ = ask(guarded.get_port(), self.host(guarded), path=path)
        assert status == 403
        assert page.startswith("The token is missing or wrong. Open this page with the complete address")

    @pytest.mark.parametrize("headers", [{}, {"Cookie": "tissue_sim_1=t0k-en_of_a_test"}])
    def test_nor_can_a_program_steer(self, guarded, headers):
        """Any program can open a websocket without an origin."""
        assert is_answered(guarded.get_port(), additional_headers=headers) == 403

    @pytest.mark.parametrize("noise", ["", ";;==", "=", '"', "tissue_sim_", "a=b; tissue_sim_1"])
    def test_invalid_cookies_are_refused(self, guarded, noise):
        assert ask(guarded.get_port(), self.host(guarded), ("Cookie", noise))[0] == 403

    def test_a_server_without_a_token_sets_no_cookie(self, server):
        assert "Set-Cookie" not in ask(server.get_port(), self.host(server))[2]
        assert server.make_page_address() == server.local_url


def test_the_own_page_is_served_with_its_title(server):
    for name in ("localhost", "127.0.0.1", "LocalHost.", "[::1]"):
        status, page, _ = ask(server.get_port(), ("Host", f"{name}:{server.get_port()}"))
        assert (status, "<title>needle &amp; &lt;tissue&gt;</title>" in page) == (200, True), name
    assert server.local_url == f"http://127.0.0.1:{server.get_port()}"


def test_security_headers_forbid_framing_and_foreign_resources(server):
    headers = ask(server.get_port(), ("Host", f"localhost:{server.get_port()}"), ("Accept-Encoding", "gzip"))[2]
    policy = dict(part.strip().split(" ", 1) for part in headers["Content-Security-Policy"].split(";"))
    assert (headers["X-Frame-Options"], policy["frame-ancestors"]) == ("DENY", "'none'")
    assert policy["connect-src"] == f"'self' ws://localhost:{server.get_port()} blob: data:"
    assert not re.search(r"https?:|\*", headers["Content-Security-Policy"])


@pytest.mark.parametrize("hosts", [["rebound.example:{port}"], ["localhost:1"], ["localhost"], [],
                                   ["localhost:{port}", "localhost:{port}"], ["localhost:{port}@rebound.example"]],
                         ids=["foreign", "other port", "no port", "none", "two", "with a user"])
def test_request_for_another_server_is_refused(server, hosts):
    port = server.get_port()
    status, sentence, headers = ask(port, *(("Host", host.format(port=port)) for host in hosts))
    expected = f"This server answers only requests to http://localhost:{port} and its own addresses.\n"
    assert (status, sentence) == (403, expected)
    assert headers["Content-Type"].startswith("text/plain")


@pytest.mark.parametrize("origins", [["http://other.example"], ["null"], ["https://localhost:{port}"],
                                     ["http://127.0.0.1:{port}"], ["http://localhost:1"], [""],
                                     ["http://localhost:{port}", "http://localhost:{port}"]],
                         ids=["foreign", "null", "https", "other name", "other port", "empty", "two"])
def test_page_of_another_site_cannot_fetch(server, origins):
    port = server.get_port()
    status, sentence, _ = ask(port, ("Host", f"localhost:{port}"),
                              *(("Origin", origin.format(port=port)) for origin in origins))
    assert status == 403
    assert sentence == "This server answers only requests from this page, not from pages of other sites.\n"


@pytest.mark.parametrize(("origin", "answer"), [
    ("http://127.0.0.1:{port}", True), (None, True), ("http://other.example", 403), ("null", 403),
    ("http://127.0.0.1:{port}.other.example", 403), ("http://localhost:{port}", 403)])
def test_only_the_own_page_may_open_a_websocket(server, origin, answer):
    port = server.get_port()
    assert is_answered(port, origin=origin and origin.format(port=port)) == answer


def test_handshake_under_a_foreign_name_is_refused(server):
    assert is_answered(server.get_port(), name="rebound.example") == 403
    port = server.get_port()
    assert is_answered(port, name="rebound.example", origin=f"http://rebound.example:{port}") == 403


@given(name=st.sampled_from(["localhost", "127.0.0.1", "[::1]", "[0:0:0:0:0:0:0:1]", "[::ffff:127.0.0.1]"]),
       upper=st.booleans(), dot=st.sampled_from(["", "."]), port=st.integers(1, 65535), shift=st.integers(-3, 3))
def test_spellings_of_a_server_name_are_equivalent(name, upper, dot, port, shift):
    place = f"{name.upper() if upper else name}{'' if name[0] == '[' else dot}:{port + shift}"
    accepted = shift == 0
    assert (find_refusal_reason([place], [], NAMES, port) is None) == accepted
    assert (find_refusal_reason([place], [f"http://{place}"], NAMES, port) is None) == accepted
    assert find_refusal_reason([place], [f"https://{place}"], NAMES, port) is not None
    if accepted and port != 80:
        assert find_refusal_reason([place.rpartition(":")[0]], [], NAMES, port) is not None


@given(st.text() | st.from_regex(r"(localhost|127\.0\.0\.1|\[::1\]|[a-z.]+)[.@:/ ,\\#?%]*(80)?[^\n]?", fullmatch=True))
def test_other_texts_are_no_server_names(text):
    known = {f"{name}{dot}{port}" for name in ("localhost", "127.0.0.1") for dot in ("", ".") for port in ("", ":80")}
    known |= {"[::1]", "[::1]:80"}
    assert (find_refusal_reason([text], [], NAMES, 80) is None) == (text.lower() in known)
    own = {f"http://{place}" for place in ("localhost", "localhost.", "localhost:80", "localhost.:80")}
    for origin in (text, f"http://{text}"):
        assert (find_refusal_reason(["localhost"], [origin], NAMES, 80) is None) == (origin.lower() in own)


def requests_of_sharing(server):
    """Send both sharing messages of a client; return the names of those that reach a function of the server."""
    arrived, last = set(), threading.Event()
    server.request_share_url = lambda: arrived.add("ShareUrlRequest")
    server.disconnect_share_url = lambda: arrived.add("ShareUrlDisconnect")
    server._websock_server.register_handler(viser._messages.GuiUpdateMessage, lambda *_: last.set())
    with websocket(server.get_port()) as client:
        for message in ({"type": "ShareUrlRequest"}, {"type": "ShareUrlDisconnect"},
                        {"type": "GuiUpdateMessage", "uuid": "nothing", "updates": {}}):
            client.send(msgspec.msgpack.encode(message))
        assert last.wait(120)
    server._thread_executor.shutdown()  # what the first two have asked for has run
    return arrived


def test_no_client_can_have_a_tunnel_opened(server):
    with open_viewer_server(port=0) as own:
        assert requests_of_sharing(own) == set()


def test_plain_viser_handles_sharing_messages(capfd):
    plain = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    assert requests_of_sharing(plain) == {"ShareUrlRequest", "ShareUrlDisconnect"}
    plain.stop()


def test_page_offers_neither_logo_nor_sharing(monkeypatch):
    themes = []
    monkeypatch.setattr(viser.GuiApi, "configure_theme", lambda self, **theme: themes.append(theme))
    with open_viewer_server(port=0) as own:
        own.set_page_theme(dark_mode=True)
    assert themes == [{"show_logo": False, "show_share_button": False},
                      {"dark_mode": True, "show_logo": False, "show_share_button": False}]


def test_a_port_in_use_is_reported_and_left_unchanged(server):
    port = server.get_port()
    with pytest.raises(InputError, match=rf"^port: port {port} of 127\.0\.0\.1 is in use by another program\. Close "
                                         r"that program, or choose another port with --port, or 0 for any free "
                                         r"port\.$"):
        open_viewer_server(port=port)
    assert ask(port, ("Host", f"localhost:{port}"))[0] == 200


def test_a_bound_port_without_listener_is_in_use():
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        with pytest.raises(InputError, match="is in use by another program"):
            open_viewer_server(port=other.getsockname()[1])


def test_two_servers_get_two_ports(server):
    with open_viewer_server(port=0) as second:
        assert second.get_port() not in (0, server.get_port())
        assert ask(second.get_port(), ("Host", f"127.0.0.1:{server.get_port()}"))[0] == 403


@pytest.mark.parametrize(("host", "port", "message"), [
    ("127.0.0.1", 65536, "port: must be between 1 and 65535, or 0 for any free port; got 65536"),
    ("127.0.0.1", -1, "port: must be .*; got -1"),
    ("nowhere", 0, r"host: must be an IP address such as 127\.0\.0\.1; got 'nowhere'"),
    ("", 0, "host: must be an IP address .*; got ''"),
    ("192.0.2.1", 0, r"host: 192\.0\.2\.1, port 0 cannot be used \(.+\)\. Give an address of this computer")])
def test_an_invalid_address_is_refused(host, port, message):
    with pytest.raises(InputError, match=message):
        open_viewer_server(host, port, exposed=True)


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.7"])
def test_other_computers_need_the_word(host):
    with pytest.raises(InputError, match=r"^host: anyone who can reach .* at port 8080 can .*move the tool.* without a "
                                         r"password\. Use --expose to allow this"):
        open_viewer_server(host)


def test_exposure_describes_who_has_access():
    everywhere = describe_network_access("0.0.0.0", 8080)
    assert everywhere.startswith("anyone who can reach any address of this computer at port 8080 can ")
    assert describe_network_access("10.0.0.7", 0).startswith("anyone who can reach 10.0.0.7 at the chosen port can ")
    for host in ("127.0.0.1", "localhost"):
        assert describe_network_access(host, 8080) == f"only programs of this computer can reach {host}"


def test_an_exposed_server_checks_its_names():
    with open_viewer_server("0.0.0.0", 0, exposed=True) as own:
        port = own.get_port()
        assert own.local_url == f"http://127.0.0.1:{port}"
        for name, status in (("localhost", 200), (platform.node(), 200), (platform.node().upper(), 200),
                             ("rebound.example", 403), ("0.0.0.1", 403)):
            assert ask(port, ("Host", f"{name}:{port}"))[0] == status, name
        assert is_answered(port, origin="http://other.example") == 403


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have one loopback address only")
def test_an_exposed_server_accepts_the_address_of_the_connection():
    with open_viewer_server("0.0.0.0", 0, exposed=True) as own:
        port = own.get_port()
        assert ask(port, ("Host", f"127.0.0.2:{port}"), address="127.0.0.2")[0] == 200
        assert ask(port, ("Host", f"127.0.0.3:{port}"), address="127.0.0.2")[0] == 403


def has_version_6():
    """Return whether the system supports IPv6, independently of the server under test."""
    try:
        with socket.socket(socket.AF_INET6) as own:
            own.bind(("::1", 0))
    except OSError:
        return False
    return True


def test_an_ipv6_address_is_served():
    if not has_version_6():
        pytest.skip("serves on ::1, and this computer's system has IPv6 switched off: no program can use that address")
    with open_viewer_server("::1", 0) as own:
        port = own.get_port()
        assert own.local_url == f"http://[::1]:{port}"
        assert ask(port, ("Host", f"[::1]:{port}"), address="::1")[0] == 200
        assert ask(port, ("Host", f"[::2]:{port}"), address="::1")[0] == 403


def test_connections_are_refused_until_the_server_is_ready(monkeypatch):
    seen = []
    monkeypatch.setattr(ViewerServer, "set_page_theme", lambda self: seen.append(is_open(self.get_port())))
    with open_viewer_server(port=0) as own:
        assert (seen, is_open(own.get_port())) == ([False], True)
    assert not is_open(own.get_port())


def test_other_version_of_viser_is_not_served(monkeypatch):
    monkeypatch.setattr(viser, "__version__", "1.2.0")
    with pytest.raises(MissingBackendError, match=r"viser 1\.2\.0 is installed\. Install it with: python -m pip "
                                                  r"install viser==1\.1\.1"):
        open_viewer_server(port=0)


def test_viser_without_the_known_handlers_is_not_served(monkeypatch):
    register, ports = viser.infra.WebsockServer.register_handler, []

    def forget_sharing(self, message, callback):
        if not message.__name__.startswith("ShareUrl"):
            register(self, message, callback)
        ports.append(self._port)

    monkeypatch.setattr(viser.infra.WebsockServer, "register_handler", forget_sharing)
    with pytest.raises(MissingBackendError, match="viser has no handler for ShareUrlRequest"):
        open_viewer_server(port=0)
    assert not is_open(ports[-1])


def test_viser_with_another_start_is_not_served(monkeypatch):
    """Its worker uses a copy of websockets in which serve is not replaced."""
    infra, servers = viser.infra._infra, []
    elsewhere = FunctionType(infra.WebsockServer._background_worker.__code__, dict(vars(infra)))

    def worker(self, ready):
        servers.append(self)
        elsewhere(self, ready)

    monkeypatch.setattr(infra.WebsockServer, "_background_worker", worker)
    with pytest.raises(MissingBackendError, match="viser does not start a websocket server with serve"):
        open_viewer_server(port=0)
    assert not is_open(servers[0]._port)


def test_installed_viser_is_the_one_whose_private_parts_are_known(root):
    """Change the pin together with VISER_VERSION, after a review of the private parts that web_server.py uses."""
    assert viser.__version__ == VISER_VERSION
    assert f'"viser=={VISER_VERSION}"' in (root / "pyproject.toml").read_text(encoding="utf-8")


def test_protocol_errors_are_not_logged_but_own_errors_are():
    def record_of(work):
        try:
            work()
        except AssertionError:
            return logging.LogRecord("", logging.ERROR, "", 0, "unexpected internal error", (), sys.exc_info())

    def ours():
        raise AssertionError

    protocol = ServerProtocol()
    protocol.send_eof()
    assert not web_server._is_relevant_record(record_of(protocol.send_eof))
    assert web_server._is_relevant_record(record_of(ours))


def test_the_server_prints_nothing():
    """Start, invalid data, a client of another version, stop, and a second server that ends with the interpreter."""
    code = """
import socket
from websockets.sync.client import connect
from scenes.viewer.web_server import open_viewer_server
from tissue_sim.errors import InputError

first, second = open_viewer_server(port=0), open_viewer_server(port=0)
place = "127.0.0.1", first.get_port()
try:
    open_viewer_server(port=first.get_port())
except InputError:
    pass
for noise in (b"", b"\\x16\\x03\\x01\\r\\n\\r\\n", b"POST / HTTP/1.1\\r\\nHost: localhost\\r\\n\\r\\n"):
    with socket.create_connection(place) as stream:
        stream.sendall(noise)
        stream.shutdown(socket.SHUT_WR)
        while stream.recv(4096):
            pass
with connect("ws://%s:%d" % place, subprotocols=["viser-v0.1"]) as client:
    try:
        client.recv()
    except Exception as closed:
        assert "Version mismatch. Client: 0.1" in str(closed), closed
with connect("ws://%s:%d" % place, subprotocols=["viser-v1.1.1"]) as client:
    client.recv()
first.stop()
first.stop()
"""
    done = subprocess.run([sys.executable, "-W", "error::DeprecationWarning", "-c", code], capture_output=True,
                          text=True, encoding="utf-8", timeout=120)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_waiting_tasks_are_woken_in_the_event_loop_only(server):
    """viser sets the event in another thread while tasks start to wait, which ended that thread with Python's event."""
    event = type(server._websock_server.get_message_buffer().message_event)()

    async def wait_and_be_woken():
        waiting = [asyncio.ensure_future(event.wait()) for _ in range(3)]
        await asyncio.sleep(0)
        elsewhere = threading.Thread(target=event.set)
        elsewhere.start()
        elsewhere.join()
        assert event.is_set() and not any(future.done() for future in event._waiters)
        asyncio.get_running_loop().call_soon_threadsafe(event.set)
        return await asyncio.wait_for(asyncio.gather(*waiting), 120)

    assert asyncio.run(wait_and_be_woken()) == [True] * 3
    assert type(event) is not asyncio.Event
