"""A rounded edge that is smaller than the elements of a solid: the solver states the force that is missing."""

import re

import pytest

import tissue_sim as ts
from tissue_sim.fem.solid.coarse_surface import find_slid_face_surface_or_none
from tissue_sim.fem.solid.contact import ToolFrame
from tissue_sim.fem.solid.discretisation import make_solver

MATERIAL = ts.Material("mooney_rivlin", {"C10": 900.0, "C01": 400.0}, ts.Bulk("bulk_ratio", 100.0))


def model(friction, edge_radius=4e-4):
    tool = ts.Tool("flat", radius=6e-3, edge_radius=edge_radius)
    return ts.Model(ts.Experiment(ts.Specimen(0.03, 0.03), ts.Protocol.ramp(2e-3, 5), tool=tool, friction=friction),
                    MATERIAL)


@pytest.mark.parametrize("edge_radius", [4e-4, pytest.param(1e-3, marks=pytest.mark.slow)])
def test_the_missing_force_is_stated(edge_radius):
    """The axisymmetric solver resolves the edge; its force is the reference."""
    right = ts.simulate(model("frictionless", edge_radius)).force[-1]
    recording = ts.simulate(model("frictionless", edge_radius), solver="solid", resolution="realtime")
    missing = 1.0 - recording.force[-1] / right
    assert missing > 0.1
    warning, = recording.metadata["solver"]["warnings"]
    assert float(re.search(r"coarse edge: ([0-9.]+) %", warning)[1]) / 100.0 == pytest.approx(missing, abs=0.02)


@pytest.mark.slow
def test_the_force_error_of_a_real_time_step_contains_the_missing_force():
    right = ts.simulate(model("frictionless")).force[-1]
    simulator = ts.Simulator(model("frictionless"), solver="solid", resolution="realtime", inertia="off")
    for depth in (1e-3, 2e-3):
        answer = simulator.step(depth, 0.1)
    assert answer.force < 0.9 * right
    assert answer.force_error == pytest.approx(right - answer.force, rel=0.25)


def test_a_face_that_sticks_has_no_warning():
    recording = ts.simulate(model(0.4), solver="solid", resolution="realtime")
    assert recording.metadata["solver"]["warnings"] == []


def test_a_tool_away_from_its_first_touch_has_no_slid_surface():
    """Nodes that the tool leaves behind, with undeformed tissue, have not slid around its edge."""
    solver = make_solver(model("frictionless"), resolution="realtime")
    first = ToolFrame(solver.pose, solver.datum)
    for distance in (0.0, 1e-3, 4e-3, 13e-3):
        frame = ToolFrame(ts.Pose((distance, 0.0, -1e-3)), solver.datum)
        assert find_slid_face_surface_or_none(solver.contact, solver.committed_displacement, first, frame) is None


def test_a_sideways_motion_in_contact_keeps_a_finite_error():
    simulator = ts.Simulator(model("frictionless"), solver="solid", resolution="realtime", inertia="off")
    for x in (0.0, 1e-3, 2e-3):
        answer = simulator.step(ts.Pose((x, 0.0, -5e-4)), 0.1)
        assert answer.force > 0.0
        assert answer.force_error is None or answer.force_error < 0.25 * answer.force
