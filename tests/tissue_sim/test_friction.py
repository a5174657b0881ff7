"""Coulomb friction and stick between plates and under a punch, through the function that a user calls where one does.

References: an independent Taylor-Hood Q2/Q1 solver, exactly incompressible (380 elements to 10 mm, 210 to 30 mm, 882
under the punch). Its friction agrees with a third program to 0.04 % at mu = 0.1.
"""

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.fem.axisymmetric import newton
from tissue_sim.fem.axisymmetric.contact import PENALTY
from tissue_sim.fem.axisymmetric.contact_kernels import TOUCHED
from tissue_sim.fem.axisymmetric.discretisation import build_mesh, build_solver_on_mesh
from tissue_sim.fem.linear import band
from tissue_sim.fem.solver import StepStatus
from tissue_sim.fem.stepping import iterate_adaptive_steps_to_pose

STUDY = {"C10": 1404.9, "C20": 699.4}
MATERIAL = ts.Material("reduced_polynomial_2", STUDY, ts.Bulk("bulk_ratio", 1e4))
RADIUS = 8e-3
AT = [4, 10, 20]  # samples at 2, 5 and 10 mm of the 21-point ramp
BOTH = pytest.mark.parametrize("resolution", ["fast", "accurate"])


def model(friction, tool=None, *, depth=10e-3, points=21, protocol=None, **options):
    """The study's cylinder between plates of equal friction, or under a tool with its base bonded."""
    base = options.pop("base", "bonded" if tool else friction)
    return ts.Model(ts.Experiment(ts.Specimen(0.040, 0.070), protocol or ts.Protocol.ramp(depth, points),
                                  tool or ts.Tool(), friction=friction, friction_base=base, **options), MATERIAL)


def stepped(friction, tool=None, depth=6e-3, steps=24):
    """A solver that was taken down in even steps."""
    tested = model(friction, tool)
    solver = build_solver_on_mesh(tested, build_mesh(tested.experiment))
    for place in np.linspace(0.0, depth, steps + 1)[1:]:
        *_, step = iterate_adaptive_steps_to_pose(solver, ts.Pose.at_depth(float(place)))
        assert step.status is StepStatus.CONVERGED
    return solver


