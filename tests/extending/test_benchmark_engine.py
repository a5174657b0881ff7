"""An engine of the benchmark from one file, through the command line of the benchmark."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks import ROOT, child_environment
from benchmarks.engines.jobs import FRICTION, JOBS, MATERIAL, TOOL_RADIUS, make_mesh
from tissue_sim.exports.elastic_constants import linearise_material

PLUGIN = Path(__file__).parent / "plugins" / "spring_foundation.py"


def run_benchmark(*words):
    return subprocess.run([sys.executable, "-m", "benchmarks", "engines", *map(str, words)], cwd=ROOT,
                          env=child_environment(), capture_output=True, text=True, encoding="utf-8")


def test_springs_under_a_ball(plugin):
    """Force of a Winkler foundation under a ball: pi k R d^2 (1 - d / (3 R)) with the stiffness k per area."""
    engine = plugin("spring_foundation").ENGINE
    test = JOBS["drag"].make_test(make_mesh("fine", 0.0), None, 60.0)
    constants = linearise_material(MATERIAL, 0.45)
    curve = engine.run(test, constants)
    depth = -test.positions[10, 2]
    stiffness = constants.young * 0.55 / (1.45 * 0.1 * 0.07)
    exact = np.pi * stiffness * TOOL_RADIUS * depth**2 * (1.0 - depth / (3.0 * TOOL_RADIUS))
    assert curve.forces[10, 2] == pytest.approx(exact, rel=0.1) and test.friction == FRICTION


@pytest.mark.slow
def test_an_engine_of_one_file_is_run_scored_and_drawn(tmp_path):
    words = ("--add", PLUGIN, "--engine", "spring_foundation", "--job", "punch", "--mesh", "coarse", "--results",
             tmp_path / "results.jsonl")
    done = run_benchmark(*words, "--figure", tmp_path, "--json")
    assert done.returncode == 0, done.stderr
    rows = json.loads(done.stdout)["rows"]
    assert [row["is_matched"] for row in rows] == [True, True, False]
    # Springs are linear in the depth; tissue is stiffer at 10 mm. The matched modulus halves the error on both sides.
    assert all(not row["ended"] and 0.02 < row["scores"]["rms_error"] < 1.0 for row in rows)
    assert rows[0]["scores"]["rms_error"] < 0.1 < rows[2]["scores"]["rms_error"]
    assert (tmp_path / "engines_forces.png").stat().st_size > 10_000 < (tmp_path / "engines_cost.png").stat().st_size
    stored = (tmp_path / "results.jsonl").read_bytes()
    again = run_benchmark(*words)
    assert again.returncode == 0 and "of " not in again.stderr and "spring foundation, matched" in again.stdout
    assert (tmp_path / "results.jsonl").read_bytes() == stored
