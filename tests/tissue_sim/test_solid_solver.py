"""The solid in space against independent curves, the axisymmetric solid, and itself."""

import math
from itertools import pairwise

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.fem.solid.discretisation import make_solver
from tissue_sim.fem.solver import StepStatus
from tissue_sim.mesh.solid import create_cylinder_mesh_under_needle
from tissue_sim.mesh.solid_element import HEX8P0, HEX27P1
from tissue_sim.pose import Pose, compute_rigid_motion, interpolate_pose

PHANTOM = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))
SPECIMEN = ts.Specimen(0.04, 0.07)
FLAT = ts.Tool("flat", radius=8e-3)


def model(tool=FLAT, friction="bonded", material=PHANTOM, depth=5e-3, **changes):
    protocol = changes.pop("protocol", None) or ts.Protocol.ramp(depth, 3)
    return ts.Model(ts.Experiment(SPECIMEN, protocol, tool=tool, friction=friction, **changes), material)


def coarse(element=HEX8P0, centre=(0.0, 0.0), smallest=2.4e-3, around=2):
    return create_cylinder_mesh_under_needle(0.04, 0.07, 8e-3, element, smallest=smallest, growth=2.2, largest=20e-3,
                                             around=around,
                                             centre=centre)


def stepped(solver, *poses, **options):
    """The last step of a way."""
    for pose in poses:
        step = solver.step(pose, **options)
        assert step.status is StepStatus.CONVERGED
    return step


def turned(angle, axis=(0.0, 1.0, 0.0)):
    return (math.cos(0.5 * angle), *(math.sin(0.5 * angle) * part for part in axis))


@pytest.mark.slow
def test_a_bonded_punch_is_that_of_another_program(reference):
    """Within 0.7 % with 6000 freedoms of quadratic tetrahedra with linear pressure."""
    depth, force = np.loadtxt(reference / "punch_3d_on_axis_RP.csv", delimiter=",", comments="#").T[:2]
    depths = np.array([1.0, 2.0, 3.5, 5.0])
    solver = make_solver(model(), mesh=coarse(HEX27P1))
    found = [stepped(solver, Pose.at_depth(1e-3 * d)).force for d in depths]
    np.testing.assert_allclose(found, np.interp(depths, depth, force), rtol=0.012)


@pytest.mark.slow
@pytest.mark.parametrize(("tool", "friction"), [
    (ts.Tool("flat", radius=8e-3, edge_radius=1e-3), "stick"), (ts.Tool("sphere", radius=8e-3), "frictionless"),
    (ts.Tool("sphere", radius=8e-3), 0.3)], ids=["flat that sticks", "frictionless ball", "ball with friction"])
def test_contact_is_that_of_the_axisymmetric_solid(tool, friction):
    pressed = model(tool, friction, depth=3e-3)
    expected = ts.simulate(pressed)
    found = ts.simulate(pressed, resolution="realtime", solver="solid")
    assert found.force[-1] == pytest.approx(expected.force[-1], rel=0.03)
    report = found.metadata["solver"]
    assert report["status"] == "converged" and report["penetration_mm"] < report["penetration_tolerance_mm"]
    assert max(abs(found.channel(name)).max() for name in ("Fx", "Fy")) < 2e-3 * found.force[-1]


@pytest.mark.slow
def test_plates_without_friction_are_the_closed_form():
    kind = ts.KINDS["lubricated_compression"]
    experiment = kind.experiment(specimen=SPECIMEN, protocol=ts.Protocol.ramp(10e-3, 3))
    recording = ts.simulate(ts.Model(experiment, PHANTOM), resolution="realtime", solver="solid")
    stretch = 1.0 - recording.displacement / 0.07
    stress = PHANTOM.energy_law.nominal_stress(stretch, PHANTOM.parameters)
    mesh = make_solver(ts.Model(experiment, PHANTOM), resolution="realtime").mesh
    corners = mesh.nodes[mesh.faces["top"]]  # of linear elements: the circle is a polygon
    area = 0.5 * np.cross(corners[:, 3] - corners[:, 0], corners[:, 2] - corners[:, 1])[:, 2].sum()
    np.testing.assert_allclose(recording.force, -stress * area, rtol=3e-4, atol=1e-9)