class TestPlates:
    def test_mostly_stick(self, reference):
        """mu = 0.7: within 0.3 % at 2, 5 and 10 mm."""
        curve = np.loadtxt(reference / "friction0.7_RP.csv", delimiter=",")
        recording = ts.simulate(model(0.7), resolution="accurate")
        np.testing.assert_allclose(recording.displacement * 1e3, curve[:, 0], atol=1e-12)
        assert abs(recording.force[AT] / curve[AT, 1] - 1).max() < 3e-3
        solver = recording.metadata["solver"]
        assert 0 < solver["penetration_mm"] <= solver["penetration_tolerance_mm"]

    @BOTH
    def test_true_slip(self, resolution):
        slippery = ts.simulate(model(0.1), resolution=resolution)
        np.testing.assert_allclose(slippery.force[AT], [1.3012, 3.4659, 7.9919], rtol=2e-3)
        assert slippery.metadata["solver"]["slipping_points"] > 10
        assert ts.simulate(model(0.05), resolution=resolution).force[-1] == pytest.approx(7.79, rel=5e-3)

    @BOTH
    @pytest.mark.parametrize("mu", [0.2, 0.4])
    def test_partial_slip_reaches_ten_millimetres(self, mu, resolution):
        recording = ts.simulate(model(mu), resolution=resolution)
        force = recording.force[AT]
        # Between the forces of mu = 0.1 and 0.7.
        assert recording.metadata["solver"]["status"] == "converged"
        assert (force > [1.3012, 3.4659, 7.9919]).all() and (force < [1.541, 4.103, 9.465]).all()

    @BOTH
    def test_thirty_millimetres(self, resolution, reference):
        """Most of the side lies on the plates by then."""
        curve = np.loadtxt(reference / "friction0.7_30mm_RP.csv", delimiter=",")
        recording = ts.simulate(model(0.7, depth=30e-3, points=61), resolution=resolution)
        force = np.interp(curve[1:, 0], recording.displacement * 1e3, recording.force)
        on_samples = np.isclose(curve[1:, 0] % 0.5, 0.0)
        assert on_samples.sum() >= 10
        assert abs(force / curve[1:, 1] - 1)[on_samples].max() < 1e-2

    @BOTH
    def test_bonded_to_thirty_millimetres(self, resolution):
        """The bulge comes to lie on the plates: the reference of mu = 0.7, which sticks, is 82.2 N within 1 %."""
        recording = ts.simulate(model("bonded", depth=30e-3, points=61), resolution=resolution, fields=True)
        assert recording.force[-1] == pytest.approx(82.2, rel=1e-2)
        mesh = recording.fields.mesh
        place = mesh.nodes + recording.fields.displacement(60)
        side = place[mesh.sets["side"]]
        # Nothing of the side passes a plate, and three millimetres of it lie on either of them.
        assert side[:, 1].max() < -30e-3 + 1e-5 and side[:, 1].min() > -70e-3 - 1e-5
        assert side[side[:, 1] > -30.02e-3, 0].max() > 43e-3 and side[side[:, 1] < -69.98e-3, 0].max() > 43e-3

    def test_tends_to_lubricated(self):
        """The excess over the frictionless force is in proportion to mu."""
        free = ts.simulate(model("frictionless")).force[4:]
        excess = [ts.simulate(model(mu)).force[4:] / free - 1 for mu in (1e-3, 1e-4)]
        assert excess[1].min() > 0 and excess[1].max() < 1e-4
        np.testing.assert_allclose(excess[0], 10 * excess[1], rtol=0.02)

    def test_tends_to_bonded(self):
        bonded = ts.simulate(model("bonded")).force[1:]
        for friction in (2.0, "stick"):
            np.testing.assert_allclose(ts.simulate(model(friction)).force[1:], bonded, rtol=1e-4)

    @pytest.mark.slow
    def test_from_point_six_on_nothing_changes(self):
        """The study's finding for 0.6 to 0.9."""
        force = [ts.simulate(model(mu), resolution="accurate").force[1:] for mu in (0.6, 0.75, 0.9)]
        assert abs(np.array(force) / force[1] - 1).max() < 1e-3
        # It would be seen: 0.4 is 2 % below.
        assert ts.simulate(model(0.4), resolution="accurate").force[-1] < 0.985 * force[1][-1]

    @pytest.mark.parametrize(("mu", "tolerance"), [(0.7, 1e-12), (0.4, 1e-12), (0.1, 3e-5)])
    def test_top_and_base_mirror_each_other(self, mu, tolerance):
        """With mu = 0.1 the node of the top that lies on the axis, where it has no area, parts from the plate; the base
        holds its own."""
        solver = stepped(mu, depth=8e-3, steps=8)
        nodes, u = solver.mesh.nodes, solver.state[: 2 * len(solver.mesh.nodes)].reshape(-1, 2)
        straight, mirrored = (np.lexsort((nodes[:, 0], np.round(height, 9)))
                              for height in (nodes[:, 1], -70e-3 - nodes[:, 1]))
        np.testing.assert_allclose(nodes[straight, 1] + nodes[mirrored, 1], -70e-3, atol=1e-12)
        np.testing.assert_allclose(u[straight, 0], u[mirrored, 0], rtol=0, atol=tolerance)
        np.testing.assert_allclose(u[straight, 1] + u[mirrored, 1], -8e-3, rtol=0, atol=tolerance)


class TestPunch:
    @pytest.mark.slow
    def test_friction_and_a_rounded_edge(self, reference):
        """mu = 0.7, edge radius 0.25 mm: within 0.5 % at 2, 5 and 10 mm."""
        curve = np.loadtxt(reference / "punch_friction0.7_edge0.25mm_RP.csv", delimiter=",")
        recording = ts.simulate(model(0.7, ts.Tool("flat", RADIUS, 0.25e-3)), resolution="accurate")
        force = np.interp([2.0, 5.0, 10.0], curve[:, 0], curve[:, 1])
        assert abs(recording.force[AT] / force - 1).max() < 5e-3

    @pytest.mark.parametrize("edge", [1e-3, 4e-3])
    def test_force_grows_with_friction(self, edge):
        force = [ts.simulate(model(friction, ts.Tool("flat", RADIUS, edge))).force[-1]
                 for friction in ("frictionless", 0.1, 0.4)]
        assert (np.diff(force) > 0.01 * force[0]).all()

    def test_friction_of_the_shaft(self):
        """Tissue that folds onto the shaft holds on to it: with the face's friction alone less force is needed."""
        tool = ts.Tool("flat", RADIUS, 1e-3)
        force = [ts.simulate(model(0.4, tool, friction_wall=wall, depth=12e-3, points=25)).force
                 for wall in ("frictionless", 0.4)]
        assert abs(force[1][4] / force[0][4] - 1) < 1e-6, "no tissue on the shaft at 2 mm"
        assert force[1][-1] > 1.001 * force[0][-1]


