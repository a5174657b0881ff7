"""List the benchmarks, run one, or renew the tables of documentation pages.

    python -m benchmarks                              list all names
    python -m benchmarks NAME [--quick] [--json]      run one; `NAME --help` lists its options
    python -m benchmarks report [NAME ...]            run the benchmarks that pages name, and write their tables

`--markdown` before NAME prints Markdown tables instead of those of a terminal.
A name is that of a module with a function `main`, or that of a folder whose `__main__` has one.
"""

from __future__ import annotations

import ast
import importlib
import os
import sys

from benchmarks import MARKDOWN, ROOT

#: Folder of the benchmarks.
FOLDER = ROOT / "benchmarks"
#: Exit code of a command line that cannot be run.
USAGE_ERROR = 2


def modules() -> dict[str, str]:
    """Module of each benchmark, by name: ``{"needle": "benchmarks.peers.needle", ...}``.

    Raises:
        SystemExit: two benchmarks have the same name.
    """
    found: dict[str, str] = {}
    for path in [*sorted(FOLDER.glob("*/*.py")), FOLDER / "report.py"]:
        if "\ndef main(" not in path.read_text(encoding="utf-8"):
            continue
        name = path.parent.name if path.stem == "__main__" else path.stem
        if name in found:
            raise SystemExit(f"name must be unique; {found[name]} and {path} are both {name}.")
        found[name] = ".".join(path.relative_to(ROOT).with_suffix("").parts)
    return found


def title(module: str) -> str:
    """First line of a module's docstring, read without an import."""
    path = ROOT.joinpath(*module.split(".")).with_suffix(".py")
    return (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").partition("\n")[0]


def run(name: str, arguments: list[str]) -> int:
    """Run one benchmark in this process with its command-line arguments. Returns its exit code."""
    found = modules()
    if name not in found:
        print(f"name must be one of {', '.join(sorted(found))}; got {name}.", file=sys.stderr)
        return USAGE_ERROR
    sys.argv = [f"python -m benchmarks {name}", *arguments]
    return int(importlib.import_module(found[name]).main() or 0)


def main(arguments: list[str]) -> int:
    """Run the command line. Returns the exit code."""
    if not arguments or arguments[0] in ("-h", "--help"):
        print(__doc__)
        for name, module in sorted(modules().items()):
            print(f"  {name:20} {title(module)}")
        return 0
    if arguments[0] == "--markdown":
        os.environ[MARKDOWN] = "1"
        arguments = arguments[1:]
    return run(arguments[0], arguments[1:])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
