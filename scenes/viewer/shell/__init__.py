"""Additions to viser's page: a loading screen, and messages about rejected numbers and uploads."""

from __future__ import annotations

import html
import json
from functools import cache
from importlib.resources import files

#: Largest size of an uploaded file, bytes.
LARGEST_UPLOAD = 20_000_000
#: Title element of viser's page, which is replaced.
_TITLE = b"<title>Viser</title>"
#: Start of the body of viser's page, after which the additions are inserted.
_BODY = b"<body>"


def insert_page_additions(page: bytes, title: str) -> bytes:
    """Insert a title, the loading screen, the style sheet and the script of this folder into viser's page.

    Args:
        page: Body of an HTTP response.
        title: New title of the page.

    Returns:
        The changed page; a response that is not viser's page is returned unchanged.
    """
    if _TITLE not in page or _BODY not in page:
        return page
    head = f"<title>{html.escape(title)}</title>\n<style>{_read_page_file('shell.css')}</style>\n"
    settings = json.dumps({"title": title, "largestUpload": LARGEST_UPLOAD}).replace("<", "\\u003c")
    body = (f"<body>\n{_read_page_file('loading.html').replace('TITLE', html.escape(title))}\n"
            f"<script>window.__shell = {settings};</script>\n<script>{_read_page_file('shell.js')}</script>")
    return page.replace(_TITLE, head.encode(), 1).replace(_BODY, body.encode(), 1)


@cache
def _read_page_file(name: str) -> str:
    """Return the text of a file of this folder."""
    return files(__package__).joinpath(name).read_text(encoding="utf-8")
