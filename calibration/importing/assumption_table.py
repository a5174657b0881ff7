"""Format the assumptions of an import as a table for the terminal, the picture and the campaign."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from calibration.importing.imported import ImportedTest, list_assumptions_of_tests
from tissue_sim.errors import shortened

#: Headings of the columns of the table.
HEADINGS = ("assumption", "value", "evidence", "against", "or", "flag")


@dataclass(frozen=True)
class TableSettings:
    """Sizes of the table of assumptions.

    Attributes:
        campaign_width: largest number of characters in a line of a campaign.
        longest_value: largest number of characters of a value that is from a file.
    """

    campaign_width: int = 118
    longest_value: int = 60


#: Settings that the functions of this module use.
_SETTINGS = TableSettings()


class AssumptionRow(NamedTuple):
    """One assumption in words. `files` names the files that share it; empty: all."""

    files: str
    subject: str
    value: str
    evidence: str
    against: str
    alternatives: str
    flag: str
    is_question: bool

    @property
    def cells(self) -> tuple[str, ...]:
        """Cells of the row in the order of `HEADINGS`."""
        subject = f"{self.subject} ({self.files})" if self.files else self.subject
        return subject, self.value, self.evidence, self.against, self.alternatives, self.flag


def make_assumption_rows(tests: Sequence[ImportedTest]) -> list[AssumptionRow]:
    """Return one row for each assumption; files with the same assumption share a row."""
    found = list_assumptions_of_tests(tests)
    files = list(dict.fromkeys(name for name, _ in found))
    rows = []
    for each in dict.fromkeys(assumption for _, assumption in found):
        of = [name for name, assumption in found if assumption == each]
        names = "" if len(of) == len(files) else of[0] if len(of) == 1 else f"{of[0]} and {len(of) - 1} more"
        rows.append(AssumptionRow(
            names, each.subject, _to_one_line(each.value),
            "stated" if each.is_stated else _to_one_line("; ".join(each.evidence)),
            _to_one_line("; ".join(each.against)), _to_one_line("; ".join(
                f"{other.value}{_format_ratio(other.modulus_ratio)}" for other in each.alternatives)),
            _to_one_line(each.flag), each.needs_user_decision))
    return rows


def _format_ratio(modulus_ratio: float | None) -> str:
    """Return the factor of the modulus in brackets; empty for an unknown factor."""
    return "" if modulus_ratio is None else f" (modulus x {modulus_ratio:.3g})"


def _to_one_line(text: str) -> str:
    """Return the text on one line, with ``?`` for control characters."""
    return " ".join("".join(each if each.isprintable() or each.isspace() else "?" for each in text).split())


def format_campaign_comment(tests: Sequence[ImportedTest]) -> str:
    """Return the table as comments of a campaign, with the unused columns; empty without assumptions."""
    rows = make_assumption_rows(tests)
    if not rows:
        return ""
    lines = ["Assumptions, with evidence, values that also fit (or), and the flag of tissue-sim import that states "
             "each:"]
    for row in rows:
        subject, value, *_ = row.cells
        details = [row.evidence, f"against: {row.against}" if row.against else "",
                   f"or: {row.alternatives}" if row.alternatives else "", row.flag]
        said = "; ".join(filter(None, details))
        lines.append(f"{'QUESTION ' if row.is_question else ''}{subject}: {shortened(value, _SETTINGS.longest_value)}"
                     f"{f' ({said})' if said else ''}")
    lines += [f"Columns not used: {each}" for each in list_unused_columns(tests)]
    return "\n".join(textwrap.fill(line, _SETTINGS.campaign_width, initial_indent="# ", subsequent_indent="#     ",
                                   break_long_words=False, break_on_hyphens=False) for line in lines)


def wrap_assumptions(tests: Sequence[ImportedTest], width: int, most: int) -> list[str]:
    """Return the table as at most `most` lines of `width` characters: subject, value, evidence and alternatives."""
    rows = make_assumption_rows(tests)
    sizes = (36, 26, width - 36 - 26 - 4)
    lines = []
    for row in rows:
        subject, value, *_ = row.cells
        others = [f"or {row.alternatives}" if row.alternatives else "",
                  f"against: {row.against}" if row.against else "", row.evidence]
        cells = (f"{'? ' if row.is_question else ''}{subject}", value, "; ".join(filter(None, others)))
        padded = (f"{shortened(cell, size):<{size}}" for cell, size in zip(cells, sizes, strict=True))
        lines.append("  ".join(padded).rstrip())
    if len(lines) > most:
        lines = [*lines[:most - 1], f"and {len(lines) - most + 1} more assumptions (--json)"]
    return lines


def list_unused_columns(tests: Sequence[ImportedTest]) -> list[str]:
    """``file: 'column', ...`` of each file that has columns which are not read."""
    found: dict[str, dict[str, None]] = {}
    for test in tests:
        for part in test.parts:
            if part.reading.unused:
                found.setdefault(part.file.name, {}).update(dict.fromkeys(map(_to_one_line, part.reading.unused)))
    return [f"{name}: {', '.join(map(repr, columns))}" for name, columns in found.items()]
