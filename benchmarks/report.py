"""Run the benchmarks that documentation pages name, and write their tables into the pages.

A page marks the place of a benchmark's tables with two comments; the text between them is replaced:

    <!-- benchmark: needle --repeats 5 -->
    <!-- end of benchmark -->
"""

from __future__ import annotations

import argparse
import re
import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from benchmarks import ROOT, child_environment
from tissue_sim.files import write_text

_BLOCK = re.compile(r"(<!-- benchmark: (?P<command>[^\n]+?) -->\n).*?(<!-- end of benchmark -->)", re.DOTALL)


@dataclass(frozen=True)
class Block:
    """Position of the tables of one benchmark in a page.

    Attributes:
        page: Markdown file.
        command: name and arguments of the benchmark, as on the command line.
    """

    page: Path
    command: str

    @property
    def name(self) -> str:
        """Name of the benchmark."""
        return self.command.split()[0]


def find_blocks(pages: list[Path]) -> list[Block]:
    """Return all blocks of the pages, in the order of the text."""
    return [Block(page, found["command"]) for page in pages
            for found in _BLOCK.finditer(page.read_text(encoding="utf-8"))]


def tables_of(command: str) -> str:
    """Run a benchmark in a child process and return its tables in Markdown.

    Raises:
        RuntimeError: the benchmark failed; the message has the last line of its error output.
    """
    done = subprocess.run([sys.executable, "-m", "benchmarks", "--markdown", *shlex.split(command)], cwd=ROOT,
                          env=child_environment(), capture_output=True, text=True, encoding="utf-8", check=False)
    if done.returncode or not done.stdout.strip():
        reason = (done.stderr.strip().splitlines() or ["it printed no table"])[-1]
        raise RuntimeError(f"{command} failed with exit code {done.returncode}: {reason}")
    return done.stdout.strip() + "\n"


def write_tables(block: Block, tables: str) -> None:
    """Replace the text of a block by tables; the file is replaced as a whole or not at all."""
    text = block.page.read_text(encoding="utf-8")

    def renewed(found: re.Match[str]) -> str:
        return f"{found[1]}\n{tables}\n{found[3]}" if found["command"] == block.command else found[0]

    write_text(block.page, _BLOCK.sub(renewed, text))


def main() -> int:
    """Run the command line. Returns 1 if a benchmark failed; the tables of the others are written."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME",
                        help="run only these benchmarks (default: all that pages name)")
    parser.add_argument("--docs", type=Path, default=ROOT / "docs", help="folder of the pages (default: docs)")
    arguments = parser.parse_args()
    blocks = find_blocks(sorted(arguments.docs.glob("*.md")))
    known = sorted({block.name for block in blocks})
    unknown = sorted(set(arguments.names) - set(known))
    if unknown:
        parser.error(f"NAME must be a benchmark that a page names ({', '.join(known)}); got {', '.join(unknown)}.")
    failed = 0
    for block in blocks:
        if arguments.names and block.name not in arguments.names:
            continue
        print(f"{block.page.name}: {block.command}", file=sys.stderr, flush=True)
        try:
            write_tables(block, tables_of(block.command))
        except RuntimeError as error:
            print(error, file=sys.stderr)
            failed = 1
    return failed
