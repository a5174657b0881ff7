"""Lateral force error of reduced solids with friction after a reversal of the tool."""

import io
import json
from dataclasses import replace

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.fem.reduced import training
from tissue_sim.fem.reduced.reduction import simulate_reduced_path
from tissue_sim.fem.reduced.settings import VERIFICATION
from tissue_sim.fem.reduced.solver import ReducedSolver
from tissue_sim.fem.reduced.training import make_reversing_paths
from tissue_sim.pose import interpolate_pose

pytestmark = pytest.mark.slow

MATERIAL = ts.Material("neo_hooke", {"C10": 2000.0}, ts.Bulk("bulk_ratio", 1e3))
BOX = ts.PoseBox(1.5e-3, 1.6e-3)
START = ts.Pose((0.0, 0.0, 0.0))
#: Deepest position of the ball on a path that is neither a training nor a test path, m.
DEEPEST = ts.Pose((0.7e-3, 0.1e-3, -1.5e-3))
#: Number of poses during loading, and during unloading.
COUNT = 15


@pytest.fixture(scope="module")
def ball(coarse):
    """Return a reduced model of a sliding ball."""
    experiment = ts.Experiment(ts.Specimen(0.030, 0.020), ts.Protocol.ramp(BOX.depth, 2),
                               tool=ts.Tool("round", radius=8e-3), friction=0.3)
    return ts.reduce_solid(ts.Model(experiment, MATERIAL), BOX, resolution=coarse, strokes=2, modes=12, tried=1)


def there_and_back(deepest):
    """Return poses from the start obliquely to a deepest pose and back."""
    loading = [interpolate_pose(START, deepest, k / COUNT) for k in range(COUNT + 1)]
    return loading + loading[-2::-1]


def lateral(force):
    """Return the norm of the force perpendicular to the axis of the tool, N."""
    return float(np.hypot(*force[:2]))


def test_the_stated_error_covers_the_error_after_a_reversal(ball):
    path = there_and_back(DEEPEST)
    true = training.simulate_snapshots(training.make_full_order_solver(ball.model, ball.mesh), path).wrenches[:, :3]
    steps = list(simulate_reduced_path(ReducedSolver(ball, MATERIAL), path))
    errors = np.linalg.norm(np.array([step.wrench[:3] for step in steps]) - true, axis=1)
    negligible = VERIFICATION.negligible_error * np.sqrt(np.mean(np.sum(true**2, axis=1)))
    unloading = slice(COUNT + 1, 2 * COUNT)
    stated = np.array([step.force_error for step in steps[unloading]])
    assert errors[unloading].max() > 2.0 * negligible, "the error that must be stated"
    assert np.mean(errors[unloading] <= stated + negligible) >= VERIFICATION.coverage
    assert (stated < 0.5 * np.linalg.norm(true, axis=1).max()).all()


def test_indentation_along_the_axis_has_hardly_any_lateral_error(ball):
    path = [ts.Pose((0.0, 0.0, -z)) for z in np.linspace(0.0, BOX.depth, COUNT)]
    without = replace(ball, error_factors=(*ball.error_factors[:2], 0.0))
    with_lateral, axial = (list(simulate_reduced_path(ReducedSolver(each, MATERIAL), path)) for each in (ball, without))
    for one, other in zip(with_lateral[1:], axial[1:], strict=True):
        assert one.force_error - other.force_error <= 0.01 * np.linalg.norm(one.wrench[:3])


def test_the_largest_lateral_force_is_stored_until_the_tool_lifts_off(ball):
    solver = ReducedSolver(ball, MATERIAL)
    forces, largest = [], []
    for step in simulate_reduced_path(solver, there_and_back(DEEPEST)[: -COUNT // 2]):
        forces.append(lateral(step.wrench[:3]))
        largest.append(solver.contact.largest_lateral_tool_force_since_touch)
    assert largest[-1] >= max(forces) > 1.5 * forces[-1]
    assert (np.diff(largest) >= 0.0).all()
    saved = solver.save()
    solver.reset_to_first_touch()
    assert solver.contact.largest_lateral[0] == 0.0
    solver.restore(saved)
    assert solver.contact.largest_lateral[0] == largest[-1]


def test_the_factor_is_calibrated_on_reversing_paths(ball):
    assert 0.0 < ball.error_factors[2] < 1.0
    paths = make_reversing_paths(BOX, START, reach=5e-3)
    assert len(paths) == 8
    for path in paths:
        positions = np.array([pose.position for pose in path])
        touching = positions[positions[:, 2] <= 0.0]
        np.testing.assert_allclose(touching, touching[::-1], atol=1e-12)
        assert touching[:, 2].min() == pytest.approx(-BOX.depth)
        assert all(BOX.contains_pose(pose, START) for pose in path[2:])


def test_a_file_of_an_older_version_has_the_largest_lateral_factor(ball, tmp_path):
    ts.write_reduced(ball, path := tmp_path / "ball.reduced.npz")
    assert ts.load_reduced(path).error_factors == pytest.approx(ball.error_factors)
    with np.load(path) as stored:
        arrays = {name: stored[name] for name in stored.files}
    description = json.loads(str(arrays["description"]))
    description["error_factors"] = description["error_factors"][:2]
    stream = io.BytesIO()
    np.savez(stream, **{**arrays, "description": np.array(json.dumps(description))})
    path.write_bytes(stream.getvalue())
    old = ts.load_reduced(path)
    assert old.error_factors[:2] == pytest.approx(ball.error_factors[:2])
    assert old.error_factors[2] == VERIFICATION.absent_lateral_factor > ball.error_factors[2]
