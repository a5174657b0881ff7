"""Benchmarks and studies. `python -m benchmarks` lists them, `python -m benchmarks NAME` runs one."""

import os
import sys
from pathlib import Path

#: Root folder of the repository.
ROOT = Path(__file__).resolve().parents[1]
#: Environment variable; if it is set, results are printed in Markdown.
MARKDOWN = "TISSUE_SIM_BENCHMARK_MARKDOWN"
# Simulated devices and reference solutions of the tests are measured here; the tests import no benchmark for them.
sys.path.append(str(ROOT / "tests"))


def child_environment() -> dict[str, str]:
    """Environment variables of a child process that imports the packages of this repository."""
    paths = [str(ROOT), os.environ.get("PYTHONPATH", "")]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in paths if path)}
