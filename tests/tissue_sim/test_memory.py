"""History variables of the finite elements: relaxation and softening at the quadrature points."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import trapezoid

import tissue_sim as ts
from tissue_sim.fem.axisymmetric.discretisation import build_mesh, build_solver_on_mesh, find_element_layer_indices
from tissue_sim.fem.axisymmetric.solver import AxisymmetricSolver
from tissue_sim.fem.solver import Step, StepStatus
from tissue_sim.fem.stepping import iterate_adaptive_steps_to_pose
from tissue_sim.mesh import cylinder_mesh
from tissue_sim.mesh.elements import Q4P0, Q9P1

#: Name of the law.
LAW = "reduced_polynomial_2"
#: Parameters of the reference study, Pa.
STUDY = {"C10": 1404.9, "C20": 699.4}
#: Radius, m.
RADIUS = 0.040
#: Height, m.
HEIGHT = 0.070
#: Speed, m/s.
SPEED = 0.248e-3
#: Depth, m.
DEPTH = 0.010
RELAXING = ts.Prony((ts.PronyTerm(0.3, 2.0),))
SERIES = ts.Prony((ts.PronyTerm(0.2, 1.0), ts.PronyTerm(0.3, 30.0)))
SOFT = ts.Softening(0.4, modulus=20.0, share=0.5)
K = 3e7
NEEDLE = ts.Tool("flat", radius=8e-3)
PLATE = ts.Tool()


def model(protocol, tool=PLATE, friction="bonded", scale=1.0, **material):
    """The study's specimen; `scale` multiplies the parameters of the law, not the bulk modulus."""
    experiment = ts.Experiment(ts.Specimen(RADIUS, HEIGHT), protocol, tool=tool, friction=friction,
                               friction_base="frictionless" if friction == "frictionless" else "bonded")
    parameters = {name: scale * value for name, value in STUDY.items()}
    return ts.Model(experiment, ts.Material(LAW, parameters, **({"bulk": ts.Bulk("K_Pa", K)} | material)))


def force(*args, **options) -> np.ndarray:
    return ts.simulate(model(*args, **options)).force


def lubricated(protocol, **material):
    return force(protocol, friction="frictionless", bulk=ts.Bulk("bulk_ratio", 1e6), **material)


def closed_form(protocol, **material):
    stuff = ts.Material(LAW, STUDY, **material)
    return -np.pi * RADIUS**2 * ts.nominal_stress_history(stuff, protocol.time, 1 - protocol.displacement / HEIGHT)


class TestLubricated:
    def test_reference_of_another_code(self, reference):
        """Form B on ramp, hold and return; the plate lifts off where that code, which cannot, pulls."""
        time, _, _, form_b, *_ = np.loadtxt(reference / "lubricated_prony.csv", delimiter=",", unpack=True)
        corners = np.cumsum([0.0, DEPTH / SPEED, 60.0, DEPTH / SPEED])
        pushes = (time > 0) & (form_b > 0)
        assert [((time > begin) & (time <= end) & pushes).sum() for begin, end in pairwise(corners)] == [20, 30, 19]
        # In steps of 2 s, as the file, by the largest force; in finer ones sample by sample.
        for parts, scale in ((1, form_b.max()), (4, form_b[pushes])):
            fine = np.interp(np.arange(parts * time.size - parts + 1) / parts, np.arange(time.size), time)
            every = np.union1d(fine, corners)
            protocol = ts.Protocol(every, np.interp(every, corners, [0.0, DEPTH, DEPTH, 0.0]))
            found = lubricated(protocol, viscoelastic=RELAXING)[np.searchsorted(every, time)]
            assert (abs(found - form_b)[pushes] / scale).max() < 5e-4
            assert form_b[-1] < 0 and found[-1] == 0.0

    @pytest.mark.parametrize("material", [
        {"viscoelastic": SERIES}, {"softening": SOFT}, {"viscoelastic": SERIES, "softening": SOFT},
        {"viscoelastic": replace(SERIES, moduli="long_term"), "softening": SOFT},
    ], ids=["relaxing", "softening", "both", "both, long-term moduli"])
    def test_closed_form(self, material):
        """Two loadings, the second one deeper, with a hold in between and an unloading half way."""
        protocol = ts.Protocol.parse("ramp 6mm @1mm/s; hold 5s; unload 4mm; ramp 10mm @0.3mm/s; hold 40s", points=161)
        found, expected = lubricated(protocol, **material), closed_form(protocol, **material)
        assert expected.min() >= 0.0
        assert abs(found - expected).max() < 1e-5 * expected.max()


