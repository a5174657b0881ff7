"""Format an imported campaign as TOML with the reason of each assumed line as a comment."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from calibration.importing.assumption_table import format_campaign_comment
from calibration.importing.imported import CampaignLine, ImportedTest
from calibration.report.drawing import format_count

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
    count = sum(len(part.motions) for test in tests for part in test.parts)
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
