"""Typeset the symbols of parameters: ``mu1@A`` becomes a Greek mu with index 1 that belongs to A."""

from __future__ import annotations

import re

_GREEK = {"alpha": "α", "beta": "β", "gamma": "γ", "delta": "δ", "epsilon": "ε", "eta": "η", "theta": "θ",
          "kappa": "κ", "lambda": "λ", "mu": "μ", "nu": "ν", "rho": "ρ", "sigma": "σ", "tau": "τ", "phi": "φ"}
_PARTS = re.compile(r"([A-Za-z]+)_?(\d*)$")


def get_symbol_letter_index_owner_and_slant(symbol: str) -> tuple[str, str, str, bool]:
    """Return a symbol in parts for a page, such as ``("μ", "1", "A", True)`` for ``mu1@A``.

    The parts are the letter or word, its index, the specimen, test or recording to which the symbol belongs (index and
    owner may be empty), and whether the letter is in italics.
    """
    name, index, owner = _split_symbol_name_index_and_owner(symbol)
    return _GREEK.get(name, name), index, owner, bool(index) or name in _GREEK


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
