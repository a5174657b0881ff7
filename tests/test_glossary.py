"""The glossary of the documentation names every public class, in alphabetical order."""

import importlib
import inspect
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("tissue_sim", "calibration", "haptics", "scenes")
#: A public name in an `__init__.pyi`: module and name.
_PUBLIC_NAME = re.compile(r"^from (\S+) import (\w+) as \2$", re.MULTILINE)


def public_classes() -> set[str]:
    """Return the names of the classes that the packages export."""
    found = set()
    for package in PACKAGES:
        for module, name in _PUBLIC_NAME.findall((ROOT / package / "__init__.pyi").read_text(encoding="utf-8")):
            if inspect.isclass(getattr(importlib.import_module(module), name)):
                found.add(name)
    return found


def glossary_rows() -> list[tuple[list[str], str]]:
    """Return the names and the definition of each row of the table of classes."""
    text = (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8").split("## Public classes")[1]
    lines = [line for line in text.splitlines() if line.startswith("| `")]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return [(re.findall(r"`(\w+)`", names), definition) for names, _, definition in rows]


def test_every_public_class_is_in_the_glossary():
    named = {name for names, _ in glossary_rows() for name in names}
    assert not public_classes() - named


def test_every_row_names_a_public_class():
    classes = public_classes()
    assert not [names for names, _ in glossary_rows() if not classes & set(names)]


def test_rows_are_sorted_and_defined():
    rows = glossary_rows()
    first = [names[0].lower() for names, _ in rows]
    assert first == sorted(first)
    assert all(definition.endswith(".") for _, definition in rows)


def test_terms_are_sorted_and_unique():
    text = (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8")
    table = text.split("## Terms")[1].split("## Public classes")[0]
    terms = [line.split("|")[1].strip().lower() for line in table.splitlines() if line.startswith("| ")][1:]
    assert terms and terms == sorted(set(terms))
