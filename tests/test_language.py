"""Plain language: phrases that a reader needs to read twice are rare, and each public class has an explanation."""

import re

import pytest

#: Phrases of an everyday language in which one word has many meanings; the field has a term for each.
PHRASES = re.compile(r"""\b(
    anew|beside|nobody|somebody|gone\ on|goes?\ on|from\ near|by\ two\ rates|of\ its\ own|so\ many|so\ much
    |stands?\ (in\ for|for\ itself|for\ nothing)|(told|tells)\ of|is\ none\ of|comes?\ to\ (its|an)\ end
    |look(s|ed)\ at|lets?\ go|is\ let|what\ is\ left|as\ (it|they)\ came|the\ way\ (in|back|out)|there\ it
    )\b""", re.IGNORECASE | re.VERBOSE)
#: Allowed phrases per thousand lines; a few are right in their sentences.
ALLOWANCE = 1.0


@pytest.mark.parametrize("folder", ["tissue_sim", "calibration", "haptics", "scenes", "benchmarks", "tests", "docs"])
def test_riddles_are_rare(root, folder):
    found, lines = [], 0
    for path in sorted((root / folder).rglob("*")):
        if path.suffix not in (".py", ".md") or path.name == "test_language.py":
            continue
        text = path.read_text(encoding="utf-8")
        lines += text.count("\n")
        found += [f"{path.relative_to(root)}: {match[0]}" for match in PHRASES.finditer(text)]
    assert 1000 * len(found) <= ALLOWANCE * lines, "\n".join(found)
