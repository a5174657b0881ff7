"""Checks of the headers `Host` and `Origin` of HTTP requests and websocket handshakes."""

from __future__ import annotations

import ipaddress
import re

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