class TestRelaxation:
    """Bonded plates and the needle: where the deformation is not homogeneous."""

    @pytest.mark.parametrize(("tool", "precision"), [(PLATE, 1e-6), (NEEDLE, 3e-4)], ids=["plate", "needle"])
    @pytest.mark.parametrize(("moduli", "fast", "slow"), [("instantaneous", 1.0, 0.5), ("long_term", 2.0, 1.0)])
    def test_limits(self, tool, precision, moduli, fast, slow):
        """A sudden ramp is elastic with the instantaneous moduli, a very slow one, and a long hold, with the relaxed
        ones; the bulk modulus does not relax."""
        series = replace(SERIES, moduli=moduli)
        elastic = {scale: force(ts.Protocol.ramp(DEPTH, 6), tool, scale=scale)[1:] for scale in (fast, slow)}
        for speed, scale in ((1e6, fast), (1e-12, slow)):
            found = force(ts.Protocol.ramp(DEPTH, 6, speed), tool, viscoelastic=series)[1:]
            np.testing.assert_allclose(found, elastic[scale], rtol=precision)
        held = force(ts.Protocol.parse("ramp 10mm @1mm/s; hold 3000s", points=6), tool, viscoelastic=series)
        assert held[5] > 1.2 * held[-1]
        assert held[-1] == pytest.approx(elastic[slow][-1], rel=precision)

    def test_order_two_in_the_step(self):
        series = ts.Prony((ts.PronyTerm(0.4, 15.0),))
        ends = [force(ts.Protocol.ramp(DEPTH, 1 + steps), viscoelastic=series)[-1] for steps in (4, 8, 16, 256)]
        errors = abs(np.array(ends[:-1]) - ends[-1])
        assert errors[0] < 1e-2 * ends[-1]
        np.testing.assert_allclose(np.log2(errors[:-1] / errors[1:]), 2.0, atol=0.15)

    def test_four_terms_are_the_sum_of_their_like(self):
        """Equal times: terms whose shares add up are one term."""
        protocol = ts.Protocol.parse("ramp 5mm @1mm/s; hold 5s; unload 2mm", points=6)
        split = ts.Prony(tuple(ts.PronyTerm(0.1, 2.0) for _ in range(4)))
        one = ts.Prony((ts.PronyTerm(0.4, 2.0),))
        np.testing.assert_allclose(force(protocol, viscoelastic=split), force(protocol, viscoelastic=one), rtol=1e-8,
                                   atol=1e-9)

    def test_standing_specimen_has_relaxed(self):
        """A specimen sags with the relaxed moduli, and answers a sudden load with the instantaneous ones."""
        tall = ts.Specimen(RADIUS, HEIGHT, density=1040.0, gravity=9.81)
        sags, forces = [], []
        for scale, material in ((1.0, {}), (0.5, {}), (1.0, {"viscoelastic": SERIES})):
            m = model(ts.Protocol.ramp(1e-3, 3, 1e3), scale=scale, **material)
            recording = ts.simulate(replace(m, experiment=replace(m.experiment, specimen=tall)))
            sags.append(recording.metadata["solver"]["self_weight"]["sag_mm"])
            forces.append(recording.force[-1])
        assert sags[1] > 1.8 * sags[0] and sags[2] == pytest.approx(sags[1], rel=1e-6)
        assert forces[0] == pytest.approx(forces[2], rel=0.1) and forces[1] < 0.6 * forces[2]

    @pytest.mark.slow
    def test_law_of_stretches(self):
        """Ogden with exponent 2 is Neo-Hooke, whatever is remembered."""
        protocol = ts.Protocol.parse("ramp 6mm @1mm/s; hold 3s; unload 3mm", points=7)
        experiment = model(protocol).experiment
        memory = {"viscoelastic": SERIES, "softening": SOFT, "bulk": ts.Bulk("K_Pa", K)}
        one, other = (ts.simulate(ts.Model(experiment, ts.Material(*law, **memory))).force
                      for law in ((LAW, {"C10": 1400.0, "C20": 0.0}), ("ogden_1", {"mu1": 2800.0, "alpha1": 2.0})))
        np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-9)


