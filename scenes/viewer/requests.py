"""Which requests need no obeying, and which changes of a material no new simulation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import tissue_sim as ts
from tissue_sim.errors import InputError
from tissue_sim.parameters import parameter_values, with_values


def superseded(command: str, values: dict[str, Any], later: list[tuple[str, Callable | None, dict[str, Any]]]) -> bool:
    """Whether a later request replaces this one: of those of a hand, and of one slider, only the newest counts.

    Args:
        command, values: of the request.
        later: those that have come since, as command, reply and values.
    """
    if command == "aim":
        return any(other == "aim" and values.keys() <= named.keys() for other, _, named in later)
    return (command == "set_parameters" and bool(later) and later[0][0] == command
            and later[0][2]["values"].keys() == values["values"].keys())


def differ_in_parameters_only(a: ts.Material, b: ts.Material) -> bool:
    """Whether one material becomes the other by changing numbers."""
    values = parameter_values(b)
    if parameter_values(a).keys() != values.keys():
        return False
    try:
        return replace(with_values(a, values), name=b.name) == b
    except InputError:  # on the way from one to the other
        return False
