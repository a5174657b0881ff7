"""Format an imported campaign as TOML with the reasons of its lines, and its assumptions as a table.

The terminal, the picture of the import and the comments of the campaign show the table.
"""

from __future__ import annotations

import json
import math
import os
import re
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from calibration.importing.imported import CampaignLine, ImportedTest, list_file_name_assumption_pairs
from calibration.report.drawing import format_count
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


#: Character position of the comment with the reason. Longer lines have the comment in the previous line.
_REASON_POSITION = 44
#: A TOML key that needs no quotation marks.
_BARE = re.compile(r"[A-Za-z0-9_-]+")
#: Comment of a line whose value the user must state.
FILL_IN = "FILL IN"


def format_campaign(tests: Sequence[ImportedTest], specimens: Mapping[str, Sequence[CampaignLine]],
                    fit: Sequence[CampaignLine],
                  folder: Path, questions: Sequence[str] = ()) -> str:
    """Return the text of a campaign file (TOML); keys that all tests share are in ``[defaults]``.

    Args:
        tests: tests in the order of the file.
        specimens: name of a specimen -> its lines.
        fit: lines of ``[fit]``.
        folder: folder of the campaign; the paths of the recordings are relative to this folder.
        questions: open questions; a campaign with a question is refused.
    """
    count = sum(len(part.reading.recordings) for test in tests for part in test.parts)
    parts = [f"# Written by tissue-sim import from {format_count(count, 'recording')}. "
             "The comments give the reasons of the lines;\n# correct lines that are wrong."]
    parts += filter(None, [format_campaign_comment(tests)])
    if questions:
        parts.append(_format_toml_line(CampaignLine("questions", list(questions),
                                                    "import again with the flag in the question, or "
                                       "delete this key to accept the assumed values")))
    for name, lines in specimens.items():
        named = [CampaignLine("name", name)] if len(specimens) > 1 else []
        parts.append("\n".join(["[[specimen]]", *(_format_toml_line(each) for each in (*named, *lines))]))
    shared = _find_lines_common_to_tests([test.lines for test in tests]) if len(tests) > 1 else []
    columns = _find_lines_common_to_tests([test.columns for test in tests]) if len(tests) > 1 else []
    same_columns = bool(columns) and all(len(test.columns) == len(columns) for test in tests)
    if shared or same_columns:
        parts.append("\n".join(["[defaults]", *map(_format_toml_line, shared)]))
        if same_columns:
            parts.append("\n".join(["[defaults.columns]", *map(_format_toml_line, columns)]))
    for test in tests:
        specimen = [CampaignLine("specimen", test.specimen)] if test.specimen and len(specimens) > 1 else []
        own = [line for line in test.lines if not any(_have_equal_key_and_value(line, other) for other in shared)]
        files = [_make_path_relative_to_folder(part.file, folder) for part in test.parts]
        parts.append("\n".join(["[[test]]", *map(_format_toml_line, (CampaignLine("name", test.name), *specimen, *own)),
                                _format_toml_line(CampaignLine("recordings", list(dict.fromkeys(files)),
                                                               test.reason))]))
        if test.columns and not same_columns:
            parts.append("\n".join(["[test.columns]", *map(_format_toml_line, test.columns)]))
    parts.append("\n".join(["[fit]", *map(_format_toml_line, fit)]))
    return "\n\n".join(parts) + "\n"


def _find_lines_common_to_tests(lines: Sequence[Sequence[CampaignLine]]) -> list[CampaignLine]:
    """Return the lines of the first test whose key and value are the same in all tests."""
    return [line for line in lines[0]
            if all(any(_have_equal_key_and_value(line, other) for other in each) for each in lines[1:])]


def _have_equal_key_and_value(first: CampaignLine, second: CampaignLine) -> bool:
    """Return whether two lines have equal keys and values, whatever their reasons."""
    return (first.key, first.value) == (second.key, second.value)


def _format_toml_line(line: CampaignLine) -> str:
    """Return the text of a line of a campaign: ``key = value`` (TOML) with the reason as a comment.

    A line without a value becomes a comment that the user fills in.
    """
    reason = " ".join(line.reason.split())
    if line.value is None:
        return f"# {line.key} =   # {FILL_IN}: {reason}"
    text = f"{_format_toml_key(line.key)} = {format_toml_value(line.value)}"
    if not reason:
        return text
    return f"{text:<{_REASON_POSITION}}  # {reason}" if len(text) + len(reason) < 116 else f"# {reason}\n{text}"


def _format_toml_key(key: str) -> str:
    """Return a TOML key with quotation marks if necessary."""
    return key if _BARE.fullmatch(key) else format_toml_value(key)


def format_toml_value(value: Any) -> str:
    """Format a value as TOML; a long list has one item per line.

    Raises:
        ValueError: a number that is not finite.
    """
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        # A JSON string is a valid TOML string, except for the delete character.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, Mapping):
        pairs = (f"{_format_toml_key(str(key))} = {format_toml_value(item)}" for key, item in value.items())
        return f"{{ {', '.join(pairs)} }}"
    if isinstance(value, list | tuple):
        items = [format_toml_value(item) for item in value]
        one = f"[{', '.join(items)}]"
        return one if len(one) < 110 else "[\n" + "".join(f"    {item},\n" for item in items) + "]"
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"number in a campaign must be finite; got {value}. Leave out the key of an unknown value.")
    return repr(value)


def _make_path_relative_to_folder(file: Path, folder: Path) -> str:
    """Return the path of a file relative to a folder; the absolute path if the file is on another drive."""
    # Symbolic links are resolved first, because ".." also refers to the resolved folder.
    there = file.parent.resolve() / file.name
    try:
        return Path(os.path.relpath(there, folder.resolve())).as_posix()
    except ValueError:  # another drive
        return there.as_posix()
