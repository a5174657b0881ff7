"""Typeset the symbols of parameters: ``mu1@A`` becomes a Greek mu with index 1 that belongs to A."""

from __future__ import annotations

import re
from html import escape

_GREEK = {"alpha": "α", "beta": "β", "gamma": "γ", "delta": "δ", "epsilon": "ε", "eta": "η", "theta": "θ",
          "kappa": "κ", "lambda": "λ", "mu": "μ", "nu": "ν", "rho": "ρ", "sigma": "σ", "tau": "τ", "phi": "φ"}
_PARTS = re.compile(r"([A-Za-z]+)_?(\d*)$")


def format_html_symbol(symbol: str) -> str:
    """Return a symbol as HTML, such as ``μ<sub>1</sub>``, with its specimen, test or recording in brackets."""
    name, index, owner = _split_symbol_name_index_and_owner(symbol)
    letter = f"<i>{escape(_GREEK.get(name, name))}</i>" if index or name in _GREEK else escape(name)
    return letter + (f"<sub>{index}</sub>" if index else "") + (f" ({escape(owner)})" if owner else "")


def format_mathtext_symbol(symbol: str) -> str:
    """Return a symbol as matplotlib mathtext (subscripts, Greek letters), with its specimen, test or recording."""
    name, index, owner = _split_symbol_name_index_and_owner(symbol)
    if not index and name not in _GREEK:
        return symbol.replace("$", r"\$")
    letter = f"\\{name}" if name in _GREEK else name
    index = f"_{{{index}}}" if index else ""
    return f"${letter}{index}$" + (f" ({owner})".replace("$", r"\$") if owner else "")


def format_plain_symbol(symbol: str) -> str:
    """Return a symbol in plain text, such as ``μ1`` or ``C10 (A)``."""
    name, index, owner = _split_symbol_name_index_and_owner(symbol)
    return f"{_GREEK.get(name, name)}{index}" + (f" ({owner})" if owner else "")


def _split_symbol_name_index_and_owner(symbol: str) -> tuple[str, str, str]:
    """Split a symbol into name, index and owner; a symbol of another form is returned as the name without index."""
    front, _, owner = symbol.partition("@")
    found = _PARTS.match(front)
    return (found[1], found[2], owner) if found else (front, "", owner)
