"""Access token of a page: only browsers that know the printed address may open the page, as with Jupyter.

The address transmits the token once. Afterwards, a cookie transmits it; pages of other sites cannot send this cookie
(SameSite=Strict), and scripts cannot read it (HttpOnly).
"""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Sequence
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs, urlsplit

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
