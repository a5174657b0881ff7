"""Headless Chromium with software rendering, for the screenshots and the browser tests of the viewer's page."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Locator, Page

#: Software rendering (SwiftShader) is used for the 3D picture only: composing the page with it takes six times as long
#: as Chromium's own compositor.
FLAGS = ("--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
         "--disable-gpu-compositing", "--disable-quic", "--no-first-run", "--disable-background-networking",
         "--disable-component-update", "--disable-sync", "--force-color-profile=srgb")
#: All host names except this computer are unresolvable; `rebound.test` is a foreign name of this computer.
OFFLINE = "--host-resolver-rules=MAP rebound.test 127.0.0.1, MAP * ~NOTFOUND, EXCLUDE localhost, EXCLUDE 127.0.0.1"
#: viser's notice about the missing graphics card, which covers the scene and receives clicks.
_NOTICE = "#webgl-software-rendering"
#: viser's own state in the page, of the version that pyproject.toml pins: all messages applied, something drawn.
_DRAWN = """([triangles]) => {
    const mutable = window.__viserMutable, info = window.__viserTestpoints?.rendererInfo;
    return Boolean(mutable && info) && !mutable.firstMessageBatch && mutable.messageQueue.length === 0
        && info.render.frame > 0 && info.render.triangles >= triangles;
}"""
_TWO_FRAMES = "() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done())))"


def chromium_path() -> str | None:
    """Return the path of the system's Chromium, or None without one."""
    return next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)


@contextmanager
def chromium(*flags: str) -> Iterator[Browser]:
    """Start a browser without stored data that can reach this computer only, and yield it."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium_path(), args=[*FLAGS, OFFLINE, *flags])
        try:
            yield browser
        finally:
            browser.close()


def open_viewer(page: Page, url: str, *, pixel_ratio: float = 0.5, triangles: int = 1) -> None:
    """Open a page of viser and wait for its scene, as `come_up` does.

    Args:
        page: browser page.
        url: address of the viewer.
        pixel_ratio: pixels of the 3D picture per pixel of the page; a small ratio is fast.
        triangles: smallest number of triangles of the drawn scene.
    """
    page.goto(f"{url}{'&' if '?' in url else '/?'}fixedDpr={pixel_ratio:g}")
    come_up(page, triangles=triangles)


def come_up(page: Page, *, triangles: int = 1) -> None:
    """Wait until a loading page is connected and has drawn the scene, then close viser's notice."""
    wait_for_picture(page, triangles=triangles)
    notice = page.locator(_NOTICE)
    notice.get_by_role("button").click()
    notice.wait_for(state="detached")


def wait_for_picture(page: Page, *, triangles: int = 1, timeout: float = 60.0) -> None:
    """Wait, for at most `timeout` s, until the page has drawn all data from the server."""
    page.wait_for_function(_DRAWN, arg=[triangles], timeout=timeout * 1e3)
    page.evaluate(_TWO_FRAMES)


def text_field(page: Page, label: str) -> Locator:
    """Return the input field that follows a label; not all of viser's fields have accessible names."""
    return page.locator(f'xpath=//label[normalize-space(.)="{label}"]/following::input[not(@type="hidden")][1]')


def save_picture(page: Page, path: Path) -> None:
    """Save the page as PNG; the file is written completely or not at all."""
    from tissue_sim.files import write_bytes

    wait_for_picture(page)
    write_bytes(path, page.screenshot(animations="disabled", caret="hide", timeout=60e3))
