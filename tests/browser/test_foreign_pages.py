"""Access checks in a browser: pages of other sites cannot use the viewer."""

import http.server
import threading
from contextlib import contextmanager

import pytest

from scenes.viewer.web_server import VISER_VERSION, open_viewer_server

#: What each of the ways to reach a server comes to; run in a page, with the address as argument.
ATTEMPTS = """async ({place, protocol}) => {
    const handshake = new Promise(done => {
        const socket = new WebSocket(`ws://${place}/`, protocol);
        socket.onopen = () => done("open");
        socket.onerror = () => done("refused");
    });
    const page = await fetch(`http://${place}/`).then(reply => reply.status, () => "refused");
    return {handshake: await handshake, page};
}"""


@pytest.fixture
def server():
    with open_viewer_server(port=0) as running:
        yield running


@contextmanager
def site(html=""):
    """Web server of another site on this computer: its address and the requested paths."""
    asked = []

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            asked.append(self.path)
            body = html.encode("utf-8")
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as other:
        thread = threading.Thread(target=other.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{other.server_address[1]}", asked
        finally:
            other.shutdown()
            thread.join()


def attempt(page, server):
    return page.evaluate(ATTEMPTS, {"place": server.local_url.removeprefix("http://"),
                                    "protocol": f"viser-v{VISER_VERSION}"})


@pytest.mark.slow
def test_own_page_may(server, stranger):
    with stranger() as page:
        page.goto(server.local_url)
        assert attempt(page, server) == {"handshake": "open", "page": 200}


def test_page_of_another_site_may_not(server, stranger):
    with site() as (address, _), stranger() as page:
        said = []
        page.on("console", lambda message: said.append(message.text))
        page.goto(address)
        assert attempt(page, server) == {"handshake": "refused", "page": "refused"}
        assert any("WebSocket" in text and "403" in text for text in said), said
    assert not server._websock_server._client_state_from_id


def test_sandboxed_frame_without_an_origin_may_not(server, stranger):
    with site("<iframe sandbox='allow-scripts' srcdoc='<p>frame</p>'></iframe>") as (address, _), stranger() as page:
        page.goto(address)
        page.frame_locator("iframe").get_by_text("frame").wait_for()
        frame = page.frames[1]
        assert frame.evaluate("self.origin") == "null"
        assert attempt(frame, server) == {"handshake": "refused", "page": "refused"}


def test_name_that_is_bound_to_this_computer_may_not(server, stranger):
    """DNS rebinding: the browser assigns the page to the foreign name, whose scripts could then read it."""
    with stranger() as page:
        reply = page.goto(server.local_url.replace("127.0.0.1", "rebound.test"))
        assert (reply.status, reply.text()) == (403, "This server answers only requests to http://localhost:"
                                                     f"{server.get_port()} and its own addresses.\n")
        assert attempt(page, server) == {"handshake": "refused", "page": "refused"}


def test_page_of_another_site_cannot_frame_ours(server, stranger):
    with site(f"<iframe src='{server.local_url}'></iframe>") as (address, _), stranger() as page:
        page.goto(address)
        page.wait_for_function("frames.length === 1")
        assert "root" not in page.frames[1].content()
        assert page.frames[1].url.startswith("chrome-error://")


@pytest.mark.slow
def test_our_page_fetches_nothing_from_another_site(server, stranger, chromium):
    """The page contains HTML with a foreign address, as an uploaded file name could contain it."""
    with site() as (address, asked), stranger() as page:
        server.gui.add_html(f"<b>sample</b><img alt='' src='{address}/pixel.png'>")
        blocked = []
        page.on("console", lambda message: blocked.append(message.text) if address in message.text else None)
        chromium.open_viewer(page, server.local_url, triangles=0)
        page.get_by_text("sample").wait_for()
        assert any("Content Security Policy" in text for text in blocked), blocked
        page.goto(f"{address}/visit")
        assert asked == ["/visit"] or asked == ["/visit", "/favicon.ico"]
