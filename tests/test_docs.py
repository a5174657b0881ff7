"""The pages run as they stand: Python blocks in order in one namespace, `tissue-sim` lines through the command line.

Blocks marked ``text``, ``sh``, ``powershell``, ``toml`` and so on are not run.
"""

import importlib.util
import re
import shlex
from dataclasses import dataclass
from pathlib import Path

import pytest

from scenes.cli import main

#: Optional packages of pages, and why they may be missing.
OPTIONAL_PACKAGES = {
    "jax": "JAX is an optional package: pip install 'tissue-sim[jax]'",
    "torch": "PyPI has no wheel of PyTorch for Linux without 3 GB of NVIDIA's libraries"}
ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
COMMANDS = ('python -m pip install -e . && tissue-sim demo', 'python -m pip install -e ".[test]" && python -m pytest')
#: Pages of engines that an extra with the name of the page installs.
EXTRAS = ("mujoco", "newton")
_BLOCK = re.compile(r"^```(?P<language>\w+)[^\n]*\n(?P<text>.*?)^```\s*$", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"\]\((?!https?:)(?P<target>[^)#]+)(?:#[^)]*)?\)")


@dataclass(frozen=True)
class Block:
    language: str
    text: str
    line: int


def blocks(page: str) -> list[Block]:
    return [Block(match["language"], match["text"], page.count("\n", 0, match.start("text")) + 1)
            for match in _BLOCK.finditer(page)]


def commands(block: Block) -> list[str]:
    """The `tissue-sim` lines of a bash block; none where the block is of other commands.

    A block is of one kind: in a mixed one, a reader could not tell what is tested.
    """
    lines = [line.strip() for line in block.text.replace("\\\n", " ").splitlines()]
    lines = [line for line in lines if line and not line.startswith("#")]
    ours = [line for line in lines if line.startswith("tissue-sim ")]
    assert not ours or ours == lines, f"line {block.line}: a bash block mixes tissue-sim with other commands"
    return ours


def run_page(text: str, name: str) -> int:
    """Run a page in the current folder and return how many blocks ran."""
    namespace, ran = {"__name__": "__main__"}, 0
    for block in blocks(text):
        if block.language == "python":
            if missing_package(block):
                continue
            # The empty lines make a traceback point at the line of the page.
            exec(compile("\n" * (block.line - 1) + block.text, name, "exec"), namespace)
            ran += 1
        elif block.language == "bash":
            for line in commands(block):
                code = main(shlex.split(line, comments=True)[1:])
                assert code == 0, f"{name}, block at line {block.line}: {line!r} ended with {code}"
                ran += 1
    return ran


def missing_package(block: Block) -> str | None:
    """Name of an optional package that a block imports and that is not installed."""
    return next((name for name in OPTIONAL_PACKAGES
                 if f"import {name}\n" in block.text and importlib.util.find_spec(name) is None), None)


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_page_runs(page, tmp_path, monkeypatch):
    from tissue_sim import LAWS

    if page.stem in EXTRAS:
        pytest.importorskip(page.stem, reason=f"the page needs an engine: pip install tissue_sim[{page.stem}]")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    known = set(LAWS)
    before, text = listing(ROOT), page.read_text(encoding="utf-8")
    try:
        run_page(text, page.name)
    finally:
        for name in set(LAWS) - known:
            LAWS.unregister(name)
    assert listing(ROOT) == before, "a page must write into the current folder only"
    for block in blocks(text):
        if block.language == "python" and (name := missing_package(block)):
            pytest.skip(f"the other blocks of {page.name} ran; that of line {block.line} imports {name}: "
                        f"{OPTIONAL_PACKAGES[name]}")


def listing(folder: Path) -> set[Path]:
    return {path for path in folder.iterdir() if not path.name.startswith(".")}


def test_readme_really_runs_something(tmp_path, monkeypatch, capsys):
    """The forces of the quick start are those of the reference curve: 9.456 N at 10 mm, `fast` within 1 %."""
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    python = "".join(f"```python\n{block.text}```\n" for block in blocks(text) if block.language == "python")
    assert run_page(python, "README.md") == 2
    said = capsys.readouterr().out
    assert float(re.search(r"([\d.]+) N at 10 mm", said)[1]) == pytest.approx(9.456, rel=0.01)
    # The simulator: 1.5417 N at 2 mm in the reference curve.
    assert float(re.search(r"([\d.]+) N, \d+ N/m, in equilibrium", said)[1]) == pytest.approx(1.5417, rel=0.05)


@pytest.mark.parametrize("command", COMMANDS)
def test_command_stands_alone_on_one_line_of_its_own_block(command):
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert [block.text for block in blocks(text) if command in block.text] == [command + "\n"]


def test_ci_runs_the_command_of_the_readme():
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    pattern = re.search(r"command_two=\$\(grep -E '(.*)' README\.md\)", script)[1]
    found = re.findall(pattern, (ROOT / "README.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert found == [COMMANDS[1]]
    assert 'bash -euo pipefail -c "$command_two"' in script


@pytest.mark.parametrize("page", [*PAGES, ROOT / "CHANGELOG.md"], ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    text = _BLOCK.sub("", page.read_text(encoding="utf-8"))
    dead = [match["target"] for match in _LINK.finditer(text) if not (page.parent / match["target"]).exists()]
    assert not dead


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_tests_that_are_named_are_there(page):
    """A safety claim stands on the test that its line names."""
    for named in re.findall(r"`(tests/[\w/]+\.py(?:::\w+)+)`", page.read_text(encoding="utf-8")):
        path, *names = named.split("::")
        text = (ROOT / path).read_text(encoding="utf-8")
        missing = [name for name in names if not re.search(rf"^ *(?:def|class) {name}\b", text, re.MULTILINE)]
        assert not missing, named


def test_blocks_are_found_with_their_lines():
    page = "a\n```python\nx = 1\n```\n```text\nno\n```\n```bash\ntissue-sim doctor \\\n  --json\n```\n"
    found = blocks(page)
    assert [(block.language, block.line) for block in found] == [("python", 3), ("text", 6), ("bash", 9)]
    assert [shlex.split(command) for command in commands(found[2])] == [["tissue-sim", "doctor", "--json"]]


def test_a_page_that_fails_is_noticed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ZeroDivisionError):
        run_page("```python\n1 / 0\n```\n", "page")
    with pytest.raises(AssertionError, match="ended with 2"):
        run_page("```bash\ntissue-sim material show missing.json\n```\n", "page")
