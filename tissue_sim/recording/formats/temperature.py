"""Check whether a table has a column of temperature, which is optional."""

from __future__ import annotations

from collections.abc import Mapping

from tissue_sim.recording.formats.number_text import is_number_with_either_mark
from tissue_sim.recording.formats.sources import NumberTable
from tissue_sim.units import find_quantity_of_unit_or_none


def has_temperature_in_all_rows(numbers: NumberTable, places: Mapping[str, int]) -> bool:
    """Return whether a table has a temperature in all rows.

    Args:
        numbers: table of numbers.
        places: role -> position of its column, from 0.
    """
    if "temperature" not in places:
        return False
    place = places["temperature"]
    unit = numbers.get_unit_in_header_or_unit_row(place)
    if unit is not None and find_quantity_of_unit_or_none(unit) != "temperature":
        return False
    return all(place < len(row.cells) and is_number_with_either_mark(row.cells[place]) for row in numbers.rows)
