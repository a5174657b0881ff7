"""Indentation with a flat needle, through the function that a user calls.

Reference: Taylor-Hood Q2/Q1, exactly incompressible, 910 elements (punch_bonded_face_side_wall_RP.csv): 0.3601 and
0.9363 N at 2 and 5 mm, 2.078 +- 0.002 N at 10 mm, where its finest wall lets the surface in by 0.037 mm.
"""

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.fem.axisymmetric import newton
from tissue_sim.fem.axisymmetric.discretisation import build_mesh, build_solver_on_mesh
from tissue_sim.fem.contact.pairs import TOLERANCES
from tissue_sim.fem.solver import StepStatus
from tissue_sim.fem.stepping import iterate_adaptive_steps_to_pose
from tissue_sim.mesh import structured_mesh

STUDY = {"C10": 1404.9, "C20": 699.4}
RADIUS = 8e-3
AT = [4, 10, 20]  # samples at 2, 5 and 10 mm of the 21-point ramp


def model(friction="bonded", *, edge=0.0, depth=10e-3, points=21, ratio=1e4, protocol=None, specimen=None, **options):
    experiment = ts.Experiment(specimen or ts.Specimen(0.040, 0.070), protocol or ts.Protocol.ramp(depth, points),
                               tool=ts.Tool("flat", RADIUS, edge), friction=friction, **options)
    return ts.Model(experiment, ts.Material("reduced_polynomial_2", STUDY, ts.Bulk("bulk_ratio", ratio)))


def halved(mesh):
    """Every interval cut in two, with the node sets of the needle."""
    lines = (np.unique(mesh.nodes[mesh.connectivity[:, :4], k]) for k in range(2))
    fine = structured_mesh(*(np.sort(np.concatenate([x, 0.5 * (x[1:] + x[:-1])])) for x in lines), mesh.element)
    top = fine.sets["top"]
    distance = fine.nodes[top, 0] - RADIUS
    fine.sets.update(face=top[distance < 1e-9], free=top[distance > -1e-9])
    return fine


@pytest.fixture(scope="module")
def punch(reference):
    return np.loadtxt(reference / "punch_bonded_face_side_wall_RP.csv", delimiter=",")


@pytest.fixture(scope="module")
def accurate():
    return ts.simulate(model(), resolution="accurate", fields=True)


class TestBondedFace:
    def test_accurate(self, accurate, punch):
        np.testing.assert_allclose(accurate.displacement * 1e3, punch[:, 0], atol=1e-12)
        error = accurate.force[AT] / [0.3601, 0.9363, 2.078] - 1
        assert abs(error[:2]).max() < 1e-3 and abs(error[2]) < 2e-3
        # The whole curve; its deep end is low by the penetration of its wall.
        assert abs(accurate.force[1:] / punch[1:, 1] - 1).max() < 2.5e-3

    def test_fast(self):
        fast = ts.simulate(model())
        assert abs(fast.force[AT] / [0.3601, 0.9363, 2.078] - 1).max() < 1e-2

    def test_the_surface_folds_onto_the_shaft_and_stays_outside(self, accurate):
        """A mesh without the wall can give the right force by cancellation of errors, so the fold is checked."""
        mesh = accurate.fields.mesh
        free = mesh.sets["free"]
        for sample in range(len(accurate.force)):
            place = (mesh.nodes + accurate.fields.displacement(sample))[free]
            assert place[:, 0].min() > 7.98e-3
        # At 10 mm tissue stands against the shaft, above the face.
        assert ((place[:, 0] < 8.01e-3) & (place[:, 1] > -9.9e-3)).sum() >= 5

    def test_penetration_is_stated(self, accurate):
        solver = accurate.metadata["solver"]
        assert solver["penetration_tolerance_mm"] == pytest.approx(TOLERANCES.needle * 8.0)
        assert 0 < solver["penetration_mm"] <= solver["penetration_tolerance_mm"]

    @pytest.mark.slow
    def test_halving_the_accurate_mesh(self, accurate):
        fine = ts.simulate(model(), mesh=halved(build_mesh(model().experiment, "accurate")))
        assert fine.metadata["solver"]["mesh"]["elements"] == 4 * accurate.metadata["solver"]["mesh"]["elements"]
        assert abs(accurate.force[AT] / fine.force[AT] - 1).max() < 1e-3

    def test_compressibility_costs_force(self):
        """-0.8 and -0.08 % at 10 mm for K/mu = 1e2 and 1e3 (reference README), -0.008 % at 1e4."""
        stiff = ts.simulate(model(points=6)).force[-1]
        for ratio, loss in ((1e2, -8e-3), (1e3, -8e-4)):
            assert ts.simulate(model(points=6, ratio=ratio)).force[-1] / stiff - 1 == pytest.approx(loss, rel=0.25)

    @pytest.mark.parametrize("resolution", ["fast", "accurate"])
    def test_fifteen_millimetres(self, resolution):
        assert np.diff(ts.simulate(model(depth=15e-3, points=31), resolution=resolution).force).min() > 0

    @pytest.mark.parametrize("points", [2, 5, 101])
    def test_the_step_does_not_matter(self, points):
        """Elastic and frictionless: the force depends on the depth alone, as far as equilibrium is found."""
        force = ts.simulate(model(points=11)).force[-1]
        assert ts.simulate(model(points=points)).force[-1] == pytest.approx(force, rel=1e-8)

    def test_pulled(self):
        """A bonded face pulls; loading again gives the first curve."""
        protocol = ts.Protocol(np.arange(5.0), np.array([0.0, 2e-3, -1e-3, 0.0, 2e-3]))
        force = ts.simulate(model(protocol=protocol)).force
        assert force[2] < 0 and abs(force[3]) < 1e-6 * force[1] and force[4] == pytest.approx(force[1], rel=1e-6)


