"""A real Chromium, and a record of everything that its pages ask for."""

import importlib.util
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest

HERE = Path(__file__).parent


def pytest_collection_modifyitems(items):
    """Pages come last: while Playwright runs, the main thread has a running event loop, which other tests may not."""
    items.sort(key=lambda item: HERE in item.path.parents)


@pytest.fixture(scope="session")
def chromium(root):
    """The module with which the screenshots of the documentation are made."""
    spec = importlib.util.spec_from_file_location("docs_chromium", root / "docs" / "chromium.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def browser(chromium):
    """One Chromium for all tests; each has pages of its own, which share nothing."""
    pytest.importorskip("playwright.sync_api", reason="drives a page with Playwright, which the extra tissue-sim[test] "
                                                      "has")
    if chromium.chromium_path() is None:
        pytest.skip("looks at the page in Chromium, and none is on PATH (Debian: apt install chromium "
                    "fonts-dejavu-core)")
    with chromium.chromium() as running:
        yield running


@dataclass
class Traffic:
    """What a page asked for, and what went wrong in it."""

    urls: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)

    def watch(self, page):
        page.on("request", lambda request: self.urls.append(request.url))
        page.on("requestfailed", lambda request: self.failed.append(f"{request.url}: {request.failure}"))
        page.on("response", lambda reply: reply.ok or self.failed.append(f"{reply.url}: {reply.status}"))
        page.on("websocket", self._watch_socket)
        page.on("console", lambda message: message.type == "error" and self.errors.append(message.text))
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        return page

    def _watch_socket(self, websocket):
        self.urls.append(websocket.url)
        websocket.on("socketerror", lambda error: self.failed.append(f"{websocket.url}: {error}"))

    def foreign(self, server):
        """Addresses outside the server; what a page keeps in itself (blob, data) is not asked of anybody."""
        place = server.url.removeprefix("http://")
        own = tuple(f"{scheme}://{place}/" for scheme in ("http", "ws", "blob:http"))
        return [url for url in self.urls if not url.startswith(own) and not url.startswith("data:")]


@pytest.fixture
def open_page(browser, chromium):
    """Open a page of a server: ``open_page(server, width=, height=, scheme=, triangles=)`` -> Playwright's page.

    Each has its own cookies and storage. At the end none may have asked for anything elsewhere, missed anything, or
    met an error in a script. ``open_page.traffic(page)`` is what it asked for.
    """
    opened = []

    def open_one(server, *, width=1000, height=700, scheme="light", triangles=0, **options):
        context = browser.new_context(viewport={"width": width, "height": height}, color_scheme=scheme,
                                      accept_downloads=True)
        traffic = Traffic()
        page = traffic.watch(context.new_page())
        page.set_default_timeout(30_000)
        opened.append((server, context, page, traffic))
        chromium.open_viewer(page, server.url, triangles=triangles, **options)
        return page

    open_one.traffic = lambda page: next(traffic for _, _, one, traffic in opened if one is page)
    yield open_one
    found = [(traffic.foreign(server), traffic.failed, traffic.errors) for server, _, _, traffic in opened]
    for _, context, _, _ in opened:
        context.close()
    assert found == [([], [], [])] * len(opened)


@pytest.fixture
def stranger(browser):
    """A page of no server of ours: ``with stranger() as page``; its errors are its own."""

    @contextmanager
    def open_one():
        with browser.new_context() as context:
            page = context.new_page()
            page.set_default_timeout(30_000)
            yield page

    return open_one