class TestSoftening:
    @pytest.mark.parametrize(("tool", "precision"), [(PLATE, 1e-8), (NEEDLE, 1e-3)], ids=["plate", "needle"])
    def test_unload_and_reload(self, tool, precision):
        """First load untouched, unloading lower, reloading on the unloading curve and on the first one beyond."""
        protocol = ts.Protocol.parse("ramp 6mm; unload 1mm; reload 10mm", points=19)
        elastic, soft = force(protocol, tool), force(protocol, tool, softening=SOFT)
        depth = protocol.displacement
        first = np.arange(depth.size) <= 18
        beyond = ~first & (depth >= 6e-3 - 1e-9)
        np.testing.assert_allclose(soft[first], elastic[first], rtol=precision, atol=1e-9)
        np.testing.assert_allclose(soft[beyond], elastic[beyond], rtol=precision)
        below = ~first & (depth < 5.5e-3)
        assert (soft[below] < 0.97 * elastic[below]).all() and (soft[below] > 0).all()
        away, again = slice(19, 37), slice(37, 55)
        returning = np.interp(depth[again], depth[away][::-1], soft[away][::-1])
        inside = depth[again] < 6e-3
        # Straight lines between samples: 0.278 mm apart during unloading.
        np.testing.assert_allclose(soft[again][inside], returning[inside], rtol=3e-3)

    def test_absent(self):
        protocol = ts.Protocol.parse("ramp 6mm; unload 1mm", points=7)
        np.testing.assert_allclose(force(protocol, softening=ts.Softening(0.0)), force(protocol), rtol=1e-10)


class TestDissipation:
    """Work of the tool over closed cycles of the needle, with its wall; frictionless, so that only the tissue loses."""

    PROTOCOL = ts.Protocol.parse("repeat 3 (ramp 6mm @1mm/s; unload)", points=25)

    def loops(self, **material):
        f, d, cycle = force(self.PROTOCOL, NEEDLE, "stick", **material), self.PROTOCOL.displacement, self.PROTOCOL.cycle
        taken = trapezoid(f[:25], d[:25])
        # Each cycle starts at the last sample, at the touch, of the one before.
        starts = [max(np.flatnonzero(cycle == n)[0] - 1, 0) for n in (1, 2, 3)]
        return np.array([trapezoid(f[start:start + 49], d[start:start + 49]) for start in starts]) / taken

    def test_elastic(self):
        assert abs(self.loops()).max() < 2e-3

    def test_softening_costs_once(self):
        loops = self.loops(softening=SOFT)
        assert loops[0] > 0.1 and abs(loops[1:]).max() < 2e-3

    @pytest.mark.parametrize("softening", [None, SOFT])
    def test_relaxation_costs_every_time(self, softening):
        loops = self.loops(viscoelastic=RELAXING, softening=softening)
        assert (loops > 0.02).all()
        assert loops[0] > loops[1] and loops[1] == pytest.approx(loops[2], rel=0.1)


