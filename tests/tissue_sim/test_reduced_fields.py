"""Fields of a reduced solid compared with the whole solid at the same pose, and fields that it does not have."""

from dataclasses import replace

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.fem.reduced import training
from tissue_sim.fem.reduced.solver import ReducedSolver
from tissue_sim.fem.solid.fields import SolidFields
from tissue_sim.fem.solver import StepStatus
from tissue_sim.snapshot import snapshot

pytestmark = pytest.mark.slow

MATERIAL = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e3))
POSES = [ts.Pose((0.05e-3 * k, -0.04e-3 * k, -0.25e-3 * k)) for k in range(9)]


@pytest.fixture(scope="module")
def reduced(coarse):
    """Return a reduced model of a bonded flat needle."""
    experiment = ts.KINDS["needle_indentation"].experiment(
        specimen=ts.Specimen(0.03, 0.02), protocol=ts.Protocol.ramp(3e-3, points=2), tool=ts.Tool("flat", radius=8e-3),
        friction="bonded")
    return ts.reduce_solid(ts.Model(experiment, MATERIAL), ts.PoseBox(1.5e-3, 3e-3),
                           resolution=coarse, strokes=3, modes=20, tried=1)


@pytest.fixture(scope="module")
def solver(reduced):
    solver = ReducedSolver(reduced, MATERIAL)
    for pose in POSES:
        assert solver.step(pose).status is StepStatus.CONVERGED
    return solver


@pytest.fixture(scope="module")
def fields(solver):
    return solver.fields([solver.field_sample()])


def test_they_are_those_of_the_whole_solid(reduced, fields):
    whole = training.make_full_order_solver(reduced.model, reduced.mesh)
    for pose in POSES:
        assert whole.step(pose, tolerance=1e-7, max_iterations=40).status is StepStatus.CONVERGED
    exact = whole.fields([whole.field_sample()])
    for name, rest, bound in (("displacement", 0.0, 0.01), ("von_mises", 0.0, 0.02), ("stretch", 1.0, 0.02),
                              ("J", 1.0, 0.05)):
        found, expected = fields.at_points(name), exact.at_points(name)
        error = np.sqrt(np.average((found - expected) ** 2, weights=exact.weights))
        assert error < bound * np.sqrt(np.average((expected - rest) ** 2, weights=exact.weights)), name
    assert fields.stretch_range() == pytest.approx(exact.stretch_range(), rel=0.01)


def test_there_is_no_pressure(fields):
    assert set(fields.names) == {"displacement", "von_mises", "stretch", "J"}
    with pytest.raises(ts.InputError, match=r"does not compute pressure.*use one of displacement") as raised:
        fields.at_points("cauchy_zz")
    assert raised.value.field == "field"


def test_what_is_published_is_where_the_nodes_are(solver, fields):
    shown = snapshot(solver)
    assert isinstance(shown.fields, SolidFields) and shown.is_three_dimensional and shown.skin is None
    (displacement,) = shown.arrays()
    np.testing.assert_array_equal(displacement[0], solver.displacement())
    again = shown.with_pose_and_arrays(shown.pose, shown.datum, (0.5 * displacement,))
    assert again.fields.at_nodes("displacement").max() == pytest.approx(
        0.5 * fields.at_nodes("displacement").max(), rel=1e-12)
    part = fields.with_selected_elements(np.arange(5)).with_one_mean_point_per_element()
    assert part.at_points("von_mises").shape == (5, 1) and (part.at_points("von_mises") > 0.0).all()


def test_tissue_that_remembers_has_none(reduced):
    prony = replace(MATERIAL, viscoelastic=ts.Prony((ts.PronyTerm(0.3, 1.0),)))
    solver = ReducedSolver(replace(reduced, model=replace(reduced.model, material=prony)), prony)
    assert solver.fields([solver.field_sample()]) is None and snapshot(solver).skin is not None
