"""Find the decimal mark and the thousands separator of a table from all its values."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from tissue_sim.recording.formats.assumption import AlternativeValue, Assumption
from tissue_sim.recording.formats.number_text import (
    DECIMAL_MARKS,
    TextOfNumericCell,
    find_thousands_separator_or_empty,
    parse_number_or_nan,
)


@dataclass(frozen=True)
class DecimalMarkSettings:
    """Settings of `detect_decimal_and_thousands_marks`.

    Attributes:
        damaged_fraction: largest fraction of the cells of a column that may contradict an interpretation: one damaged
            cell in a hundred.
        roughness_ratio: ratio of the roughness of two interpretations of a column, above which the smoother one is
            used.
        jump_roughness: roughness of an interpretation (sum of second differences over range) with at least one jump.
        digits_decide: log-likelihood ratio above which the number of digits decides (1 : 100).
        three_decimals: log-likelihood of one more value with exactly three decimals if trailing zeros are omitted (9 of
            10 values have three).
        no_mark: log-likelihood ratio of a value without a mark among values that all have three decimals (1 of 1000).
        zero_without_mark: log-likelihood ratio of a zero without a mark, because some programs write zeros without
            decimals.
        most_short: number of values with three decimals from which one with fewer decimals is unlikely if trailing
            zeros are omitted.
        fewest_marked: fewest values with a mark for which the number of digits decides.
    """

    damaged_fraction: float = 0.01
    roughness_ratio: float = 2.0
    jump_roughness: float = 1.0
    digits_decide: float = math.log(100.0)
    three_decimals: float = -math.log(0.9)
    no_mark: float = math.log(1000.0)
    zero_without_mark: float = math.log(10.0)
    most_short: int = 30
    fewest_marked: int = 3


#: Settings that the functions of this module use.
_SETTINGS = DecimalMarkSettings()
#: Decimal mark -> name in messages.
DECIMAL_WORDS = {".": "a decimal point", ",": "a decimal comma"}
#: Thousands separator -> name in messages.
_SEPARATORS = {" ": "a blank", "'": "an apostrophe", ",": "a comma", ".": "a point"}
#: Mark -> pattern of the mark at a position where a thousands separator is impossible.
_NO_GROUP = {mark: re.compile(rf"{re.escape(mark)}(?!\d{{3}}(?!\d))|(?<![\d.,])0{re.escape(mark)}")
             for mark in DECIMAL_MARKS}
#: A number with a decimal mark, followed by a unit of length.
_QUANTITY = re.compile(r"(?<![\d.,])\d+(?P<mark>[.,])(?!\d{3}\b)\d+\s*[\[(]?(mm|cm|m|µm|um|in)\b")


@dataclass(frozen=True)
class DecimalAndThousandsMarks:
    """Decimal mark and thousands separators of the numbers of a table.

    Attributes:
        decimal: decimal mark, ``"."`` or ``","``.
        thousands: thousands separators that occur (blanks and apostrophes as ASCII characters).
        evidence: sentences that support the decimal mark.
        against: sentences that contradict the decimal mark.
        is_certain: whether single cells exclude the other decimal mark; false for a table without marks.
        is_open: whether both decimal marks are possible.
        is_stated: whether the user stated the decimal mark.
        example: first cell with another value for the other decimal mark; empty without such a cell.
    """

    decimal: str = "."
    thousands: str = ""
    evidence: tuple[str, ...] = ()
    against: tuple[str, ...] = ()
    is_certain: bool = False
    is_open: bool = False
    is_stated: bool = False
    example: str = ""

    @property
    def other_decimal_mark(self) -> str:
        """The decimal mark other than `decimal`: a comma for a point, and a point for a comma."""
        return _get_other_decimal_mark(self.decimal)

    @property
    def question_text(self) -> str:
        """The question to the user if both decimal marks are possible, in one sentence."""
        return (f"{self.example!r} is {_parse_cell_and_format_number(self.example, '.')} with a decimal point and "
                f"{_parse_cell_and_format_number(self.example, ',')} with a decimal comma, and the values fit both")

    def list_assumptions(self) -> tuple[Assumption, ...]:
        """Return decimal mark and thousands separator with their evidence; empty if no number has a mark."""
        if not self.example and not self.thousands and not self.evidence:
            return ()
        reading = f"{self.example!r} is {_parse_cell_and_format_number(self.example, self.decimal)}"
        mark = self.other_decimal_mark
        other = f"{DECIMAL_WORDS[mark]}: {self.example!r} is {_parse_cell_and_format_number(self.example, mark)}"
        alternatives = (AlternativeValue(other, None, f'--decimal "{mark}"'),) if self.is_open else ()
        value = f"{DECIMAL_WORDS[self.decimal]}: {reading}" if self.is_open else DECIMAL_WORDS[self.decimal]
        found = [Assumption("decimal mark", value, self.evidence, self.against, alternatives,
                            f'--decimal "{self.decimal}"', self.is_stated)]
        if self.thousands:
            named = " and ".join(_SEPARATORS[mark] for mark in self.thousands)
            found.append(Assumption("thousands separator", named, (*((reading,) if self.example else ()),
                                                                   *self.evidence),
                                    flag=f'--decimal "{self.decimal}"', is_stated=self.is_stated))
        return tuple(found)


@dataclass(frozen=True)
class _DecimalMarkVoteOfColumn:
    """Decimal mark that the values of a column support (None: both), with the evidence."""

    decimal: str | None
    reason: str = ""
    is_certain: bool = False
    example: str = ""


def detect_decimal_and_thousands_marks(used: Iterable[Sequence[str]], others: Iterable[Sequence[str]] = (), *,
                                       delimiter: str | None = None,
                                       stated: str | None = None) -> DecimalAndThousandsMarks:
    """Find the decimal mark of a table.

    Args:
        used: cells of each column that is read.
        others: cells of each other column of numbers; examined only if the used columns do not determine the mark.
        delimiter: delimiter of a text. In cells between commas, a point is the decimal mark unless the values
            contradict.
        stated: decimal mark as the user states; None: the mark is found.
    """
    columns = [list(cells) for cells in used]
    if stated is not None:
        return _add_thousands_separators(DecimalAndThousandsMarks(stated, evidence=("stated",), is_stated=True,
                                                                  example=_find_first_ambiguous_cell_or_empty(columns)),
                                         columns)
    votes = [vote for cells in columns if (vote := _collect_column_evidence_or_none(cells)) is not None]
    if not votes:
        return _add_thousands_separators(DecimalAndThousandsMarks(), columns)
    example = next((vote.example for vote in votes if vote.example), "")
    deciding = [vote for vote in votes if vote.decimal is not None]
    if not deciding:
        deciding = [vote for cells in others
                    if (vote := _collect_column_evidence_or_none(list(cells))) is not None and vote.decimal is not None]
    chosen = {vote.decimal for vote in deciding}
    if len(chosen) == 1:
        decimal = deciding[0].decimal or "."
        reasons = tuple(dict.fromkeys(vote.reason for vote in deciding))[:2]
        found = DecimalAndThousandsMarks(decimal, "", reasons, is_certain=any(vote.is_certain for vote in deciding),
                                         example=example)
    elif chosen:
        found = _choose_mark_from_contradictory_votes(deciding, example)
    else:
        mark = next(each for each in DECIMAL_MARKS if each in example)
        sure = delimiter == "," and mark == "."
        reasons = ("the cells are separated by commas",) if sure else ()
        found = DecimalAndThousandsMarks(mark, "", reasons, is_open=not sure, example=example)
    return _add_thousands_separators(found, columns)


def resolve_marks_by_quantities_outside_table(marks: DecimalAndThousandsMarks, text: str) -> DecimalAndThousandsMarks:
    """Resolve ambiguous marks by quantities with units in the text outside of the table, if these have one mark."""
    found = {match["mark"]: match[0] for match in _QUANTITY.finditer(text)}
    if len(found) != 1:
        return marks
    (mark, quantity), = found.items()
    return replace(marks, decimal=mark, is_open=False,
                   thousands="".join({*marks.example} & {_get_other_decimal_mark(mark)}),
                   evidence=(f"{quantity!r} outside of the table has {DECIMAL_WORDS[mark]}",))


def _choose_mark_from_contradictory_votes(votes: Sequence[_DecimalMarkVoteOfColumn],
                                          example: str) -> DecimalAndThousandsMarks:
    """Return the decimal mark of the most certain vote; both marks remain possible unless both are certain.

    If both marks are certain, reading the cells raises an error with the line of the cell.
    """
    best = max(votes, key=lambda vote: vote.is_certain)
    against = tuple(dict.fromkeys(vote.reason for vote in votes if vote.decimal != best.decimal))[:2]
    certain = all(any(vote.decimal == mark and vote.is_certain for vote in votes) for mark in DECIMAL_MARKS)
    doubted = next((vote.example for vote in votes if vote.decimal != best.decimal and vote.example), example)
    return DecimalAndThousandsMarks(best.decimal or ".", "", (best.reason,), against, is_certain=certain,
                                    is_open=not certain,
                                    example=doubted)


def _add_thousands_separators(marks: DecimalAndThousandsMarks,
                              columns: Iterable[Sequence[str]]) -> DecimalAndThousandsMarks:
    """Return the marks with the thousands separators that occur in the columns."""
    seen: dict[str, str] = {}
    for cells in columns:
        text = "\n".join(cells)
        if marks.other_decimal_mark in text or not text.isascii() or " " in text or "'" in text:
            for cell in cells:
                if separator := find_thousands_separator_or_empty(cell, marks.decimal):
                    seen.setdefault(separator, cell)
                    if not marks.is_certain and not marks.example:
                        break
    if not seen:
        return marks
    return replace(marks, thousands="".join(sorted(seen)), example=marks.example or next(iter(seen.values())))


def _find_first_ambiguous_cell_or_empty(columns: Iterable[Sequence[str]]) -> str:
    """Return the first cell whose value depends on the decimal mark, such as ``1,234``; else an empty text."""
    return next((cell for cells in columns for cell in cells if _does_value_depend_on_mark(cell)), "")


def _does_value_depend_on_mark(cell: str) -> bool:
    """Return whether a cell gives different numbers with a decimal point and with a decimal comma."""
    if isinstance(cell, TextOfNumericCell) or not ("." in cell or "," in cell):
        return False
    point, comma = parse_number_or_nan(cell, "."), parse_number_or_nan(cell, ",")
    return not (math.isnan(point) or math.isnan(comma)) and point != comma


def _collect_column_evidence_or_none(cells: Sequence[str]) -> _DecimalMarkVoteOfColumn | None:
    """Return the evidence of the values of one column; None: no value has a point or comma."""
    text = "\n".join(cell for cell in cells if not isinstance(cell, TextOfNumericCell))
    marks = [mark for mark in DECIMAL_MARKS if mark in text]
    if not marks:
        return None
    if len(marks) == 1:
        mark, = marks
        uses = text.count(mark)
        odd = sum(1 for _ in islice(_NO_GROUP[mark].finditer(text), 1 + int(_count_tolerated_damaged_cells(uses))))
        if odd > _count_tolerated_damaged_cells(uses):
            found = _NO_GROUP[mark].search(text)
            cell = "" if found is None else _get_line_text_at_character(text, found.start())
            zero = cell.lstrip("+-").startswith(f"0{mark}")
            why = "a zero before its mark" if zero else "no group of three digits after its mark"
            return _DecimalMarkVoteOfColumn(mark, f"{cell!r} has {why}", True)
    return _collect_evidence_of_values_or_none(cells)


def _count_tolerated_damaged_cells(count: int) -> float:
    """Return how many of `count` cells may be unreadable before a decimal mark is excluded."""
    return max(1.0, _SETTINGS.damaged_fraction * count) if count > _SETTINGS.fewest_marked else 0.0


def _get_line_text_at_character(text: str, position: int) -> str:
    """Return the line of a text that contains the character at index `position`."""
    return text[text.rfind("\n", 0, position) + 1:].partition("\n")[0]


def _collect_evidence_of_values_or_none(cells: Sequence[str]) -> _DecimalMarkVoteOfColumn | None:
    """Return the evidence of the values of one column, from each value and from the jumps between values."""
    cells = [cell for cell in cells if cell]
    readings = {mark: np.array([parse_number_or_nan(cell, mark) for cell in cells]) for mark in DECIMAL_MARKS}
    marked = np.array([not isinstance(cell, TextOfNumericCell) and ("." in cell or "," in cell) for cell in cells])
    known = {mark: np.isfinite(values) for mark, values in readings.items()}
    number = marked & (known["."] | known[","])
    refused = {mark: number & ~known[mark] for mark in DECIMAL_MARKS}
    differing = known["."] & known[","] & (readings["."] != readings[","])
    example = cells[int(np.argmax(differing))] if differing.any() else ""
    if not number.any():
        return None
    smoother = _find_smoother_mark(readings, known["."] & known[","]) if example else None
    if smoother is not None and refused[smoother].sum() <= _count_tolerated_damaged_cells(int(number.sum())):
        other = _get_other_decimal_mark(smoother)
        jumps = f"{_describe_largest_jump(cells, readings, smoother)} with {DECIMAL_WORDS[other]}"
        return _DecimalMarkVoteOfColumn(smoother, jumps, bool(refused[other].any()) and not refused[smoother].any(),
                                        example)
    fewest = min(DECIMAL_MARKS, key=lambda mark: int(refused[mark].sum()))
    if refused[_get_other_decimal_mark(fewest)].any():
        if example and not refused[fewest].any() and _may_cells_be_damaged(cells,
                                                                           refused[_get_other_decimal_mark(fewest)],
                                                                           int(number.sum())):
            return _DecimalMarkVoteOfColumn(None, example=example)
        return _DecimalMarkVoteOfColumn(fewest,
                                        _describe_first_cell_readable_with_one_mark(
                                            cells, refused[_get_other_decimal_mark(fewest)],
                                            fewest), True, example)
    return _collect_evidence_if_all_have_three_digits(cells, marked, readings, example) if example else None


def _get_other_decimal_mark(mark: str) -> str:
    """Return the other decimal mark."""
    return "," if mark == "." else "."


def _may_cells_be_damaged(cells: Sequence[str], refused: np.ndarray, count: int) -> bool:
    """Return whether the cells that a mark cannot read may be damaged: they are few, and none begins with zero."""
    odd = [cell for cell, is_odd in zip(cells, refused.tolist(), strict=True) if is_odd]
    return len(odd) <= _SETTINGS.damaged_fraction * count + 1 and count > _SETTINGS.most_short and not any(
        cell.lstrip("+-").startswith("0") for cell in odd)


def _describe_first_cell_readable_with_one_mark(cells: Sequence[str], refused: np.ndarray, mark: str) -> str:
    """Return the sentence about the first cell that is a number with only one decimal mark."""
    return f"{cells[int(np.argmax(refused))]!r} is a number only with {DECIMAL_WORDS[mark]}"


def _collect_evidence_if_all_have_three_digits(cells: Sequence[str], marked: np.ndarray,
                                               readings: dict[str, np.ndarray],
                                               example: str) -> _DecimalMarkVoteOfColumn:
    """Return the evidence for the decimal mark if exactly three digits follow each mark, as with thousands.

    Values below 1000 without a mark support a thousands separator.
    """
    mark = next(each for each in DECIMAL_MARKS if each in example)
    count = int(marked.sum())
    unmarked = [cell for cell, has_mark in zip(cells, marked, strict=True)
                if not has_mark and not isinstance(cell, TextOfNumericCell)]
    plain = np.abs([parse_number_or_nan(cell) for cell in unmarked])
    large = next((cell for cell, value in zip(unmarked, plain, strict=True) if value >= 1000.0), None)
    if large is not None and (len(large.lstrip("+-")) > 4
                              or (readings[_get_other_decimal_mark(mark)][marked] < 10_000.0).any()):
        return _DecimalMarkVoteOfColumn(mark, f"{large!r} has no thousands separator", False, example)
    plain = plain[np.isfinite(plain)]
    zeros = int((plain == 0.0).sum())
    evidence = (count * _SETTINGS.three_decimals + (_SETTINGS.no_mark if plain.size > zeros else 0.0)
                + (_SETTINGS.zero_without_mark if zeros else 0.0))
    if plain.size and count >= _SETTINGS.fewest_marked and evidence > _SETTINGS.digits_decide:
        return _DecimalMarkVoteOfColumn(_get_other_decimal_mark(mark),
                                        f"all {count} values from 1000 have exactly three digits after each "
                                        f"mark, and {plain.size} smaller "
                                        f"{'value has' if plain.size == 1 else 'values have'} no mark",
                                        False, example)
    return _DecimalMarkVoteOfColumn(None, example=example)


def _find_smoother_mark(readings: dict[str, np.ndarray], known: np.ndarray) -> str | None:
    """Return the decimal mark with smooth values if the other mark gives a jump; None: no mark is smoother."""
    rough = {mark: _compute_roughness(values[known]) for mark, values in readings.items()}
    smooth, other = sorted(rough, key=lambda mark: rough[mark])
    if rough[other] >= _SETTINGS.jump_roughness and rough[other] > _SETTINGS.roughness_ratio * rough[smooth]:
        return smooth
    return None


def _compute_roughness(values: np.ndarray) -> float:
    """Return the sum of the absolute second differences over the range; 0 for constant values."""
    extent = float(np.ptp(values)) if values.size > 2 else 0.0
    return float(np.abs(np.diff(values, 2)).sum() / extent) if extent > 0 else 0.0


def _describe_largest_jump(cells: Sequence[str], readings: dict[str, np.ndarray], smoother: str) -> str:
    """Return a clause about the largest jump between two cells if they are read with the mark other than `smoother`."""
    rough = readings[_get_other_decimal_mark(smoother)]
    steps = np.abs(np.diff(rough))
    jump = int(np.nanargmax(steps)) if np.isfinite(steps).any() else 0
    return (f"the column jumps from {cells[jump]!r} to {cells[jump + 1]!r}, while the neighbours change evenly, if "
            "read")


def _parse_cell_and_format_number(cell: str, decimal: str) -> str:
    """Return the number in a cell with up to twelve digits."""
    return f"{parse_number_or_nan(cell, decimal):.12g}"