@pytest.mark.slow
def test_a_relaxing_solid_relaxes_as_the_axisymmetric_one():
    """Between bonded plates of the same sections of time, over the force of each without relaxation."""
    material = ts.Material("reduced_polynomial_2", PHANTOM.parameters, PHANTOM.bulk,
                           viscoelastic=ts.Prony((ts.PronyTerm(0.3, 2.0),)))
    protocol = ts.Protocol.parse("ramp 4mm @1mm/s; hold 6s; unload", 4, 1e-3)
    shares = []
    for solver, mesh in (("axisymmetric", None), ("solid", coarse())):
        forces = [ts.simulate(model(protocol=protocol, material=each), solver=solver, mesh=mesh).force
                  for each in (material, PHANTOM)]
        shares.append(forces[0][1:-1] / forces[1][1:-1])
    np.testing.assert_allclose(shares[1], shares[0], atol=4e-3)
    assert shares[0].min() < 0.75


CASES = {"bonded": (FLAT, "bonded", Pose((0.0, 0.0, -3e-3))),
         "oblique": (FLAT, "bonded", Pose((1e-3, 2e-3, -3e-3), turned(0.1, (0.6, 0.8, 0.0)))),
         "ball": (ts.Tool("sphere", radius=8e-3), "frictionless", Pose((3e-4, -2e-4, -2e-3))),
         "ball that sticks": (ts.Tool("sphere", radius=8e-3), "stick", Pose((3e-4, -2e-4, -2e-3)))}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_stiffness_is_the_derivative_of_the_wrench(case):
    tool, friction, pose = CASES[case]
    solver = make_solver(model(tool, friction), mesh=coarse())
    solver.enable_stiffness_output()
    half = Pose(tuple(0.5 * part for part in pose.position), turned(0.05, (0.6, 0.8, 0.0)) if case == "oblique"
                else (1.0, 0.0, 0.0, 0.0))
    stiffness = np.array(stepped(solver, half, pose, tolerance=1e-11).stiffness_matrix)
    saved, w = solver.save(), pose.orientation
    for column in range(6):
        wrenches = []
        h = 1e-6 if column < 3 else 1e-4
        for sign in (1.0, -1.0):
            place, turn = np.array(pose.position), w
            if column < 3:
                place[column] += sign * h
            else:
                x = turned(sign * h, np.eye(3)[column - 3])
                turn = tuple(_product(x, w))
            solver.restore(saved)
            wrenches.append(stepped(solver, Pose(tuple(place.tolist()), turn), tolerance=1e-11).wrench)
        slope = -(np.array(wrenches[0]) - wrenches[1]) / (2 * h)
        np.testing.assert_allclose(stiffness[:, column], slope, rtol=2e-4, atol=2e-4 * np.abs(slope).max() + 1e-9)


def _product(left, right):
    a, b, c, d = left
    e, f, g, h = right
    return (a * e - b * f - c * g - d * h, a * f + b * e + c * h - d * g, a * g - b * h + c * e + d * f,
            a * h + b * g - c * f + d * e)


@pytest.mark.slow
def test_a_closed_way_gives_no_work():
    """An elastic solid and a tool that it holds: down, aside, turned and back."""
    solver = make_solver(model(), mesh=coarse())
    corners = [Pose((0.0, 0.0, 0.0)), Pose((0.0, 0.0, -3e-3)), Pose((2e-3, 1e-3, -3e-3)),
               Pose((2e-3, 1e-3, -3e-3), turned(0.15)), Pose((0.0, 0.0, 0.0), turned(0.15)), Pose((0.0, 0.0, 0.0))]
    parts, work, most = 8, 0.0, 0.0
    before = stepped(solver, corners[0])
    for start, end in pairwise(corners):
        for k in range(parts):
            one, other = interpolate_pose(start, end, k / parts), interpolate_pose(start, end, (k + 1) / parts)
            step = stepped(solver, other)
            work += 0.5 * np.dot(np.add(before.wrench, step.wrench), compute_rigid_motion(one, other))
            most, before = max(most, abs(work)), step
    assert abs(work) < 2e-3 * most
    np.testing.assert_allclose(before.wrench, 0.0, atol=1e-6)


