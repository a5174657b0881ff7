"""Format the assumptions of an import as a table for the terminal, the picture and the campaign."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from calibration.importing.imported import ImportedTest, list_file_name_assumption_pairs
from tissue_sim.errors import shorten_text_in_middle

#: Headings of the columns of the table.
HEADINGS = ("assumption", "value", "evidence", "against", "or", "flag")


@dataclass(frozen=True)
class AssumptionTextLengthLimits:
    """Limits of text lengths in the table of assumptions.

    Attributes:
        campaign_width: largest number of characters in a line of a campaign.
        longest_value: largest number of characters of a value that is from a file.
    """

    campaign_width: int = 118
    longest_value: int = 60


#: Settings that the functions of this module use.
_TEXT_LENGTHS = AssumptionTextLengthLimits()


class AssumptionRow(NamedTuple):
    """Row of the table: one assumption as texts. `files` names the files that share the assumption; empty: all."""

    files: str
    subject: str
    value: str
    evidence: str
    against: str
    alternatives: str
    flag: str
    is_question: bool

    @property
    def cell_texts(self) -> tuple[str, ...]:
        """Cells of the row in the order of `HEADINGS`."""
        subject = f"{self.subject} ({self.files})" if self.files else self.subject
        return subject, self.value, self.evidence, self.against, self.alternatives, self.flag


def make_assumption_rows(tests: Sequence[ImportedTest]) -> list[AssumptionRow]:
    """Return one row for each assumption; files with the same assumption share a row."""
    found = list_file_name_assumption_pairs(tests)
    files = list(dict.fromkeys(name for name, _ in found))
    rows = []
    for each in dict.fromkeys(assumption for _, assumption in found):
        of = [name for name, assumption in found if assumption == each]
        names = "" if len(of) == len(files) else of[0] if len(of) == 1 else f"{of[0]} and {len(of) - 1} more"
        rows.append(AssumptionRow(
            names, each.subject, _make_single_line_text(each.value),
            "stated" if each.is_stated else _make_single_line_text("; ".join(each.evidence)),
            _make_single_line_text("; ".join(each.against)), _make_single_line_text("; ".join(
                f"{other.value}{_format_modulus_factor(other.modulus_ratio)}" for other in each.alternatives)),
            _make_single_line_text(each.flag), each.needs_user_decision))
    return rows


def _format_modulus_factor(modulus_ratio: float | None) -> str:
    """Format the factor by which an alternative changes the modulus as `` (modulus x 1.5)``; empty if it is None."""
    return "" if modulus_ratio is None else f" (modulus x {modulus_ratio:.3g})"


def _make_single_line_text(text: str) -> str:
    """Return a text with each white space replaced by one blank, and each control character by ``?``."""
    return " ".join("".join(each if each.isprintable() or each.isspace() else "?" for each in text).split())


def format_campaign_comment(tests: Sequence[ImportedTest]) -> str:
    """Format the assumptions and the unused columns as comment lines of a campaign; empty without assumptions."""
    rows = make_assumption_rows(tests)
    if not rows:
        return ""
    lines = ["Assumptions, with evidence, values that also fit (or), and the flag of tissue-sim import that states "
             "each:"]
    for row in rows:
        subject, value, *_ = row.cell_texts
        details = [row.evidence, f"against: {row.against}" if row.against else "",
                   f"or: {row.alternatives}" if row.alternatives else "", row.flag]
        said = "; ".join(filter(None, details))
        lines.append(f"{'QUESTION ' if row.is_question else ''}{subject}: "
                     f"{shorten_text_in_middle(value, _TEXT_LENGTHS.longest_value)}{f' ({said})' if said else ''}")
    lines += [f"Columns not used: {each}" for each in describe_unused_columns_of_each_file(tests)]
    return "\n".join(textwrap.fill(line, _TEXT_LENGTHS.campaign_width, initial_indent="# ", subsequent_indent="#     ",
                                   break_long_words=False, break_on_hyphens=False) for line in lines)


def format_shortened_table_lines(tests: Sequence[ImportedTest], width: int, most: int) -> list[str]:
    """Return the lines of the table: at most `most` lines of at most `width` characters, one for each assumption.

    Each line shows subject, value, alternatives and evidence; longer texts are shortened.
    """
    rows = make_assumption_rows(tests)
    sizes = (36, 26, width - 36 - 26 - 4)
    lines = []
    for row in rows:
        subject, value, *_ = row.cell_texts
        others = [f"or {row.alternatives}" if row.alternatives else "",
                  f"against: {row.against}" if row.against else "", row.evidence]
        cell_texts = (f"{'? ' if row.is_question else ''}{subject}", value, "; ".join(filter(None, others)))
        padded = (f"{shorten_text_in_middle(cell, size):<{size}}" for cell, size in zip(cell_texts, sizes, strict=True))
        lines.append("  ".join(padded).rstrip())
    if len(lines) > most:
        lines = [*lines[:most - 1], f"and {len(lines) - most + 1} more assumptions (--json)"]
    return lines


def describe_unused_columns_of_each_file(tests: Sequence[ImportedTest]) -> list[str]:
    """Return one text ``file: 'column', ...`` for each file that has columns which are not read."""
    found: dict[str, dict[str, None]] = {}
    for test in tests:
        for part in test.parts:
            if part.reading.unused:
                found.setdefault(part.file.name, {}).update(dict.fromkeys(map(_make_single_line_text,
                                                                              part.reading.unused)))
    return [f"{name}: {', '.join(map(repr, columns))}" for name, columns in found.items()]
