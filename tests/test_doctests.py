"""Examples in docstrings run and print what they state."""

import doctest
import importlib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
#: Names of the modules whose docstrings contain examples.
MODULES = sorted(".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
                 for folder in ("tissue_sim", "calibration", "haptics", "scenes")
                 for path in (ROOT / folder).rglob("*.py") if ">>> " in path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", MODULES)
def test_examples_print_what_they_state(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)  # some examples write files
    results = doctest.testmod(importlib.import_module(name))
    assert results.attempted and not results.failed, capsys.readouterr().out