class TestEnergy:
    """mu = 0.1: the work of the plate is stored or lost to friction, each summed here from what the solver left."""

    @staticmethod
    def cycle(steps):
        """Rows of work of the plate, friction's loss and stored energy, J, after each step down to 10 mm and back."""
        tested = model(0.1)
        solver = build_solver_on_mesh(tested, build_mesh(tested.experiment))
        surface, freedoms = solver.equations.surface, 2 * len(solver.mesh.nodes)
        rows, work, loss, depth, force = [], 0.0, 0.0, 0.0, 0.0
        radii, tractions = surface.places[:, 0].copy(), surface.forces[:, 0].copy()
        down = np.linspace(0.0, 10e-3, steps + 1)
        for place in [*down[1:], *down[-2::-1]]:
            *_, step = iterate_adaptive_steps_to_pose(solver, ts.Pose.at_depth(float(place)))
            assert step.status is StepStatus.CONVERGED
            work += 0.5 * (force + step.force) * (place - depth)
            depth, force = place, step.force
            displacement = solver.state[:freedoms].reshape(-1, 2)
            # Plates are level: only friction has a radial part.
            moved, pulled = surface.deformed_positions(displacement)[:, 0], surface.forces[:, 0].copy()
            loss += (0.5 * (tractions + pulled) * (moved - radii)).sum()
            radii, tractions = moved, pulled
            rows.append((work, loss, TestEnergy.stored(solver, displacement)))
        return np.array(rows)

    @staticmethod
    def stored(solver, displacement):
        """Isochoric energy; that of the volume is 1e-4 of it at K/mu = 1e4."""
        u = displacement[solver.mesh.connectivity]
        N = solver.equations.reference.node_gradients
        F = np.zeros((*N.shape[:2], 3, 3))
        F[..., :2, :2] = np.eye(2) + np.einsum("eqaj,eai->eqij", N[..., :2], u)
        F[..., 2, 2] = 1.0 + np.einsum("eqa,ea->eq", N[..., 2], u[..., 0])
        I1 = (F**2).sum(axis=(-1, -2)) * np.linalg.det(F) ** (-2 / 3)
        density = STUDY["C10"] * (I1 - 3) + STUDY["C20"] * (I1 - 3) ** 2
        return float((solver.equations.reference.weights * density).sum())

    def test_work_is_stored_or_lost(self):
        coarse, fine = self.cycle(10), self.cycle(40)
        for rows, tolerance in ((coarse, 4e-2), (fine, 5e-3)):
            work, loss, stored = rows.T
            assert abs(work - loss - stored).max() < tolerance * loss[-1]
            assert (np.diff(loss) > -1e-4 * loss[-1]).all(), "friction never gives energy back"
        # Back at the start nothing is stored, and what was put in is what friction took.
        work, loss, stored = np.array([coarse[-1], fine[-1]]).T
        assert abs(stored).max() < 1e-9 * work[0]
        error = abs(loss / work - 1)
        assert error[0] < 1e-3 and error[1] < 0.2 * error[0]
        # A twentieth of what went in.
        assert 0.04 < loss[1] / fine[:, 0].max() < 0.08


def test_hysteresis():
    """Friction adds to the force on the way down and, once all slips the other way, takes as much from it."""
    down = np.linspace(0.0, 6e-3, 13)
    there_and_back = ts.Protocol(np.arange(25.0), np.concatenate([down, down[-2::-1]]))
    force = ts.simulate(model(0.1, protocol=there_and_back)).force
    loading, unloading = force[1:12], force[23:12:-1]
    assert (unloading < loading).all()
    free = ts.simulate(model("frictionless", depth=6e-3, points=13)).force[1:7]
    np.testing.assert_allclose(0.5 * (loading + unloading)[:6], free, rtol=5e-3)
    assert (loading[:6] > 1.03 * free).all()


