"""Order of test files by their relation to a source file: distance in the graph of imports, and shared names."""

from __future__ import annotations

import ast
import re
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from benchmarks.mutants.drawing import PACKAGES, Mutant

#: Largest distance between a test file and the source file, imports.
MAX_DISTANCE = 4
#: Decrease of the distance for a test file that mentions a function or class around the fault.
MENTION_BONUS = 2
#: Decrease of the distance for a test file whose name has a word of the path of the source file.
NAME_BONUS = 2
#: Fewest characters of a word that relates two files; shorter names have many meanings.
SHORTEST_WORD = 5
#: Words of paths without a relation to a subject.
_COMMON_WORDS = frozenset({"test", "init", "tissue", "scenes", "haptics", "calibration", "commands", "command",
                           "shared"})


@dataclass(frozen=True)
class ImportGraph:
    """Imports between the source files and test files of a repository.

    Attributes:
        root: root folder.
        imports: path of a file -> paths of the files that it imports; the conftest files of a test file count as
            imported.
    """

    root: Path
    imports: dict[str, frozenset[str]]

    @classmethod
    def read(cls, root: Path) -> ImportGraph:
        """Read the imports of all files, also those inside of functions."""
        files = sorted(path for folder in (*PACKAGES, "tests", "benchmarks") for path in (root / folder).rglob("*.py"))
        modules = {name: path.relative_to(root).as_posix() for path in files for name in _names_of(root, path)}
        public = {package: _public_names(root / package) for package in PACKAGES}
        imports = {}
        for path in files:
            own = path.relative_to(root).as_posix()
            names = set(_imported(ast.parse(path.read_bytes()), public))
            found = {modules[name] for name in names if name in modules}
            if path.name.startswith("test_"):
                found |= {(folder / "conftest.py").relative_to(root).as_posix() for folder in path.parents
                          if folder.is_relative_to(root / "tests") and (folder / "conftest.py").exists()}
            imports[own] = frozenset(found - {own})
        return cls(root, imports)

    def distances(self, path: str) -> dict[str, int]:
        """Smallest number of imports from each test file to a source file."""
        importers: dict[str, set[str]] = {}
        for importer, imported in self.imports.items():
            for each in imported:
                importers.setdefault(each, set()).add(importer)
        distance, queue = {path: 0}, deque([path])
        while queue:
            here = queue.popleft()
            for importer in sorted(importers.get(here, ())):
                if importer not in distance:
                    distance[importer] = distance[here] + 1
                    queue.append(importer)
        return {name: steps for name, steps in distance.items() if Path(name).name.startswith("test_")}


def related_tests(graph: ImportGraph, mutant: Mutant, count: int) -> list[str]:
    """Paths of the test files most related to a mutant, the most related first.

    Args:
        graph: imports of the repository.
        mutant: fault.
        count: largest number of files.
    """
    wanted = {name for name in mutant.names if len(name) >= SHORTEST_WORD}
    package, ranked = mutant.path.partition("/")[0], []
    for name, distance in graph.distances(mutant.path).items():
        if distance > MAX_DISTANCE:
            continue
        is_mentioned = bool(wanted & _words(graph.root / name))
        has_common_name = bool(_path_words(mutant.path) & _path_words(Path(name).name))
        rank = distance - MENTION_BONUS * is_mentioned - NAME_BONUS * has_common_name
        ranked.append((rank, not name.startswith(f"tests/{package}/"), name))
    return [name for *_, name in sorted(ranked)[:count]]


def _path_words(path: str) -> frozenset[str]:
    return frozenset(re.findall(r"[a-z]+", path.removesuffix(".py").replace("_", " "))) - _COMMON_WORDS


@cache
def _words(path: Path) -> frozenset[str]:
    return frozenset(re.findall(r"\w+", path.read_text(encoding="utf-8")))


def _names_of(root: Path, path: Path) -> Iterable[str]:
    """Names under which a file is imported; modules of the test folders are top-level modules."""
    parts = path.relative_to(root).with_suffix("").parts
    if parts[0] == "tests":
        return (parts[-1],)
    return (".".join(parts[:-1] if parts[-1] == "__init__" else parts),)


def _public_names(package: Path) -> dict[str, str]:
    """Public name of a package -> module that defines this name."""
    stub = package / "__init__.pyi"
    if not stub.exists():
        return {}
    lines = re.findall(r"^from (\S+) import (\w+)", stub.read_text(encoding="utf-8"), re.MULTILINE)
    return {name: module for module, name in lines}


def _imported(tree: ast.Module, public: dict[str, dict[str, str]]) -> Iterable[str]:
    """Names of the modules that a file imports, and of those whose public names it uses through a package."""
    aliases: dict[str, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name
                if alias.name in public:
                    aliases[alias.asname or alias.name] = alias.name
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            for alias in node.names:
                yield f"{node.module}.{alias.name}"
                yield public.get(node.module, {}).get(alias.name, node.module)
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in aliases:
            package = aliases[node.value.id]
            yield public[package].get(node.attr, package)
