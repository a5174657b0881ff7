"""Chromium without a screen, drawing in software: for the screenshots here and the tests of the viewer's page."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Locator, Page

#: The 3D picture alone is drawn by the software that stands in for a graphics card: it takes six times as long as
#: Chromium's own to put a page together.
FLAGS = ("--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
         "--disable-gpu-compositing", "--disable-quic", "--no-first-run", "--disable-background-networking",
         "--disable-component-update", "--disable-sync", "--force-color-profile=srgb")
#: Nothing that the page asks for is found outside this computer; `rebound.test` is a foreign name of it.
OFFLINE = "--host-resolver-rules=MAP rebound.test 127.0.0.1, MAP * ~NOTFOUND, EXCLUDE localhost, EXCLUDE 127.0.0.1"
#: It says that there is no graphics card, which is so; it covers the scene and takes clicks.
_NOTICE = "#webgl-software-rendering"
#: viser's own state in the page, of the version that pyproject.toml pins: all messages applied, something drawn.
_DRAWN = """([triangles]) => {
    const mutable = window.__viserMutable, info = window.__viserTestpoints?.rendererInfo;
    return Boolean(mutable && info) && !mutable.firstMessageBatch && mutable.messageQueue.length === 0
        && info.render.frame > 0 && info.render.triangles >= triangles;
}"""
_TWO_FRAMES = "() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done())))"


def chromium_path() -> str | None:
    """Chromium of the system, Debian's package for one; None where there is none."""
    return next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)


@contextmanager
def chromium(*flags: str) -> Iterator[Browser]:
    """A browser that keeps nothing and reaches this computer only."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium_path(), args=[*FLAGS, OFFLINE, *flags])
        try:
            yield browser
        finally:
            browser.close()


def open_viewer(page: Page, url: str, *, pixel_ratio: float = 0.5, triangles: int = 1) -> None:
    """Visit a page of viser, as `come_up`.

    Args:
        pixel_ratio: of the 3D picture, to a pixel of the page; small is fast.
        triangles: how many the picture has at least.
    """
    page.goto(f"{url}{'&' if '?' in url else '/?'}fixedDpr={pixel_ratio:g}")
    come_up(page, triangles=triangles)


def come_up(page: Page, *, triangles: int = 1) -> None:
    """Wait until a page that loads is connected and has drawn the scene, and close viser's notice."""
    wait_for_picture(page, triangles=triangles)
    notice = page.locator(_NOTICE)
    notice.get_by_role("button").click()
    notice.wait_for(state="detached")


def wait_for_picture(page: Page, *, triangles: int = 1, timeout: float = 60.0) -> None:
    """Wait until what the server has sent is drawn, s."""
    page.wait_for_function(_DRAWN, arg=[triangles], timeout=timeout * 1e3)
    page.evaluate(_TWO_FRAMES)


def text_field(page: Page, label: str) -> Locator:
    """The input field after a label: viser names some of its fields for screen readers, and others not."""
    return page.locator(f'xpath=//label[normalize-space(.)="{label}"]/following::input[not(@type="hidden")][1]')


def save_picture(page: Page, path: Path) -> None:
    """What the page shows, as PNG; the file is written whole or not at all."""
    from tissue_sim.atomic_write import write_bytes

    wait_for_picture(page)
    write_bytes(path, page.screenshot(animations="disabled", caret="hide", timeout=60e3))