def test_a_tool_off_the_axis_is_pushed_along_its_radius():
    """By symmetry of the mesh the lateral force is radial; pushing towards the axis needs more force."""
    solver = make_solver(model(approach=ts.Approach(offset=0.02)), mesh=coarse(centre=(0.02, 0.0)))
    step = stepped(solver, Pose((0.02, 0.0, -2e-3)), Pose((0.02, 0.0, -4e-3)))
    force = np.array(step.wrench[:3])
    assert abs(force[1]) < 5e-3 * abs(force[0]) and abs(force[0]) > 5e-3 * force[2]


def test_a_needle_that_leans_begins_without_force_and_is_pushed_aside():
    pressed = model(ts.Tool("round", radius=8e-3), 0.3, depth=3e-3, approach=ts.Approach(0.01, math.radians(20.0)))
    recording = ts.simulate(pressed, mesh=coarse(centre=(0.01, 0.0)), solver="solid")
    force = np.array([recording.channel(name) for name in ("Fx", "Fy", "Fz")])
    assert not force[:, 0].any()
    # It goes in towards +x, and the tissue resists against its way.
    assert force[0, -1] < 0.0 < force[2, -1] and abs(force[1, -1]) < 1e-2 * force[2, -1]
    bonded = make_solver(model(approach=ts.Approach(0.01, math.radians(20.0))), mesh=coarse(centre=(0.01, 0.0)))
    assert np.abs(stepped(bonded, bonded.pose).wrench).max() < 1e-9


def test_what_was_saved_comes_back_to_the_last_bit():
    solver = make_solver(model(ts.Tool("sphere", radius=8e-3), 0.3), mesh=coarse())
    way = [Pose((1e-4 * k, 0.0, -4e-4 * k)) for k in range(1, 5)]
    stepped(solver, *way[:2])
    saved = solver.save()
    first = stepped(solver, *way[2:])
    solver.restore(saved)
    assert stepped(solver, *way[2:]) == first


def test_a_tool_that_was_taken_away_begins_again():
    solver = make_solver(model(ts.Tool("sphere", radius=8e-3), "stick"), mesh=coarse())
    way = [Pose((0.0, 0.0, -5e-4)), Pose((0.0, 0.0, -1e-3))]
    first = stepped(solver, *way)
    solver.reset_to_first_touch()
    assert solver.pose == Pose((0.0, 0.0, 0.0)) and not solver.field_sample().displacement.any()
    assert stepped(solver, Pose((0.0, 0.0, 1e-3))).force == 0.0
    np.testing.assert_allclose(stepped(solver, Pose((0.0, 0.0, 0.0)), *way).wrench, first.wrench, rtol=1e-7, atol=1e-12)


@pytest.mark.slow
def test_simulator_steps_it():
    simulator = ts.Simulator(model(ts.Tool("sphere", radius=8e-3), "stick"), mesh=coarse(), solver="solid")
    simulator.warm_up()
    for k in range(1, 6):
        answer = simulator.step(Pose((2e-5 * k, 0.0, -1e-4 * k)), 1e-3)
        assert answer.status is ts.ForceStatus.CONVERGED
    assert answer.force > 0.0 and answer.force_vector[0] < 0.0 < answer.stiffness
    away = simulator.step(Pose((0.0, 0.0, 1e-2)), 1e-3)
    assert away.status is ts.ForceStatus.CONVERGED and away.force == 0.0


@pytest.mark.parametrize(("changes", "expected"), [
    ({"approach": ts.Approach(offset=0.035)}, "reaches beyond the specimen, radius 40 mm"),
    ({"tool": ts.Tool("plate"), "approach": ts.Approach(offset=1e-3)}, "a plate covers the whole top"),
])
def test_an_approach_that_does_not_fit_is_refused(changes, expected):
    with pytest.raises(ts.InputError, match=expected):
        model(**changes)


def test_what_it_does_not_take_is_refused_by_name():
    with pytest.raises(ts.InputError, match="unknown resolution 'fats'; did you mean 'fast'"):
        make_solver(model(), resolution="fats")
    with pytest.raises(ts.InputError, match="axisymmetric solid, whose tool is on the axis"):
        ts.simulate(model(approach=ts.Approach(angle=0.2)))
