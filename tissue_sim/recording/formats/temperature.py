"""Check whether a table has a column of temperature, which is optional."""

from __future__ import annotations

from collections.abc import Mapping

from tissue_sim.recording.formats.number_text import is_number
from tissue_sim.recording.formats.sources import NumberTable
from tissue_sim.units import find_quantity_of_unit


def has_temperature(numbers: NumberTable, places: Mapping[str, int]) -> bool:
    """Return whether a table has a temperature in all rows.

    Args:
        numbers: table of numbers.
        places: role -> position of its column, from 0.
    """
    if "temperature" not in places:
        return False
    place = places["temperature"]
    unit = numbers.get_column_unit(place)
    if unit is not None and find_quantity_of_unit(unit) != "temperature":
        return False
    return all(place < len(row.cells) and is_number(row.cells[place]) for row in numbers.rows)
