"""Each example runs, its assertion on a physical number holds, and it draws a picture."""

import importlib.util
import re
from pathlib import Path

import pytest
from matplotlib.figure import Figure

EXAMPLES = sorted((Path(__file__).resolve().parents[1] / "examples").glob("*.py"))
#: Packages of extras that examples need; the extra `test` does not install them.
EXTRAS = ("mujoco", "newton", "jax")
#: Longest example, lines.
LONGEST = 60


@pytest.mark.slow
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_example(path, tmp_path):
    source = path.read_text(encoding="utf-8")
    assert len(source.splitlines()) <= LONGEST
    assert "    assert " in source
    for package in EXTRAS:
        if re.search(rf"^ *import {package}$", source, re.MULTILINE):
            pytest.importorskip(package, reason=f"the example needs an optional package: tissue_sim[{package}]")
    spec = importlib.util.spec_from_file_location(f"example_{path.stem}", path)
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    figure = example.run()
    assert isinstance(figure, Figure) and figure.axes
    figure.savefig(tmp_path / "picture.png")


def test_there_are_examples():
    assert len(EXAMPLES) >= 14
