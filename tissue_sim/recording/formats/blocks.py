"""Blocks of numbers in a table: replicates beside or below each other, with their rows of names and units."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from tissue_sim.recording.formats.header import find_header, find_numbers, matches, places_of
from tissue_sim.recording.formats.table import Row, Table, is_number
from tissue_sim.units import known_unit


@dataclass(frozen=True)
class Block:
    """One table of numbers.

    Attributes:
        header: the row of names; the first row of numbers where nothing is named.
        units: the row below it that holds units; None: there is none.
        rows: of numbers.
        places: from 0, of the wanted columns, in the order in which they were asked for.
        below: whether it stands below another one, in the same columns.
    """

    header: Row
    units: Row | None
    rows: tuple[Row, ...]
    places: tuple[int, ...]
    below: bool = False

    def unit(self, place: int) -> str | None:
        """In the row of units."""
        return None if self.units is None or place >= len(self.units.cells) else known_unit(self.units.cells[place])


def named_blocks(tables: Iterable[Table], names: Sequence[str], *, also: Sequence[int] = (),
                 file: Path) -> tuple[Table, list[Block]]:
    """The first table with a row that has all the names, and its blocks.

    Each such row begins blocks: as many beside each other as it has each name. A block ends with the last row that has
    a number in one of its columns; a row of units below the names is no part of the numbers.

    Args:
        tables: to look through. names: of columns. also: places from 0 of further columns. file: for messages.

    Raises:
        InputError: no such row.
    """
    table, header, below = find_header(tables, names, file=file)
    # A row of names has none of the numbers: most rows are done with at one look.
    place = matches(header.cells, names[0])[0]
    headers = [header, *(row for row in below if not _numbers(row, (place,))
                         and all(matches(row.cells, name) for name in names))]
    blocks: list[Block] = []
    for number, head in enumerate(headers):
        end = headers[number + 1].line if number + 1 < len(headers) else None
        rows = [row for row in below if row.line > head.line and (end is None or row.line < end)]
        for places in zip(*places_of(head, names, file=file), strict=True):
            wanted = (*places, *also)
            units, data = _below_header(rows, wanted)
            blocks.append(Block(head, units, tuple(data), wanted, below=number > 0))
    return table, blocks


def placed_blocks(tables: Iterable[Table], places: Sequence[int], *, file: Path) -> tuple[Table, list[Block]]:
    """The first table with a row that has a number at each place, and its blocks: rows without any number end one.

    Raises:
        InputError: no such row.
    """
    table, header, rows = find_numbers(tables, places, file=file)
    runs = [run for run in _runs(rows, places) if any(_numbers(row, places) == len(places) for row in run)]
    return table, [Block(header if i == 0 else run[0], None, tuple(run), tuple(places), below=i > 0)
                   for i, run in enumerate(runs)]


def _below_header(rows: list[Row], places: Sequence[int]) -> tuple[Row | None, list[Row]]:
    """The row of units, and the rows of numbers."""
    first = next((i for i, row in enumerate(rows) if _numbers(row, places)), len(rows))
    units = next((row for row in rows[:first] if is_unit_row(row, places)), None)
    # Words alone in the first row are a typing error as in any other; a second row of names is not.
    rows = rows[first:] if first < len(rows) else rows
    runs = _runs(rows, places)
    whole = [any(_numbers(row, places) == len(places) for row in run) for run in runs]
    # Below the numbers stand remarks; what interrupts them is refused where it is read.
    return units, runs[0] if runs and not any(whole[1:]) else rows


def is_unit_row(row: Row, places: Sequence[int]) -> bool:
    """Whether cells at the places hold units, all of them that hold anything; a bracket says so of any word."""
    cells = [row.cells[place] for place in places if place < len(row.cells) and row.cells[place]]
    return bool(cells) and all(known_unit(cell) or cell[0] in "[(" for cell in cells)


def _runs(rows: Iterable[Row], places: Sequence[int]) -> list[list[Row]]:
    runs: list[list[Row]] = [[]]
    for row in rows:
        if _numbers(row, places):
            runs[-1].append(row)
        elif runs[-1]:
            runs.append([])
    return [run for run in runs if run]


def _numbers(row: Row, places: Sequence[int]) -> int:
    return sum(place < len(row.cells) and is_number(row.cells[place]) for place in places)
