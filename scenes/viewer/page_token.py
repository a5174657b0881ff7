"""The token of a page: who has its printed address may open it, as with Jupyter; no other program of this computer may.

The address brings the token once; from then on a cookie does, which no page of another site sends and no script reads.
"""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Sequence
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs, urlsplit

REFUSAL = "This page opens with the address that was printed where it was started, its token included."


def new_token() -> str:
    """One that nobody guesses."""
    return secrets.token_urlsafe(24)


def admits(token: str, port: int, path: str, cookies: Sequence[str]) -> bool:
    """Whether a request may be answered.

    Args:
        token: of the page.
        port: of the server; cookies are those of all servers of a computer.
        path: of the request, with its query.
        cookies: values of all headers of that name.
    """
    try:
        shown = parse_qs(urlsplit(path).query).get("token", [])
        for each in cookies:
            if (morsel := SimpleCookie(each).get(_name(port))) is not None:
                shown.append(morsel.value)
    except (ValueError, CookieError):
        return False
    return any(hmac.compare_digest(one.encode(), token.encode()) for one in shown)


def cookie(token: str, port: int) -> str:
    """The header that brings the token from now on, until the browser is closed."""
    return f"{_name(port)}={token}; Path=/; HttpOnly; SameSite=Strict"


def _name(port: int) -> str:
    return f"tissue_sim_{port}"