class TestStepping:
    PROTOCOL = ts.Protocol.parse("ramp 8mm @1mm/s; hold 3s; unload", points=3)
    MEMORY = {"viscoelastic": SERIES, "softening": SOFT}

    def test_cut_step_is_two_samples(self, monkeypatch):
        """Steps longer than 1.5 mm fail: 4 mm are cut in four, and their time with them."""
        def quarters(values):
            return np.interp(np.arange(4 * values.size - 3) / 4, np.arange(values.size), values)

        time, depth = quarters(self.PROTOCOL.time), quarters(self.PROTOCOL.displacement)
        asked = np.isin(np.arange(time.size), 4 * np.arange(self.PROTOCOL.time.size))
        kept = asked | (np.diff(depth, prepend=0.0) != 0)
        expected = force(ts.Protocol(time[kept], depth[kept]), **self.MEMORY)[asked[kept]]
        step = AxisymmetricSolver.step

        def short(solver, pose, *args, **options):
            if abs(pose.depth - solver.depth) > 1.5e-3:
                return Step.from_axial_force(StepStatus.SLOW, 1, 1.0, 0.0)
            return step(solver, pose, *args, **options)

        monkeypatch.setattr(AxisymmetricSolver, "step", short)
        cut = ts.simulate(model(self.PROTOCOL, **self.MEMORY))
        assert cut.metadata["solver"]["cuts"] > 8
        np.testing.assert_allclose(cut.force, expected, rtol=1e-7, atol=1e-9)

    @pytest.mark.parametrize(("tool", "friction"), [(PLATE, "bonded"), (PLATE, 0.3), (NEEDLE, "bonded")],
                             ids=["bonded plate", "friction", "needle"])
    def test_restored_state_goes_on_as_before(self, tool, friction):
        m = model(self.PROTOCOL, tool, friction, **self.MEMORY)
        solver = build_solver_on_mesh(m, build_mesh(m.experiment))

        def go(depth, dt):
            *_, step = iterate_adaptive_steps_to_pose(solver, ts.Pose.at_depth(depth), dt)
            assert step.status is StepStatus.CONVERGED
            return step.force

        way = [(7e-3, 1.0), (7e-3, 2.0), (5.5e-3, 0.5), (6.5e-3, 3.0)]
        for depth in np.linspace(1e-3, 6e-3, 6):
            go(float(depth), 1.0)
        saved = solver.save()
        once = [go(*target) for target in way]
        solver.restore(saved)
        assert solver.depth == 6e-3
        assert [go(*target) for target in way] == once

    def test_failed_step_is_forgotten(self):
        m = model(self.PROTOCOL, **self.MEMORY)
        forces = []
        for fails in (False, True):
            solver = build_solver_on_mesh(m, build_mesh(m.experiment))
            assert solver.step(5e-3, 1.0).status is StepStatus.CONVERGED
            if fails:
                assert solver.step(69e-3, 1.0).status is not StepStatus.CONVERGED
            forces.append([solver.step(4e-3, 1.0).force, solver.step(4e-3, 5.0).force])
        np.testing.assert_allclose(*forces, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("element", [Q9P1, Q4P0], ids=lambda e: e.name)
def test_tangent_is_the_derivative_of_the_residual(element):
    """Every column of the condensed tangent of a relaxing, softened state, layers included, against central
    differences of nodal forces, as in test_axisymmetric.py for the elastic solid."""
    mesh = cylinder_mesh(RADIUS, HEIGHT, (2, 2), element)
    stuff = ts.Material(LAW, STUDY, ts.Bulk("bulk_ratio", 1e3), viscoelastic=SERIES, softening=SOFT,
                        layers=(ts.Layer(HEIGHT / 2, 2.5),))
    layers = find_element_layer_indices(mesh, stuff.layers)
    solver = AxisymmetricSolver(mesh, stuff, {"base": "rz"}, {"top": "rz"}, element_layers=layers)
    for depth, dt in ((5e-3, 0.5), (10e-3, 1.0), (8e-3, 0.3)):
        assert solver.step(depth, dt).status is StepStatus.CONVERGED
    assert (solver.equations.memory.energies < solver.equations.memory.largest).mean() > 0.5, "softened in most places"
    lower = solver.equations.assemble_committed_tangent()
    tangent = np.zeros((solver.equations.free, solver.equations.free))
    for d in range(lower.shape[0]):
        i = np.arange(solver.equations.free - d)
        tangent[i + d, i] = tangent[i, i + d] = lower[d, : solver.equations.free - d]

    freedoms = 2 * len(mesh.nodes)
    state, remembered = solver.state[:freedoms], [array.copy() for array in solver.equations.memory.state_arrays]
    shared = np.unique(mesh.connectivity[:, : element.boundary_nodes])
    everything_held = type(mesh)(element, mesh.nodes, mesh.connectivity, {**mesh.sets, "shared": shared})

    def nodal_forces(displacement):
        held = AxisymmetricSolver(everything_held, stuff, {"shared": "rz"}, {}, element_layers=layers)
        for array, before in zip(held.equations.memory.state_arrays, remembered, strict=True):
            array[:] = before
        held.equations.direction[:] = displacement / depth
        assert held.step(depth, 0.0, tolerance=1e-13).status is StepStatus.CONVERGED
        return held.equations.residual[held.equations.equation]

    h = 1e-7
    unknowns = np.flatnonzero((solver.equations.equation >= 0) & (solver.equations.equation < solver.equations.free))
    numeric = np.zeros_like(tangent)
    for dof in unknowns:
        kick = h * (np.arange(freedoms) == dof)
        column = (nodal_forces(state + kick) - nodal_forces(state - kick)) / (2 * h)
        numeric[solver.equations.equation[unknowns], solver.equations.equation[dof]] = column[unknowns]
    assert abs(tangent - numeric).max() < 1e-7 * abs(tangent).max()


class TestFields:
    @pytest.mark.parametrize("material", [{}, {"softening": SOFT}, {"viscoelastic": SERIES, "softening": SOFT},
                                          {"viscoelastic": SERIES, "layers": (ts.Layer(5e-3, 3.0),)}],
                             ids=["elastic", "softened", "softened and relaxing", "relaxing under a layer"])
    def test_stress_carries_the_force_through_every_row(self, material):
        """The mean over a row of elements of the force through its planes, from Cauchy stress, is the tool's: that is
        equilibrium, during loading, hold and unloading."""
        protocol = ts.Protocol.parse("ramp 8mm @1mm/s; hold 4s; unload 5mm", points=5)
        recording = ts.simulate(model(protocol, **material), fields=True)
        fields = recording.fields
        z = fields.mesh.nodes[fields.mesh.connectivity[:, :4], 1]
        rows = np.unique(z.min(axis=1), return_inverse=True)[1]
        for sample in (2, 4, 8, len(recording) - 1):
            F = fields.deformation_gradient(sample)
            # Nominal stress zZ = J sigma F^-T.
            nominal = F[..., 4] * (fields.at_points("cauchy_zz", sample) * F[..., 0]
                                   - fields.at_points("cauchy_rz", sample) * F[..., 2])
            carried = np.bincount(rows, (fields.weights * nominal).sum(axis=1))
            through = -carried / np.bincount(rows, np.ptp(z, axis=1)) * np.bincount(rows)
            np.testing.assert_allclose(through, recording.force[sample], rtol=1e-6)

    def test_relaxed_homogeneous_stress(self):
        protocol = ts.Protocol.parse("ramp 10mm @1mm/s; hold 2s", points=41)
        recording = ts.simulate(model(protocol, friction="frictionless", viscoelastic=SERIES), fields=True)
        cauchy = -recording.force[-1] / (np.pi * RADIUS**2) * (1 - DEPTH / HEIGHT)
        np.testing.assert_allclose(recording.fields.at_points("cauchy_zz"), cauchy, rtol=2e-3)
        np.testing.assert_allclose(recording.fields.at_points("von_mises"), -cauchy, rtol=2e-3)
        np.testing.assert_allclose(recording.fields.at_points("pressure"), -cauchy / 3, rtol=2e-3)
        np.testing.assert_allclose(recording.fields.at_points("cauchy_hoop"), 0.0, atol=1e-6 * abs(cauchy))
