"""Symbols of parameters as a paper sets them: ``mu1@A`` is a mu with an index, of A."""

from __future__ import annotations

import re
from html import escape

_GREEK = {"alpha": "α", "beta": "β", "gamma": "γ", "delta": "δ", "epsilon": "ε", "eta": "η", "theta": "θ",
          "kappa": "κ", "lambda": "λ", "mu": "μ", "nu": "ν", "rho": "ρ", "sigma": "σ", "tau": "τ", "phi": "φ"}
_PARTS = re.compile(r"([A-Za-z]+)_?(\d*)$")


def html_symbol(symbol: str) -> str:
    """As HTML: ``μ<sub>1</sub>``, with the specimen, test or recording that it belongs to in brackets."""
    name, index, where = _parts(symbol)
    letter = f"<i>{escape(_GREEK.get(name, name))}</i>" if index or name in _GREEK else escape(name)
    return letter + (f"<sub>{index}</sub>" if index else "") + (f" ({escape(where)})" if where else "")


def math_symbol(symbol: str) -> str:
    """For the labels of pictures, in mathtext."""
    name, index, where = _parts(symbol)
    if not index and name not in _GREEK:
        return symbol.replace("$", r"\$")
    letter = f"\\{name}" if name in _GREEK else name
    index = f"_{{{index}}}" if index else ""
    return f"${letter}{index}$" + (f" ({where})".replace("$", r"\$") if where else "")


def plain_symbol(symbol: str) -> str:
    """In plain text, for a paper: ``μ1``, ``C10 (A)``."""
    name, index, where = _parts(symbol)
    return f"{_GREEK.get(name, name)}{index}" + (f" ({where})" if where else "")


def _parts(symbol: str) -> tuple[str, str, str]:
    """Name, index and where it acts; the whole as the name where it is none of these."""
    front, _, where = symbol.partition("@")
    found = _PARTS.match(front)
    return (found[1], found[2], where) if found else (front, "", where)
