"""Each example runs, its assertion on a physical number holds, and it draws a picture."""

import importlib.util
from pathlib import Path

import pytest
from matplotlib.figure import Figure

EXAMPLES = sorted((Path(__file__).resolve().parents[1] / "examples").glob("*.py"))
#: Longest example, lines.
LONGEST = 60


@pytest.mark.slow
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_example(path, tmp_path):
    source = path.read_text(encoding="utf-8")
    assert len(source.splitlines()) <= LONGEST
    assert "    assert " in source
    if "\nimport jax\n" in source:
        pytest.importorskip("jax", reason="JAX is an optional package: pip install 'tissue-sim[jax]'")
    spec = importlib.util.spec_from_file_location(f"example_{path.stem}", path)
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    figure = example.run()
    assert isinstance(figure, Figure) and figure.axes
    figure.savefig(tmp_path / "picture.png")


def test_there_are_examples():
    assert len(EXAMPLES) >= 12
