"""A bulk that uses an earlier tangent while the next one is condensed in parallel."""

from dataclasses import replace

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.fem.condensed.model import CondensedBulk, max_packed_linearisation_size
from tissue_sim.fem.condensed.stepper import CondensedStepper
from tissue_sim.fem.solid.discretisation import make_solver
from tissue_sim.fem.solid.linearisation import SolidLineariser
from tissue_sim.fem.solid.tissue import Tissue
from tissue_sim.mesh.solid import create_cylinder_mesh_under_needle
from tissue_sim.mesh.solid_element import HEX8P0
from tissue_sim.pose import Pose

PHANTOM = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))
TIP = ts.Tool("round", radius=8e-3)
FLAT = ts.Tool("flat", radius=8e-3)
MESH = create_cylinder_mesh_under_needle(0.04, 0.07, 8e-3, HEX8P0, smallest=2.4e-3, growth=2.2, largest=20e-3, around=2)
TURNED = (float(np.cos(0.01)), 0.0, float(np.sin(0.01)), 0.0)


class Later:
    """Double of a bulk whose results are hidden until `come` is called."""

    def __init__(self):
        self.come = False

    def __call__(self, compute):
        compute()
        return lambda: self.come


def two_rates(tool, friction):
    model = ts.Model(ts.Experiment(ts.Specimen(0.04, 0.07), ts.Protocol.ramp(3e-3, 3), tool=tool, friction=friction),
                     PHANTOM)
    bulk, solver = SolidLineariser(make_solver(model, mesh=MESH)), make_solver(model, mesh=MESH)
    stepper = CondensedStepper(bulk.surface)
    return bulk, stepper, solver


def go(bulk, stepper, pose):
    """One iterate; the step on it."""
    model = bulk.iterate_and_linearise_or_none(stepper.export_state(0.0, pose, 0.0, pose))
    assert model is not None
    stepper.set_linearisation(model)
    return stepper.step(pose, exact=True), model


@pytest.mark.slow
@pytest.mark.parametrize(("tool", "friction", "end"), [
    (FLAT, "bonded", Pose((1e-3, -5e-4, -1.7e-3), TURNED)), (TIP, "frictionless", Pose((2e-3, 1e-3, -2e-3)))])
def test_iterates_with_a_tangent_of_millimetres_ago_end_at_the_equilibrium(tool, friction, end):
    bulk, stepper, solver = two_rates(tool, friction)
    start, later = Pose((0.0, 0.0, -1e-3)), Later()
    for _ in range(5):
        go(bulk, stepper, start)
    bulk.executor = later
    _, first = go(bulk, stepper, start)      # its tangent is that of the start, and the next one never comes
    way = np.subtract(end.position, start.position)
    for share in np.linspace(0.1, 1.0, 10):
        _, model = go(bulk, stepper, Pose(tuple((start.position + share * way).tolist()),
                                          end.orientation if share == 1.0 else start.orientation))
        assert model.base == first.base and model.compliance is first.compliance
    for _ in range(60):
        step, model = go(bulk, stepper, end)
    for pose in (start, end):
        exact = solver.step(pose, tolerance=1e-9, max_iterations=40)
    size = np.linalg.norm(exact.wrench[:3])
    np.testing.assert_allclose(step.wrench, exact.wrench, atol=1e-6 * size)
    # A step with the tangent of now is quicker, and ends there, too.
    later.come = True
    step, model = go(bulk, stepper, end)
    assert model.has_own_tangent and model.base > first.base
    np.testing.assert_allclose(step.wrench, exact.wrench, atol=1e-6 * size)


@pytest.mark.slow
def test_what_is_not_whole_travels_without_its_tangent():
    bulk, stepper, _ = two_rates(TIP, 0.3)
    pose = Pose((0.0, 0.0, -1e-3))
    _, whole = go(bulk, stepper, pose)
    bulk.executor = Later()
    go(bulk, stepper, pose)
    _, model = go(bulk, stepper, pose)
    assert whole.has_own_tangent and not model.has_own_tangent
    packed = model.pack_to_array()
    largest, largest_whole = (max_packed_linearisation_size(bulk.surface, whole=whole) for whole in (False, True))
    assert packed.size <= largest < 0.02 * largest_whole
    copy = CondensedBulk.unpack_from_array(packed, whole if whole.base == model.base else model)
    np.testing.assert_array_equal(copy.free_displacement, model.free_displacement)
    assert (copy.number, copy.pose, copy.reach) == (model.number, model.pose, model.reach)
    assert copy.compliance.shape == model.compliance.shape
    assert CondensedBulk.unpack_from_array(packed, replace(model, base=model.base + 1)) is None
    assert CondensedBulk.unpack_from_array(packed) is None


def five_times(answer):
    return lambda self, right: 5.0 * answer(self, right)


@pytest.mark.parametrize(("tool", "friction"), [(FLAT, "bonded"), (TIP, 0.3)], ids=["held", "touched"])
def test_a_tangent_that_leads_away_is_not_followed_and_a_new_one_is_made(tool, friction, monkeypatch):
    """Tissue that has become five times as stiff as its tangent."""
    bulk, stepper, _ = two_rates(tool, friction)
    pose, further = Pose((0.0, 0.0, -1e-3)), Pose((0.0, 0.0, -1.5e-3))
    for _ in range(3):
        go(bulk, stepper, pose)
    bulk.executor = later = Later()
    go(bulk, stepper, pose)
    tangent = type(bulk._tangent)
    with monkeypatch.context() as patch:
        for name in ("begin_solution_with_interface_rows", "begin_solution_for_interface_forces"):
            patch.setattr(tangent, name, five_times(getattr(tangent, name)))
        before = bulk.solver.save()
        assert bulk.iterate_and_linearise_or_none(stepper.export_state(0.0, further, 0.0, further)) is None
    for array, kept in zip(bulk.solver.save().arrays, before.arrays, strict=True):
        np.testing.assert_array_equal(array, kept)
    later.come = True
    step, model = go(bulk, stepper, further)
    assert model.has_own_tangent and step.wrench[2] > 0.0


def test_tissue_that_no_tangent_is_found_for_begins_again_from_rest(monkeypatch):
    bulk, stepper, solver = two_rates(FLAT, "bonded")
    pose = Pose((0.0, 0.0, -1e-3))
    go(bulk, stepper, pose)
    go(bulk, stepper, pose)
    assembled, asked = Tissue.assemble_and_get_least_volume_ratio, []

    def fails(self, tangent=True):
        asked.append(np.abs(bulk.solver.x).max())
        least = assembled(self, tangent)
        return least if asked[-1] == 0.0 else -1.0

    with monkeypatch.context() as patch:
        patch.setattr(Tissue, "assemble_and_get_least_volume_ratio", fails)
        assert bulk.iterate_and_linearise_or_none(stepper.export_state(0.0, pose, 0.0, pose)) is None
        model = bulk.iterate_and_linearise_or_none(stepper.export_state(0.0, pose, 0.0, pose))
    assert model is not None and model.has_own_tangent and asked[-1] == 0.0
    stepper.set_linearisation(model)
    for _ in range(6):
        step, _ = go(bulk, stepper, pose)
    exact = solver.step(pose, tolerance=1e-9, max_iterations=40)
    np.testing.assert_allclose(step.wrench, exact.wrench, atol=1e-7 * np.linalg.norm(exact.wrench[:3]))
