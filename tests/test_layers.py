"""House rules that a machine can hold: who imports whom, encodings, lengths, names."""

import ast
import importlib
import subprocess
import sys
import tomllib
import zipfile
from collections import Counter
from collections.abc import Mapping
from functools import cache
from pathlib import Path

import grimp
import pytest
from hatchling.builders.wheel import WheelBuilder

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("tissue_sim", "calibration", "haptics", "scenes")
SOURCES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
IMPORTERS = {  # outside package -> where it may be imported
    "taichi": ("tissue_sim/fem/taichi/runtime.py",),
    "viser": ("scenes/",),
    "rich": ("scenes/", "calibration/"),
    "matplotlib": ("scenes/", "calibration/"),
    "jinja2": ("calibration/report/outputs.py",),
    "socket": ("haptics/", "scenes/doctor.py"),
}
#: What opens a file to read it, or parses what is in one; and who may: the doors, and readers of what is our own.
OPENING = {"read_bytes", "read_text", "loadtxt", "genfromtxt", "loads", "fromstring"}
DOORS = {
    "tissue_sim/decode.py", "tissue_sim/bounded.py",
    # Our sources and caches, the system's files, results of this program that it has just written.
    "tissue_sim/laws/derivation.py", "calibration/forward/simulation_cache.py", "calibration/job.py",
    "haptics/loop/loop.py", "scenes/viewer/page/scene_controls.py", "scenes/viewer/trace.py",
    "scenes/demo/hidden_effect_demo.py", "scenes/viewer/shell/__init__.py",
    # Bytes that come from a device or are measured already.
    "haptics/protocols/haply.py", "haptics/protocols/rdt.py", "haptics/protocols/ati_calibration.py",
    "tissue_sim/recording/formats/long_text.py"}
VAGUE_NAMES = {"utils", "util", "helpers", "helper", "manager", "core", "misc", "common", "work", "batch", "build"}
#: Lines of a file, and of a function outside kernels.
LONGEST_FILE = 600
LONGEST_FUNCTION = 120
#: Files of a folder, without `__init__.py`.
MOST_FILES = 20
#: Folders with one file per registered kind, which may have more.
KIND_FOLDERS = {"tissue_sim/recording/formats"}


def place(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@cache
def parsed(path: Path) -> ast.AST:
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def imported(path: Path) -> set[str]:
    """Top-level names of all modules that a source imports, wherever in it."""
    names = set()
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Import):
            names.update(alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names.add(node.module.split(".")[0])
    return names


def unencoded(tree: ast.AST) -> list[int]:
    """Lines that open a text file without saying its encoding."""
    lines = []
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call) or any(keyword.arg == "encoding" for keyword in node.keywords):
            continue
        match node.func:
            case ast.Attribute(attr="read_text" | "write_text"):
                lines.append(node.lineno)
            case ast.Attribute(value=ast.Name(id="os"), attr="open"):
                pass  # a file descriptor
            case ast.Attribute(value=ast.Name(id="archive"), attr="open"):
                pass  # bytes
            case ast.Name(id="open") | ast.Attribute(attr="open" | "fdopen"):
                if not any("b" in mode for mode in modes(node)):
                    lines.append(node.lineno)
    return lines


def modes(call: ast.Call) -> list[str]:
    """Literals of a call that read like the mode of a file."""
    values = [*call.args, *(keyword.value for keyword in call.keywords if keyword.arg == "mode")]
    return [value.value for value in values if isinstance(value, ast.Constant) and isinstance(value.value, str)
            and set(value.value) <= set("rwaxbt+")]


def test_import_contracts_hold():
    """The layers of pyproject.toml, by import-linter."""
    code = "import sys; sys.path.insert(0, '.'); from importlinter.cli import lint_imports; " \
           "sys.exit(lint_imports(no_cache=True))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, encoding="utf-8")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 broken" in done.stdout


