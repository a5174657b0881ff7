"""Write the text of a campaign, with the reason of each assumed line."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from calibration.importing.assumption_table import campaign_comment
from calibration.importing.imported import ImportedTest, Line
from calibration.report.drawing import format_count

#: Character position of the reason in a line that is short enough.
_REASON_POSITION = 44
_BARE = re.compile(r"[A-Za-z0-9_-]+")
FILL_IN = "FILL IN"


def campaign_text(tests: Sequence[ImportedTest], specimens: Mapping[str, Sequence[Line]], fit: Sequence[Line],
                  folder: Path, questions: Sequence[str] = ()) -> str:
    """Return the text of a campaign file (TOML); keys that all tests share are in ``[defaults]``.

    Args:
        tests: tests in order. specimens: name -> keys. fit: keys of ``[fit]``.
        folder: folder of the campaign; the paths of the recordings are relative to this folder.
        questions: open questions; a campaign with a question is refused.
    """
    count = sum(len(part.motions) for test in tests for part in test.parts)
    parts = [f"# Written by tissue-sim import from {format_count(count, 'recording')}. "
             "Behind a # stands why a line is as "
             "it is;\n# correct what is wrong."]
    parts += filter(None, [campaign_comment(tests)])
    if questions:
        parts.append(_line(Line("questions", list(questions), "import again with the flag that decides, or delete this "
                                "key to accept the assumed values")))
    for name, lines in specimens.items():
        named = [Line("name", name)] if len(specimens) > 1 else []
        parts.append("\n".join(["[[specimen]]", *(_line(each) for each in (*named, *lines))]))
    shared = _shared([test.lines for test in tests]) if len(tests) > 1 else []
    columns = _shared([test.columns for test in tests]) if len(tests) > 1 else []
    same_columns = bool(columns) and all(len(test.columns) == len(columns) for test in tests)
    if shared or same_columns:
        parts.append("\n".join(["[defaults]", *map(_line, shared)]))
        if same_columns:
            parts.append("\n".join(["[defaults.columns]", *map(_line, columns)]))
    for test in tests:
        specimen = [Line("specimen", test.specimen)] if test.specimen and len(specimens) > 1 else []
        own = [line for line in test.lines if not any(_equal(line, other) for other in shared)]
        files = [_place(part.file, folder) for part in test.parts]
        parts.append("\n".join(["[[test]]", *map(_line, (Line("name", test.name), *specimen, *own)),
                                _line(Line("recordings", list(dict.fromkeys(files)), test.reason))]))
        if test.columns and not same_columns:
            parts.append("\n".join(["[test.columns]", *map(_line, test.columns)]))
    parts.append("\n".join(["[fit]", *map(_line, fit)]))
    return "\n\n".join(parts) + "\n"


def _shared(lines: Sequence[Sequence[Line]]) -> list[Line]:
    """Return the lines that all tests have."""
    return [line for line in lines[0] if all(any(_equal(line, other) for other in each) for each in lines[1:])]


def _equal(first: Line, second: Line) -> bool:
    return (first.key, first.value) == (second.key, second.value)


def _line(line: Line) -> str:
    reason = " ".join(line.reason.split())
    if line.value is None:
        return f"# {line.key} =   # {FILL_IN}: {reason}"
    text = f"{_key(line.key)} = {toml_value(line.value)}"
    if not reason:
        return text
    return f"{text:<{_REASON_POSITION}}  # {reason}" if len(text) + len(reason) < 116 else f"# {reason}\n{text}"


def _key(key: str) -> str:
    return key if _BARE.fullmatch(key) else toml_value(key)


def toml_value(value: Any) -> str:
    """Format a value for a campaign, in one line or as a list of lines.

    Raises:
        ValueError: a number that is not finite.
    """
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        # TOML takes JSON's strings, but for the delete character.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_key(str(key))} = {toml_value(item)}" for key, item in value.items()) + " }"
    if isinstance(value, list | tuple):
        items = [toml_value(item) for item in value]
        one = f"[{', '.join(items)}]"
        return one if len(one) < 110 else "[\n" + "".join(f"    {item},\n" for item in items) + "]"
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{value} has no place in a campaign")
    return repr(value)


def _place(file: Path, folder: Path) -> str:
    """Return the path of a file in a campaign."""
    # Links of folders are followed, for ".." does so, too.
    there = file.parent.resolve() / file.name
    try:
        return Path(os.path.relpath(there, folder.resolve())).as_posix()
    except ValueError:  # another drive
        return there.as_posix()
