"""Traps: changes of a raw file that mislead a reader, with the outcomes that are acceptable."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.raw_files.drafts import FORCES, LENGTHS, RATIOS, STRESSES, TIMES, Column, Draft
from benchmarks.raw_files.truth import KINDS, Test

#: All layouts.
ALL = ("table", "bluehill", "mts", "zwick", "exponent", "mach1", "mecmesin", "trios")
#: Layouts whose units and delimiters may be changed.
FREE = ("table", "bluehill", "mts", "zwick", "mecmesin")
#: Layouts in which an unusual cell or line is plausible.
PLAIN = ("table", "bluehill", "mecmesin")

OnTest = Callable[[Test, np.random.Generator], "Test | tuple[Test, tuple[float, ...]]"]
OnDraft = Callable[[Draft, np.random.Generator], None]


@dataclass(frozen=True)
class Trap:
    """Change of a raw file that misleads a reader, with the acceptable outcomes.

    Attributes:
        name: of it. area: ``numbers``, ``sizes``, ``meaning`` or ``signals``.
        groups: traps that share one do not stand in the same file.
        reasons: words (regular expressions) of a question or refusal that is to the point.
        wants_right: whether one reading is correct, so that a modulus is wanted; else no modulus follows from the file.
        note: words that a result must mention, such as the sample that was left out; empty: none.
        on_test: changes the test, before noise; it may return the test and the acceptable moduli, Pa.
        on_draft: changes the file.
        kinds, layouts: in which it may stand.
    """

    name: str
    area: str
    groups: frozenset[str]
    reasons: tuple[str, ...]
    wants_right: bool = True
    note: str = ""
    on_test: OnTest | None = None
    on_draft: OnDraft | None = None
    kinds: tuple[str, ...] = KINDS
    layouts: tuple[str, ...] = ALL


_FACTORS = {"displacement": LENGTHS, "force": FORCES, "time": TIMES, "stress": STRESSES, "strain": RATIOS}


def in_unit(column: Column, unit: str, decimals: int | None = None) -> Column:
    """Return the column in another unit, by default with six digits of its largest value."""
    if unit not in _FACTORS.get(column.role, {}):
        return column
    factors = _FACTORS[column.role]
    values = column.values * factors[column.unit or "mm"] / factors[unit]
    made = Column.of(column.role, column.name, unit, values, 6)
    return made if decimals is None else replace(made, decimals=decimals)


def change_columns(draft: Draft, change: Callable[[Column], Column]) -> None:
    """Apply a function to every column of every table."""
    for table in draft.tables:
        table.columns = [change(column) for column in table.columns]


def set_decimal(draft: Draft, decimal: str, delimiter: str) -> None:
    """Set another decimal mark and delimiter, also in the sizes."""
    other = "." if decimal == "," else ","
    draft.sizes = [[row[0], row[1].replace(other, decimal), *row[2:]] for row in draft.sizes]
    draft.decimal, draft.delimiter = decimal, delimiter


def rename_title(draft: Draft, title: str) -> None:
    """Put a title above everything else in place of the words that name the kind of test."""
    draft.head = [[title], *(row for row in draft.head if len(row) == 1 and row[0].startswith(("Bluehill", "testX")))]