class TestUnilateralFace:
    @pytest.mark.slow
    def test_stick_is_bonded_while_it_is_pressed(self):
        bonded, stick = (ts.simulate(model(friction), resolution="accurate") for friction in ("bonded", "stick"))
        assert abs(stick.force[1:] / bonded.force[1:] - 1).max() < 1e-3

    @pytest.mark.parametrize(("friction", "edge"), [("stick", 0.0), ("frictionless", 2e-3)])
    def test_lifts_off(self, friction, edge):
        """Tissue that touches again sticks from the end of that step on, so the way down is made of small ones."""
        down = np.linspace(0.0, 1e-3, 11)
        protocol = ts.Protocol(np.arange(23.0), np.concatenate([down, [-1e-3], down]))
        force = ts.simulate(model(friction, edge=edge, protocol=protocol)).force
        assert force[10] > 0.1 and abs(force[11]) < 1e-9 and force[-1] == pytest.approx(force[10], rel=5e-3)

    def test_high_friction_with_a_rounded_edge(self):
        """Reference: Coulomb friction 0.7 with an edge radius of 0.25 mm, where nearly everything sticks."""
        recording = ts.simulate(model("stick", edge=0.25e-3), resolution="accurate")
        assert abs(recording.force[AT] / [0.3552, 0.929, 2.070] - 1).max() < 2e-3

    def test_frictionless_is_softer(self):
        """True frictionless contact tends to 1.94 N with a sharp edge (reference README); a rounded one is below."""
        force = [ts.simulate(model(friction, edge=1e-3), resolution="fast").force[-1]
                 for friction in ("frictionless", "stick")]
        assert 1.85 < force[0] < 1.94 < force[1]

    def test_small_depth_is_linear_elastic(self):
        """A circular punch on an incompressible half space, bonded or not: F = 8 mu a d (Johnson, Contact Mechanics,
        1985, equation 3.36 with nu = 1/2), here on a block 150 radii wide and high."""
        block = ts.Specimen(1.2, 1.2)
        shallow = model(specimen=block, protocol=ts.Protocol([0.0, 1.0], [0.0, 1e-6]), ratio=1e5)
        force = ts.simulate(shallow, resolution="accurate").force[-1]
        mu = 2 * STUDY["C10"]
        assert force == pytest.approx(8 * mu * RADIUS * 1e-6, rel=0.01)


class TestSweeps:
    @pytest.mark.parametrize("ratio", [50, 1e3, 1e6])
    def test_bulk_ratios(self, ratio):
        assert ts.simulate(model(ratio=ratio)).metadata["solver"]["status"] == "converged"

    @pytest.mark.parametrize(("radius", "height"), [(12e-3, 70e-3), (40e-3, 15e-3), (200e-3, 200e-3)])
    def test_specimens(self, radius, height):
        recording = ts.simulate(model(specimen=ts.Specimen(radius, height), depth=3e-3))
        assert np.diff(recording.force).min() > 0

    @pytest.mark.parametrize("edge", [0.25e-3, 1e-3, 4e-3, 7.9e-3])
    @pytest.mark.parametrize("friction", ["bonded", "stick", "frictionless"])
    def test_rounded_edges_end_in_a_value_or_a_clear_status(self, friction, edge):
        try:
            recording = ts.simulate(model(friction, edge=edge))
        except ts.ConvergenceError as error:
            assert "mm on the way to" in str(error) and error.depth > 0
        else:
            assert np.diff(recording.force).min() > 0


