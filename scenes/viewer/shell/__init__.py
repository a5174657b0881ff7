"""What stands around viser's page: a loading screen, and words where its fields would say nothing."""

from __future__ import annotations

import html
import json
from functools import cache
from importlib.resources import files

#: Bytes of a file that somebody uploads: a material, a recording.
LARGEST_UPLOAD = 20_000_000
_TITLE, _BODY = b"<title>Viser</title>", b"<body>"


def dress(page: bytes, title: str) -> bytes:
    """viser's page with this title and what is in this folder; what is not that page stays as it is."""
    if _TITLE not in page or _BODY not in page:
        return page
    head = f"<title>{html.escape(title)}</title>\n<style>{_read('shell.css')}</style>\n"
    words = json.dumps({"title": title, "largestUpload": LARGEST_UPLOAD}).replace("<", "\\u003c")
    body = (f"<body>\n{_read('loading.html').replace('TITLE', html.escape(title))}\n"
            f"<script>window.__shell = {words};</script>\n<script>{_read('shell.js')}</script>")
    return page.replace(_TITLE, head.encode(), 1).replace(_BODY, body.encode(), 1)


@cache
def _read(name: str) -> str:
    return files(__package__).joinpath(name).read_text(encoding="utf-8")
