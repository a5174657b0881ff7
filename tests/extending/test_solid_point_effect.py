"""An effect at the points from one file in the solid in space: a Maxwell branch, which is the built-in Prony term."""

from dataclasses import replace

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.fem.reduced.model import require_no_point_effects
from tissue_sim.fem.solid.discretisation import make_solver
from tissue_sim.fem.solver import StepStatus
from tissue_sim.material.effect import EFFECTS
from tissue_sim.mesh.solid import create_cylinder_mesh_under_needle
from tissue_sim.mesh.solid_element import HEX8P0
from tissue_sim.pose import Pose

#: Parameter of the law, Pa.
C10 = 1500.0
#: Relaxing fraction, 1.
G = 0.3
#: Relaxation time, s.
TAU = 2.0
BULK = ts.Bulk("K_Pa", 3e7)
WAY = ts.Protocol.parse("ramp 4mm @1mm/s; hold 3s; unload 1mm", points=5)


@pytest.fixture
def branch(plugin, registers):
    return registers(EFFECTS, plugin("maxwell_branch").MaxwellBranch)


def material(branch, **options) -> ts.Material:
    return ts.Material("neo_hooke", {"C10": (1 - G) * C10}, BULK, effects=[branch(2 * G * C10, TAU)], **options)


def built_in(**options) -> ts.Material:
    return ts.Material("neo_hooke", {"C10": C10}, BULK, viscoelastic=ts.Prony((ts.PronyTerm(G, TAU),)), **options)


def model(stuff, approach=None):
    return ts.Model(ts.Experiment(ts.Specimen(0.04, 0.07), WAY, tool=ts.Tool("flat", radius=8e-3), friction="bonded",
                                  approach=approach), stuff)


def mesh(offset=0.0, layers=()):
    return create_cylinder_mesh_under_needle(0.04, 0.07, 8e-3, HEX8P0, smallest=2.4e-3, growth=2.2, largest=20e-3,
                                             around=2,
                                             centre=(offset, 0.0),
                                             interfaces=np.cumsum([layer.thickness for layer in layers]))


@pytest.mark.slow
@pytest.mark.parametrize("layers", [(), (ts.Layer(4e-3, 3.0),)], ids=["plain", "layered"])
def test_a_branch_is_the_built_in_term(branch, layers):
    """Under an oblique needle off the axis: forces in space, fields, and as many iterations."""
    approach = ts.Approach(10e-3, 0.2)
    found, expected = (ts.simulate(model(stuff, approach), solver="solid", mesh=mesh(10e-3, layers), fields=True)
                       for stuff in (material(branch, layers=layers), built_in(layers=layers)))
    for name in ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz"):
        scale = np.abs(expected.channel(name)).max()
        np.testing.assert_allclose(found.channel(name), expected.channel(name), atol=1e-6 * max(scale, 1e-6))
    iterations = [recording.metadata["solver"]["newton_iterations"] for recording in (found, expected)]
    assert abs(iterations[0] - iterations[1]) <= 2
    for name in ("cauchy_xz", "von_mises"):
        right = expected.fields.at_points(name)
        np.testing.assert_allclose(found.fields.at_points(name), right, atol=1e-5 * np.abs(right).max())


@pytest.mark.slow
def test_it_is_that_of_the_axisymmetric_solid(branch):
    """Over the force of each without the branch."""
    shares = []
    for options in ({}, {"solver": "solid", "mesh": mesh()}):
        forces = [ts.simulate(model(stuff), **options).force[1:] for stuff in (
            material(branch), replace(material(branch), effects={}))]
        shares.append(forces[0] / forces[1])
    np.testing.assert_allclose(shares[1], shares[0], rtol=0.01)
    assert shares[0].max() > 1.25


def test_stiffness_and_memory(branch):
    """The stiffness is the derivative of the force; a restored state continues with the same forces."""
    solver = make_solver(model(material(branch)), mesh=mesh())
    solver.enable_stiffness_output()
    for depth in (1e-3, 2e-3):
        step = solver.step(Pose.at_depth(depth), 0.5, tolerance=1e-11)
        assert step.status is StepStatus.CONVERGED
    saved = solver.save()
    step = solver.step(Pose.at_depth(2.5e-3), 0.5, tolerance=1e-11)
    moved = []
    for sign in (1.0, -1.0):
        solver.restore(saved)
        moved.append(solver.step(Pose.at_depth(2.5e-3 + sign * 1e-6), 0.5, tolerance=1e-11).force)
    assert step.stiffness == pytest.approx((moved[0] - moved[1]) / 2e-6, rel=1e-5)
    assert step.force == pytest.approx(0.5 * sum(moved), rel=1e-6)
    assert solver.enable_force_derivatives(()) is None


def test_what_takes_none_says_so(branch):
    with pytest.raises(ts.InputError, match="a reduced solid does not support effects at quadrature points"):
        require_no_point_effects(material(branch))

    class Branching(branch):
        def response(self, C, state, dt):
            return super().response(C, state, 1.0 if dt > 1.0 else 0.5)

    with pytest.raises(ts.InputError, match=r"effects\.maxwell_branch: .*numpy\.where"):
        ts.simulate(model(replace(built_in(), effects=[Branching(100.0, TAU)])), solver="solid", mesh=mesh())


def test_a_region_has_none(branch):
    """Where the mesh names all elements, nothing is left for it; where it names half of them, half of it acts."""
    whole = mesh()
    count = len(whole.connectivity)
    plain = replace(built_in(), viscoelastic=None)

    def force(region):
        sudden = make_solver(model(replace(material(branch), parameters={"C10": C10}, regions={"named": plain})),
                             mesh=replace(whole, regions={"named": region}))
        return sudden.step(Pose.at_depth(1e-3), 0.0).force

    none, some, most = force(np.arange(count)), force(np.arange(count // 2)), force(np.arange(1))
    assert none == pytest.approx(make_solver(model(plain), mesh=whole).step(Pose.at_depth(1e-3), 0.0).force, rel=1e-6)
    assert 1.05 * none < some < 0.95 * most


@pytest.mark.slow
def test_a_formula_may_add_in_place(branch, registers):
    """Names of a formula are its own: what it does to them leaves the memory of the tissue as it was."""
    class InPlace(branch):
        name = "in_place_branch"

        def response(self, C, state, dt):
            stress, tangent, found = super().response(C, [1.0 * each for each in state], dt)
            for each in (*C, *state):
                if isinstance(each, np.ndarray):
                    each += 1.0
            return stress, tangent, found

    registers(EFFECTS, InPlace)
    stuff = material(branch)
    forces = [ts.simulate(model(replace(stuff, effects=[kind(2 * G * C10, TAU)])), solver="solid", mesh=mesh()).force
              for kind in (branch, InPlace)]
    np.testing.assert_array_equal(*forces)