class TestTangent:
    @pytest.mark.parametrize(("friction", "edge"), [("bonded", 0.0), ("stick", 0.0), ("stick", 1e-3),
                                                    ("frictionless", 4e-3)])
    def test_quadratic_convergence(self, friction, edge):
        """Without changes of contact, a step without prediction needs few exact tangents."""
        m = model(friction, edge=edge)
        solver = build_solver_on_mesh(m, build_mesh(m.experiment))
        for depth in np.linspace(0, 6e-3, 25):
            *_, step = iterate_adaptive_steps_to_pose(solver, ts.Pose.at_depth(float(depth)))
            assert step.status is StepStatus.CONVERGED
        step = solver.step(6.0005e-3, predictor_order=0)
        assert step.status is StepStatus.CONVERGED and step.iterations <= 5

    def test_contact_part_against_differences(self):
        """What contact adds to the tangent, curvature of the edge included, against central differences of the nodal
        forces of the augmented Lagrangian, written here from the geometry of the edge."""
        edge = 4e-3
        m = model("frictionless", edge=edge)
        solver = build_solver_on_mesh(m, build_mesh(m.experiment))
        for depth in np.linspace(0, 4e-3, 17):
            *_, step = iterate_adaptive_steps_to_pose(solver, ts.Pose.at_depth(float(depth)))
        assert step.status is StepStatus.CONVERGED
        with_contact = solver.equations.assemble_committed_tangent()
        pressed = solver.equations.surface.pressed.copy()
        solver.equations.counts[newton.StepIntegerIndex.CONTACTS] = 0
        added = with_contact - solver.equations.assemble_committed_tangent()

        surface, freedoms = solver.equations.surface, 2 * len(solver.mesh.nodes)
        state, centre = solver.state, np.array([RADIUS - edge, edge])
        multipliers = state[-2 * surface.springs.size:].reshape(-1, 2)

        def nodal_forces(u):
            place = surface.deformed_positions(u.reshape(-1, 2)) + np.array([0.0, solver.depth])
            out = place - centre
            out[out[..., 0] < 0, 0] = 0.0
            out[out[..., 1] > 0, 1] = 0.0
            reach = np.linalg.norm(out, axis=-1, keepdims=True)
            normal = out / reach
            size = np.minimum((multipliers * normal).sum(axis=-1), 0) + surface.springs * (reach[..., 0] - edge)
            total = np.zeros((freedoms // 2, 2))
            force = (pressed * size)[:, None] * normal
            np.add.at(total, surface.nodes, surface.shapes[..., None] * force[:, None])
            return total.ravel()

        h, u = 1e-8, state[:freedoms]
        free = np.flatnonzero((solver.equations.equation >= 0) & (solver.equations.equation < solver.equations.free))
        touched = free[np.isin(free // 2, surface.nodes)]
        numeric = np.zeros_like(added)
        for dof in touched:
            kick = h * (np.arange(freedoms) == dof)
            column = (nodal_forces(u + kick) - nodal_forces(u - kick)) / (2 * h)
            equation = solver.equations.equation
            below = touched[equation[touched] >= equation[dof]]
            near = below[equation[below] - equation[dof] <= solver.equations.half_band]
            numeric[equation[near] - equation[dof], equation[dof]] = column[near]
        assert abs(added).max() > 0
        assert abs(added - numeric).max() < 1e-5 * abs(added).max()


class TestBadInput:
    @pytest.mark.parametrize(("change", "words"), [
        ({"tool": ts.Tool("flat", 0.05)}, "smaller than the specimen"),
        ({"tool": ts.Tool("flat", 8e-3), "friction": "frictionless"}, "sharp edge"),
        ({"tool": ts.Tool("flat", 8e-3), "friction": "0.7"}, "not an interface"),
        ({"tool": ts.Tool("flat", 8e-3), "friction": 70.0}, "not a coefficient of friction"),
        ({"tool": ts.Tool("flat", 8e-3), "friction_wall": "bonded"}, "Use 'stick', 'frictionless' or a coefficient"),
        ({"tool": ts.Tool("round", 8e-3)}, "no flat face to be bonded to"),
        ({"adhesion": ts.Adhesion(0.1, 1e-3)}, "never lifts off"),
    ])
    def test_experiment(self, change, words):
        with pytest.raises(ts.InputError, match=words):
            ts.Experiment(ts.Specimen(0.04, 0.07), ts.Protocol.ramp(0.01), **change)

    @pytest.mark.parametrize(("arguments", "words"), [
        (("ball", 8e-3), "unknown tool shape"), (("flat",), "needs a radius"), (("flat", -1.0), "positive length"),
        (("flat", 8e-3, 8e-3), "less than the radius"), (("plate", 8e-3), "covers the whole top"),
    ])
    def test_tool(self, arguments, words):
        with pytest.raises(ts.InputError, match=words):
            ts.Tool(*arguments)
