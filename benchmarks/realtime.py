"""Run `python -m benchmarks realtime`; kept for programs that call this file."""

import sys
from pathlib import Path

if __name__ == "__main__":
    # This folder contains a package with the name of this file: the repository's root replaces it in the search path.
    sys.path[0] = str(Path(__file__).resolve().parents[1])
    from benchmarks.__main__ import run

    sys.exit(run("realtime", sys.argv[1:]))
