"""Drawing of mutants, and the choice of their tests; the trials of `python -m benchmarks mutants` take an hour."""

import ast
from collections import Counter
from itertools import product
from shutil import copyfile

import pytest

from benchmarks.mutants.drawing import KINDS, PACKAGES, draw, is_valid, mutants_of
from benchmarks.mutants.related_tests import ImportGraph, related_tests

pytestmark = pytest.mark.slow

#: Number of mutants: two of each kind in each package.
COUNT = 2 * len(PACKAGES) * len(KINDS)

SOURCE = b'''"""Text 1.0 - 2.0."""

def area(widths: list[3 - 2], height, n):
    if n < 0:
        raise ValueError(f"n must be positive; got {n - 1}.")
    return widths[0] * height * 1e-3 + 0.5
'''


#: A source file of each package, with all kinds of expressions.
SAMPLES = ("tissue_sim/rig/rig.py", "calibration/campaign/measured.py", "haptics/devices/motions.py",
           "scenes/figures.py")


@pytest.fixture(scope="module")
def tree(root, tmp_path_factory):
    """Repository with one source file in each package."""
    folder = tmp_path_factory.mktemp("tree")
    for name in SAMPLES:
        (folder / name).parent.mkdir(parents=True)
        copyfile(root / name, folder / name)
    return folder


@pytest.fixture(scope="module")
def drawn(tree):
    return draw(tree, 1, COUNT)


def test_equal_seeds_draw_equal_mutants(tree, drawn):
    assert draw(tree, 1, COUNT // 2) == drawn[:COUNT // 2]
    assert draw(tree, 2, COUNT) != drawn


def test_each_package_and_kind_is_drawn_equally_often_and_no_mutant_twice(drawn):
    counts = Counter((mutant.path.partition("/")[0], mutant.kind) for mutant in drawn)
    assert counts == dict.fromkeys(product(PACKAGES, KINDS), 2)
    assert len(set(drawn)) == COUNT


def test_each_mutant_is_another_valid_program(tree, drawn):
    for mutant in drawn:
        source = (tree / mutant.path).read_bytes()
        faulty = mutant.apply(source)
        assert ast.dump(ast.parse(faulty)) != ast.dump(ast.parse(source)), mutant
        assert source.splitlines()[mutant.line - 1] != faulty.splitlines()[mutant.line - 1], mutant


def test_faults_of_each_kind_in_a_function(tmp_path):
    path = tmp_path / "area.py"
    path.write_bytes(SOURCE)
    found = {(mutant.kind, mutant.line, mutant.before, mutant.after) for mutant in mutants_of(tmp_path, path)}
    assert found == {
        ("sign", 6, "widths[0] * height * 1e-3 + 0.5", "(widths[0] * height * 0.001 - 0.5)"),
        ("factor", 6, "widths[0] * height * 1e-3", "(widths[0] * height / 0.001)"),
        ("factor", 6, "widths[0] * height", "(widths[0] / height)"),
        ("factor", 6, "0.5", "1.0"),
        ("index", 6, "widths[0]", "widths[1]"),
        ("unit", 6, "1e-3", "1.0"),
        ("comparison", 4, "n < 0", "n > 0"),
        ("removed guard", 4, 'if n < 0:\n        raise ValueError(f"n must be positive; got {n - 1}.")', "pass"),
    }
    assert all(is_valid(mutant, SOURCE) and mutant.names == ("area",) for mutant in mutants_of(tmp_path, path))


def test_the_nearest_tests_come_first(tmp_path):
    files = {
        "tissue_sim/__init__.pyi": "from tissue_sim.area import area as area\n",
        "tissue_sim/__init__.py": "",
        "tissue_sim/area.py": SOURCE.decode(),
        "scenes/commands/area.py": "import tissue_sim as ts\nprint(ts.area)\n",
        "tests/conftest.py": "",
        "tests/scenes/test_area_command.py": "from scenes.commands import area as command\n",
        "tests/scenes/test_cli.py": "from scenes.commands.area import print\n",
        "tests/tissue_sim/test_sizes.py": "from tissue_sim.area import area\n",
        "tests/tissue_sim/test_others.py": "import tissue_sim\n",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text, encoding="utf-8")
    graph = ImportGraph.read(tmp_path)
    assert graph.distances("tissue_sim/area.py") == {
        "tests/tissue_sim/test_sizes.py": 1, "tests/scenes/test_area_command.py": 2, "tests/scenes/test_cli.py": 2}
    mutant = next(iter(mutants_of(tmp_path, tmp_path / "tissue_sim" / "area.py")))
    # The names of area and of its command are related, which counts as much as two imports.
    assert related_tests(graph, mutant, 2) == ["tests/scenes/test_area_command.py", "tests/tissue_sim/test_sizes.py"]