@pytest.mark.parametrize("package", PACKAGES)
def test_architecture_shows_the_layers(package):
    """The pictures in the documentation are those of the contracts."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]
    layers, = (contract["layers"] for contract in settings["contracts"] if contract.get("containers") == [package])
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    picture = page.split(f"## Inside {package}\n")[1].split("```")[1].splitlines()[1:]
    assert [line.split("  ")[0] for line in picture] == layers


@pytest.mark.slow
@pytest.mark.parametrize("package", IMPORTERS)
def test_outside_package_is_imported_where_it_belongs(package):
    strangers = [place(path) for path in SOURCES
                 if package in imported(path)
                 and not place(path).startswith(IMPORTERS[package])]
    assert not strangers, f"{package} is imported in {strangers}; it belongs to {IMPORTERS[package]}"


def test_siblings_do_not_meet():
    for one, other in (("calibration", "haptics"), ("haptics", "calibration")):
        for path in (ROOT / one).rglob("*.py"):
            assert other not in imported(path), place(path)


def test_text_files_are_opened_with_an_encoding():
    found = {place(path): unencoded(parsed(path)) for path in SOURCES}
    assert not {name: lines for name, lines in found.items() if lines}


def test_encoding_check_sees_what_it_should():
    assert unencoded(ast.parse("path.open()\npath.read_text()\nopen(p, 'w')")) == [1, 2, 3]
    assert not unencoded(ast.parse("path.open('rb')\npath.read_text(encoding='utf-8')\nopen(p, mode='wb')"))


def functions(path: Path) -> list[ast.FunctionDef | ast.AsyncFunctionDef]:
    return [node for node in ast.walk(parsed(path)) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]


def holds_kernels(path: Path) -> bool:
    """Return whether a source contains Taichi kernels, which cannot be split into functions freely."""
    return any(ast.unparse(decorator).startswith(("ti.func", "ti.kernel")) for function in functions(path)
               for decorator in function.decorator_list)


def openings(tree: ast.AST) -> list[int]:
    """Lines that call something of `OPENING` of a path, numpy, or a parser."""
    return [node.lineno for node in ast.walk(tree) if isinstance(node, ast.Call)
            and isinstance(node.func, ast.Attribute) and node.func.attr in OPENING]


def test_files_of_others_come_in_by_the_doors():
    """A reader gets its bytes from `tissue_sim.files`, its JSON and TOML from `tissue_sim.decode`."""
    assert openings(ast.parse("path.read_bytes(); json.loads(text)")) == [1, 1]
    found = {place(path): openings(parsed(path)) for path in SOURCES}
    strays = {name: lines for name, lines in found.items() if lines and name not in DOORS}
    assert not strays, f"read_bytes, read_text, read_json_value or read_toml_dict instead: {strays}"
    assert not [name for name in DOORS if not found[name]], "an exception that no module needs"


def test_files_and_functions_are_short():
    long = [place(path) for path in SOURCES if len(path.read_text(encoding="utf-8").splitlines()) > LONGEST_FILE]
    assert not long, f"split {long}"
    long = [f"{function.name} of {place(path)}" for path in SOURCES if not holds_kernels(path)
            for function in functions(path) if function.end_lineno - function.lineno >= LONGEST_FUNCTION]
    assert not long, f"split {long}"


def test_folders_can_be_read_at_a_glance():
    files = Counter(place(path.parent) for path in SOURCES if path.name != "__init__.py")
    full = {folder: number for folder, number in files.items() if number > MOST_FILES}
    assert not set(full) - KIND_FOLDERS, f"merge files of one subject, or divide {full}"
    assert set(full) == KIND_FOLDERS, "an exception that no folder needs"


def test_names_say_what_is_meant():
    vague = [place(path) for path in SOURCES if {path.stem, path.parent.name} & VAGUE_NAMES]
    assert not vague, f"name {vague} after what they do"


def circles(imports: Mapping[str, set[str]]) -> list[list[str]]:
    """Modules that import each other, directly or through others, by Tarjan's algorithm."""
    number: dict[str, int] = {}
    lowest: dict[str, int] = {}
    path: list[str] = []
    closed: set[str] = set()
    circles = []

    def visit(module: str) -> None:
        number[module] = lowest[module] = len(number)
        path.append(module)
        for other in imports[module]:
            if other not in number:
                visit(other)
            if other not in closed:
                lowest[module] = min(lowest[module], lowest[other])
        if lowest[module] == number[module]:
            circle = path[path.index(module):]
            del path[-len(circle):]
            closed.update(circle)
            circles.extend([sorted(circle)] if len(circle) > 1 else [])

    for module in imports:
        if module not in number:
            visit(module)
    return circles


def test_no_circle_of_imports(monkeypatch):
    """Imports inside functions, and for the type checker alone, count."""
    monkeypatch.syspath_prepend(str(ROOT))
    graph = grimp.build_graph(*PACKAGES, cache_dir=None)
    assert not circles({module: graph.find_modules_directly_imported_by(module) for module in graph.modules})


def test_circles_are_seen():
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b", "d"}, "d": set()}) == [["b", "c"]]
    assert not circles({"a": {"b", "c"}, "b": {"c"}, "c": set()})


def test_wheel_holds_exactly_the_four_packages(tmp_path):
    """The wheel that hatchling builds of this tree, not what its settings say."""
    wheel, = WheelBuilder(str(ROOT)).build(directory=str(tmp_path), versions=["standard"])
    with zipfile.ZipFile(wheel) as archive:
        places = {name for name in archive.namelist() if ".dist-info/" not in name}
        entry_points, = (archive.read(name).decode("utf-8") for name in archive.namelist()
                         if name.endswith("entry_points.txt"))
    assert {name.split("/")[0] for name in places} == set(PACKAGES)
    assert {name for name in places if name.endswith(".py")} == {place(path) for path in SOURCES}
    assert {f"calibration/report/templates/{file}" for file in ("page.html", "style.css")} <= places
    # For the type checkers of programs that use them.
    assert {f"{package}/{file}" for package in PACKAGES for file in ("py.typed", "__init__.pyi")} <= places
    assert entry_points.split() == ["[console_scripts]", "tissue-sim", "=", "scenes.cli:main"]
    assert not list((ROOT / "tests").rglob("__init__.py"))


def test_no_public_name_is_also_a_module():
    """Importing the module would put it in the place of what the package names so."""
    for package in ("tissue_sim", "calibration"):
        names = set(importlib.import_module(package).__all__)
        modules = {path.stem for path in (ROOT / package).iterdir()}
        assert not names & modules - {"laws"}, package
