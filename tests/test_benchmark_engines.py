"""Jobs, scores and results of the benchmark of engines."""

import json

import numpy as np
import pytest

from benchmarks.engines.jobs import JOBS, SAMPLE_TIME
from benchmarks.engines.run import Results, Run, list_runs
from benchmarks.engines.scoring import compute_scores
from benchmarks.engines.truth import REFERENCES, read_reference


def make_run(job, forces, **more):
    return {"job": job, "forces": np.asarray(forces).tolist(), "penetrations": [1e-5, 3e-5], "step_seconds": 4e-3,
            "step": 2e-3, **more}


@pytest.mark.parametrize("job", REFERENCES)
def test_stored_references_belong_to_the_jobs(job):
    positions, times = JOBS[job].make_motion()
    truth = read_reference(job)
    known, forces = np.array(truth["positions"]), np.array(truth["forces"])
    assert times is None and (forces[0] == 0.0).all()
    np.testing.assert_allclose(known[[0, -1]], positions[[0, -1]], atol=1e-12)


def test_scores_of_a_curve_that_is_ten_percent_too_large():
    positions, _ = JOBS["drag"].make_motion()
    forces = np.column_stack([-100.0 * positions[:, 0], np.zeros(len(positions)), -1e3 * positions[:, 2]])
    truth = {"positions": positions.tolist(), "forces": forces.tolist(), "times": None}
    scores = compute_scores(make_run("drag", 1.1 * forces), truth)
    assert scores.reached == 1.0 and scores.largest_error == pytest.approx(0.1)
    assert scores.end_error == pytest.approx(0.1) and scores.lateral_error == pytest.approx(-0.1)
    assert scores.penetration == 3e-5 and np.isnan(scores.drift) and np.isnan(scores.time_ratio)


def test_scores_of_a_run_that_ends_early():
    positions, _ = JOBS["punch"].make_motion()
    forces = np.zeros((len(positions), 3))
    forces[:, 2] = -100.0 * positions[:, 2]
    truth = {"positions": positions.tolist(), "forces": forces.tolist(), "times": None}
    scores = compute_scores(make_run("punch", 1.2 * forces[:5]), truth)
    assert scores.reached == pytest.approx(5 / 11) and scores.end_error == pytest.approx(0.2)
    assert compute_scores(make_run("punch", np.zeros((0, 3))), truth).reached == 0.0


def test_drift_and_force_in_air_of_a_second_touch():
    positions, times = JOBS["retouch"].make_motion()
    true = np.column_stack([np.zeros((len(times), 2)), np.maximum(-100.0 * positions[:, 2], 0.0)])
    truth = {"positions": positions.tolist(), "forces": true.tolist(), "times": times.tolist()}
    forces = true.copy()
    forces[times > 0.35, 2] *= 0.9
    forces[positions[:, 2] >= 1e-3, 2] = -0.05
    scores = compute_scores(make_run("retouch", forces), truth)
    assert scores.drift == pytest.approx(-0.1) and scores.force_in_air == pytest.approx(0.1)
    assert scores.time_ratio == pytest.approx(2.0)


def test_speeds_of_the_jobs_with_inertia():
    positions, times = JOBS["retreat"].make_motion()
    speeds = np.abs(np.diff(positions[:, 2])) / SAMPLE_TIME
    assert speeds.max() == pytest.approx(0.2) and times[-1] == pytest.approx(0.35)


def test_results_are_appended_and_the_last_row_counts(tmp_path):
    results = Results(tmp_path / "r.jsonl")
    run = Run("mujoco", "punch", "coarse", 0.01)
    assert results.read() == {}
    for wall in (1.0, 2.0):
        results.append({"key": run.key, "wall_seconds": wall})
    assert results.read()[run.key]["wall_seconds"] == 2.0
    assert json.loads(run.key) == ["mujoco", "punch", "coarse", 0.01, True]


def test_runs_of_static_programs_and_of_programs_with_constants():
    assert [run.step for run in list_runs(["felupe"], ["punch", "retouch"], ["coarse", "fine"])] == [0.0, 0.0]
    assert [(run.step, run.is_matched) for run in list_runs(["mujoco"], ["punch"], ["coarse"])] == [
        (0.02, True), (0.01, True), (0.01, False)]
    assert {run.mesh for run in list_runs(["axisymmetric"], ["punch"], ["coarse", "fine"])} == {"own"}