class TestTangent:
    @pytest.mark.parametrize(("mu", "tool"), [
        (0.1, None), (0.4, None), (0.1, ts.Tool("flat", RADIUS, 4e-3)), (0.1, ts.Tool("round", RADIUS))])
    def test_quadratic_convergence_with_slip(self, mu, tool):
        """Without changes between stick and slip, a step without prediction needs few exact tangents."""
        solver = stepped(mu, tool)
        step = solver.step(6.0005e-3, predictor_order=0)
        assert step.status is StepStatus.CONVERGED and step.slipping > 0 and step.iterations <= 5

    @pytest.mark.parametrize(("mu", "edge", "tolerance"), [(0.1, 4e-3, 1e-9), (0.3, 4e-3, 1e-5), (0.4, 2e-3, 1e-5)])
    def test_contact_part_against_differences(self, mu, edge, tolerance):
        """What slipping and sticking points add to the tangent, curvature of the edge included, against central
        differences of nodal forces of the augmented Lagrangian, written here from the geometry of the edge.

        With mu = 0.1 all points slip. A point that sticks is held by so stiff a spring that the curvature, 1e-5 of it,
        is not evaluated.
        """
        solver = stepped(mu, ts.Tool("flat", RADIUS, edge), depth=4e-3)
        surface, before = solver.equations.surface, solver.equations.surface.anchors.copy()
        assert solver.step(4.1e-3, predictor_order=0).slipping > 0
        # As within that step: slip is counted from where the points were before it. Those that stick have stuck to
        # where they are, all of their force in the multipliers.
        freedoms, state = 2 * len(solver.mesh.nodes), solver.state
        now = surface.deformed_positions(state[:freedoms].reshape(-1, 2)) - surface.places
        now[surface.moves] += [0.0, solver.depth]
        sticking = surface.slipped == 0
        before[sticking, 1:] = now[sticking]
        surface.anchors[:] = before
        with_contact = whole(solver)
        slipping, pressed = surface.slip_signs.copy(), surface.pressed.copy()
        solver.equations.counts[newton.StepIntegerIndex.CONTACTS] = 0
        added = with_contact - whole(solver)
        assert abs(added - added.T).max() > 1e-3 * abs(added).max(), "slip makes it unsymmetric"

        centre = np.array([RADIUS - edge, edge])
        multipliers = state[-2 * surface.springs.size:].reshape(-1, 2)
        moving = surface.moves & (pressed > 0)
        touching = moving & (before[:, 0] == TOUCHED)

        def nodal_forces(u):
            moved = surface.deformed_positions(u.reshape(-1, 2)) - surface.places
            moved[surface.moves] += [0.0, solver.depth]
            out = surface.places + moved - centre
            out[out[..., 0] < 0, 0] = 0.0
            out[out[..., 1] > 0, 1] = 0.0
            reach = np.linalg.norm(out, axis=-1, keepdims=True)
            normal = out / reach
            tangent = np.stack([-normal[..., 1], normal[..., 0]], axis=-1)
            size = np.minimum((multipliers * normal).sum(axis=-1), 0) + surface.springs * (reach[..., 0] - edge)
            size = np.where(moving, size, 0)
            travel = ((moved - before[..., 1:]) * tangent).sum(axis=-1)
            held = (multipliers * tangent).sum(axis=-1) + PENALTY.stick_factor * surface.springs * travel
            drag = np.where(touching & (size < 0), np.where(slipping != 0, -mu * slipping * size, held), 0.0)
            force = size[..., None] * normal + drag[..., None] * tangent
            total = np.zeros((freedoms // 2, 2))
            np.add.at(total, surface.nodes, surface.shapes[..., None] * force[:, None])
            return total.ravel()

        h, u = 1e-8, state[:freedoms]
        free = np.flatnonzero((solver.equations.equation >= 0) & (solver.equations.equation < solver.equations.free))
        touched = free[np.isin(free // 2, surface.nodes[surface.moves])]
        numeric = np.zeros_like(added)
        for dof in touched:
            kick = h * (np.arange(freedoms) == dof)
            column = (nodal_forces(u + kick) - nodal_forces(u - kick)) / (2 * h)
            numeric[solver.equations.equation[touched], solver.equations.equation[dof]] = column[touched]
        assert abs(added - numeric).max() < tolerance * abs(added).max()


def whole(solver):
    """The condensed tangent as a full matrix: lower blocks, and upper ones behind the first row where points slip."""
    solver.equations.assemble_committed_tangent()
    rows, width = solver.equations.entries.shape[:2]
    full = np.zeros((rows * band.BLOCK,) * 2)
    unsymmetric = bool(solver.equations.counts[newton.StepIntegerIndex.UNSYMMETRIC])
    skewed = int(solver.equations.counts[newton.StepIntegerIndex.SKEWED])
    for row in range(rows):
        for column in range(max(0, row - width + 1), row + 1):
            i, j = (slice(k * band.BLOCK, (k + 1) * band.BLOCK) for k in (row, column))
            w = column - row + width - 1
            below = solver.equations.entries[row, w].T
            if row == column:
                full[i, j] = below if unsymmetric else np.tril(below) + np.tril(below, -1).T
            else:
                full[i, j] = below
                full[j, i] = solver.equations.upper[row, w] if unsymmetric and column >= skewed else below.T
    return full[: solver.equations.free, : solver.equations.free]
