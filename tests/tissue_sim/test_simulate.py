"""Whole tests, through the function that a user calls, against curves of an independent solver."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import tissue_sim as ts
from tissue_sim.fem.axisymmetric.discretisation import build_mesh
from tissue_sim.fem.elements.fields import FIELD_UNITS, extrapolate_to_nodes_and_average
from tissue_sim.fem.solver import Step, StepStatus
from tissue_sim.fem.stepping import iterate_adaptive_steps_to_pose
from tissue_sim.mesh import cylinder_mesh

STUDY = {"C10": 1404.9, "C20": 699.4}
SAMPLES = {2: 4, 5: 10, 10: 20}  # mm -> sample of the 21-point ramp to 10 mm


def model(friction="bonded", law="reduced_polynomial_2", parameters=STUDY, ratio=1e4, depth=10e-3, points=21, **rig):
    experiment = ts.Experiment(ts.Specimen(0.040, 0.070), ts.Protocol.ramp(depth, points), friction=friction,
                               friction_base=friction)
    return ts.Model(experiment, ts.Material(law, parameters, ts.Bulk("bulk_ratio", ratio)), ts.Rig(**rig))


@pytest.fixture(scope="module")
def bonded_reference(reference):
    return np.loadtxt(reference / "bonded_RP.csv", delimiter=",")


@pytest.fixture(scope="module")
def accurate():
    return ts.simulate(model(), resolution="accurate", fields=True)


class TestBondedCompression:
    """Reference: Taylor-Hood Q2/Q1, exactly incompressible, 930 elements; K/mu = 1e4 costs 0.01 % against that."""

    def test_accurate(self, accurate, bonded_reference):
        np.testing.assert_allclose(accurate.displacement * 1e3, bonded_reference[:, 0], atol=1e-12)
        error = accurate.force[1:] / bonded_reference[1:, 1] - 1
        assert abs(error[SAMPLES[2] - 1]) < 1e-3 and abs(error[SAMPLES[5] - 1]) < 1e-3
        assert abs(error).max() < 2e-3

    @pytest.mark.parametrize("ratio", [1e4, 1e5])
    def test_fast(self, bonded_reference, ratio):
        fast = ts.simulate(model(ratio=ratio))
        assert abs(fast.force[1:] / bonded_reference[1:, 1] - 1).max() < 1e-2

    @pytest.mark.slow
    def test_halving_the_accurate_mesh(self, accurate):
        """Every interval of the accurate mesh is cut in two."""
        coarse = build_mesh(model().experiment, "accurate")
        lines = (np.unique(coarse.nodes[coarse.connectivity[:, :4], k]) for k in range(2))
        halved = [np.sort(np.concatenate([x, 0.5 * (x[1:] + x[:-1])])) for x in lines]
        from tissue_sim.mesh import structured_mesh

        fine = ts.simulate(model(), mesh=structured_mesh(*halved, coarse.element))
        assert fine.metadata["solver"]["mesh"]["elements"] == 4 * len(coarse.connectivity)
        assert abs(accurate.force[1:] / fine.force[1:] - 1).max() < 1e-3

    @pytest.mark.parametrize(("law", "parameters", "force"), [
        # The reference README: laws that fit the uniaxial test alike differ when bonded.
        ("neo_hooke", {"C10": 1461.6}, 8.92), ("mooney_rivlin", {"C10": 624.3, "C01": 746.1}, 9.17),
        ("ogden_1", {"mu1": 3225.9, "alpha1": 14.8}, 10.9),
    ])
    @pytest.mark.slow
    def test_other_laws(self, law, parameters, force):
        recording = ts.simulate(model(law=law, parameters=parameters), resolution="accurate")
        assert recording.force[-1] == pytest.approx(force, rel=7e-3)  # the reference has three digits

    @pytest.mark.parametrize(("ratio", "loss"), [(1e2, -1.06e-2), (1e3, -0.11e-2)])
    def test_compressibility_costs_force(self, accurate, ratio, loss):
        """-1.06 and -0.11 % at 10 mm for K/mu = 1e2 and 1e3 (reference README)."""
        softer = ts.simulate(model(ratio=ratio), resolution="accurate")
        assert softer.force[-1] / accurate.force[-1] - 1 == pytest.approx(loss + 1e-4, abs=2e-4)

    def test_incompressible_material(self, accurate):
        experiment = model().experiment
        recording = ts.simulate(ts.Model(experiment, ts.Material("reduced_polynomial_2", STUDY)), resolution="accurate")
        assert recording.force[-1] == pytest.approx(accurate.force[-1] * (1 + 1e-4), rel=5e-5)


class TestLubricatedCompression:
    def test_against_the_reference_curve(self, reference):
        curve = np.loadtxt(reference / "lubricated_RP.csv", delimiter=",")
        recording = ts.simulate(model("frictionless", ratio=1e5))
        np.testing.assert_allclose(recording.force, curve[:, 1], rtol=2e-4, atol=1e-9)


class TestRecordingOfASimulation:
    def test_report(self, accurate):
        report = accurate.metadata["solver"]
        assert report["status"] == "converged" and report["resolution"] == "accurate"
        assert report["newton_iterations"] > 20 and report["wall_s"] > 0 and report["cuts"] == 0
        assert report["mesh"] == {"elements": 320, "freedoms": 1895}

    def test_own_motion_drives_it(self):
        """Loading, holding and unloading samples, any spacing: an elastic force depends on the depth alone."""
        depth = np.array([0, 1, 4, 4, 9, 9.5, 3, 1, 0]) * 1e-3
        protocol = ts.Protocol(np.arange(depth.size) * 2.0, depth)
        base = model()
        experiment = ts.Experiment(base.experiment.specimen, protocol, friction="bonded", friction_base="bonded")
        recording = ts.simulate(ts.Model(experiment, base.material))
        np.testing.assert_array_equal(recording.displacement, depth)
        assert recording.force[1] == pytest.approx(recording.force[7], rel=1e-8)
        assert recording.force[2] == pytest.approx(recording.force[3], rel=1e-9)
        assert recording.force[-1] == pytest.approx(0.0, abs=1e-8)

    def test_progress_is_told(self):
        calls = []
        ts.simulate(model(points=5), progress=lambda *call: calls.append(call))
        assert calls == [(i, 5) for i in range(6)]

    @pytest.mark.parametrize(("depth", "cut", "precision"), [(10e-3, False, 1e-8), (40e-3, True, 0.05)])
    def test_one_big_step(self, depth, cut, precision):
        """10 mm of 70 in one go converge to the force of small steps. 40 mm are cut: the side that folds onto the
        plates sticks from the end of the step on in which it arrives, so the step matters there."""
        far = ts.simulate(model(depth=depth, points=2))
        near = ts.simulate(model(depth=depth, points=41))
        assert far.force[-1] == pytest.approx(near.force[-1], rel=precision)
        assert (far.metadata["solver"]["cuts"] > 0) == cut
        assert ("step cuts" in far.metadata["solver"]["message"]) == cut

    def test_rig_reports_what_a_rig_would(self):
        ideal = ts.simulate(model())
        noisy = ts.simulate(model(contact_offset=1e-4, zero_offset=0.5, force_noise=0.02, seed=3))
        again = ts.simulate(model(contact_offset=1e-4, zero_offset=0.5, force_noise=0.02, seed=3))
        np.testing.assert_array_equal(noisy.force, again.force)
        np.testing.assert_array_equal(noisy.displacement, ideal.displacement)
        later = np.interp(ideal.displacement - 1e-4, ideal.displacement, ideal.force)
        residual = noisy.force - later - 0.5
        assert abs(residual.mean()) < 0.02 and 0.01 < residual.std() < 0.03

    @pytest.mark.slow
    def test_unreachable_depth_keeps_the_converged_part(self):
        with pytest.raises(ts.ConvergenceError, match=r"stopped at .* mm on the way to .* mm \(sample") as caught:
            ts.simulate(model(depth=69e-3, points=35))
        part = caught.value.recording
        assert 30e-3 < caught.value.depth < 69e-3
        assert 5 < len(part) < 35 and part.displacement[-1] <= caught.value.depth
        assert part.metadata["solver"]["status"] == "not_converged"
        reference = ts.simulate(model(depth=part.displacement[-1], points=len(part)))
        np.testing.assert_allclose(part.force, reference.force, rtol=1e-8, atol=1e-9)

    def test_failure_names_the_law_when_the_law_is_at_fault(self):
        with pytest.raises(ts.ConvergenceError, match="the law alone is uniaxial: unstable below"):
            ts.simulate(model("frictionless", parameters={"C10": 1404.9, "C20": -300.0}, depth=50e-3))

    @pytest.mark.slow
    def test_first_sample_that_fails_leaves_no_recording(self):
        protocol = ts.Protocol([0.0], [69e-3])
        experiment = ts.Experiment(ts.Specimen(0.04, 0.07), protocol)
        with pytest.raises(ts.ConvergenceError) as caught:
            ts.simulate(ts.Model(experiment, model().material))
        assert caught.value.recording is None and 0 < caught.value.depth < 69e-3

    def test_steps_are_halved_and_doubled(self):
        """A stand-in for the solver that manages 3 mm at a time shows the order of the trials."""
        class Slow:
            pose = ts.Pose.at_depth(0.0)
            highest_order = 2
            crept = 0

            def step(self, trial, dt, predictor_order, max_iterations):
                good = abs(trial.depth - self.pose.depth) <= 3.0
                self.pose = trial if good else self.pose
                return Step.from_axial_force(StepStatus.CONVERGED if good else StepStatus.SLOW, 1, 0.0, 0.0)

        solver, trials = Slow(), []
        for _step in iterate_adaptive_steps_to_pose(solver, ts.Pose.at_depth(10.0)):
            trials.append(solver.pose.depth)
        # 10 and 5 fail with and without extrapolation, 2.5 succeeds, 5 more fail, 2.5 succeeds, ...
        assert trials == [0.0] * 4 + [2.5] * 3 + [5.0] * 3 + [7.5, 10.0]

        class Plain(Slow):
            highest_order = 0

        solver = Plain()
        trials = [solver.pose.depth for _step in iterate_adaptive_steps_to_pose(solver, ts.Pose.at_depth(10.0))]
        # Where nothing is extrapolated, nothing is tried twice alike.
        assert trials == [0.0] * 2 + [2.5] * 2 + [5.0] * 2 + [7.5, 10.0]

        class Stuck(Slow):
            def step(self, trial, dt, predictor_order, max_iterations):
                return Step.from_axial_force(StepStatus.SLOW, 1, 0.0, 0.0)

            def iterate_steps_with_damping(self, trial, dt, max_iterations):
                self.crept += 1
                return iter(())

        stuck = Stuck()
        tried = list(iterate_adaptive_steps_to_pose(stuck, ts.Pose.at_depth(10.0)))
        assert len(tried) == 2 * 11  # 2^0 down to 2^-10 of the way, each twice
        assert stuck.crept == 8  # from 2^-3 on

    def test_what_creeps_goes_on_from_there(self):
        class Snaps:
            pose = ts.Pose.at_depth(0.0)
            highest_order = 2

            def step(self, trial, dt, predictor_order, max_iterations):
                return Step.from_axial_force(StepStatus.SLOW, 1, 0.0, 0.0)

            def iterate_steps_with_damping(self, trial, dt, max_iterations):
                yield Step.from_axial_force(StepStatus.INVERTED, 1, 0.0, 0.0)
                self.pose = trial
                yield Step.from_axial_force(StepStatus.CONVERGED, 1, 0.0, 1.0)

        solver = Snaps()
        *_, last = iterate_adaptive_steps_to_pose(solver, ts.Pose.at_depth(8.0))
        assert last.status is StepStatus.CONVERGED and solver.pose.depth == 8.0

    def test_a_frictionless_plate_lifts_off(self):
        experiment = ts.Experiment(ts.Specimen(0.04, 0.07), ts.Protocol([0.0, 1.0, 2.0], [-1e-3, 0.0, 1e-3]),
                                   friction="frictionless", friction_base="frictionless")
        force = ts.simulate(ts.Model(experiment, model().material)).force
        assert force[0] == 0.0 and abs(force[1]) < 1e-9 < force[2]

    def test_threads_take_turns(self):
        with ThreadPoolExecutor(4) as pool:
            forces = list(pool.map(lambda _: ts.simulate(model(points=5)).force, range(8)))
        for force in forces[1:]:
            np.testing.assert_array_equal(force, forces[0])

    @pytest.mark.parametrize("resolution", ["fast", "accurate"])
    def test_slender_specimen_does_not_remember_its_path(self, resolution):
        """Radius 1, height 100 mm, as stiff in volume as the program goes for an incompressible material."""
        def force(depths):
            experiment = ts.Experiment(ts.Specimen(1e-3, 0.1), ts.Protocol(np.arange(len(depths)), depths))
            return ts.simulate(ts.Model(experiment, ts.Material("reduced_polynomial_2", STUDY)),
                               resolution=resolution).force[-1]

        assert force([0.0, 10e-3, 1e-3]) == pytest.approx(force([0.0, 1e-3]), rel=1e-6)

    def test_incompressible_flat_specimen(self):
        """K is chosen from the shape: at radius over height 5 a ratio of 1e5 would cost 5e-4."""
        experiment = ts.Experiment(ts.Specimen(0.04, 0.008), ts.Protocol.ramp(0.16e-3, 5))
        forces = [ts.simulate(ts.Model(experiment, ts.Material("reduced_polynomial_2", STUDY, bulk))).force[-1]
                  for bulk in (ts.Bulk(), ts.Bulk("bulk_ratio", 1e6), ts.Bulk("bulk_ratio", 1e5))]
        assert forces[0] == pytest.approx(forces[1], rel=1e-9)
        assert forces[2] / forces[1] - 1 == pytest.approx(-4.8e-4, rel=0.1)

    def test_unknown_resolution(self):
        with pytest.raises(ts.InputError, match="did you mean 'fast'"):
            ts.simulate(model(), resolution="fats")

    @pytest.mark.parametrize(("radius", "height", "strain"), [(0.025, 0.030, 0.1), (0.04, 0.012, 0.05),
                                                              (0.005, 0.05, 0.1)])
    def test_other_shapes(self, radius, height, strain):
        """A squat, a flat and a slender cylinder: fast against accurate. (Flat ones soon fold onto their plates.)"""
        experiment = ts.Experiment(ts.Specimen(radius, height), ts.Protocol.ramp(strain * height, 11),
                                   friction="bonded", friction_base="bonded")
        forces = [ts.simulate(ts.Model(experiment, model().material), resolution=r).force[-1]
                  for r in ("fast", "accurate")]
        assert forces[0] == pytest.approx(forces[1], rel=1e-2)


class TestFields:
    @pytest.mark.parametrize("ratio", [50.0, 1e4])
    def test_stored_energy_is_the_work_of_the_tool(self, ratio):
        """Volume changes store energy too: 2 % of it at K/mu = 50."""
        recording = ts.simulate(model(ratio=ratio), resolution="accurate", fields=True)
        fields = recording.fields
        stored = [(fields.weights * fields.at_points("energy", sample)).sum() for sample in range(len(recording))]
        work = CubicSpline(recording.displacement, recording.force).antiderivative()(recording.displacement)
        np.testing.assert_allclose(stored[5:], work[5:], rtol=1e-4)

    def test_linear_field_reaches_the_nodes_unchanged(self, accurate):
        fields = accurate.fields
        mesh = fields.mesh
        shapes, _ = mesh.element.evaluate_shape_functions_and_gradients(mesh.element.quadrature[0])
        linear = 3.0 + mesh.nodes @ np.array([2.0, -5.0])
        at_points = np.einsum("qa,ea->eq", shapes, linear[mesh.connectivity])
        np.testing.assert_allclose(extrapolate_to_nodes_and_average(mesh, at_points), linear, rtol=1e-12)

    def test_displacement_at_points_is_that_of_the_vector(self, accurate):
        """Under a plate the displacement is between 0 and 10 mm, and near the top almost 10 mm."""
        at_points = accurate.fields.at_points("displacement")
        assert 9.5e-3 < at_points.max() < 10.5e-3 and at_points.min() < 5e-4

    def test_homogeneous_stress(self):
        recording = ts.simulate(model("frictionless"), fields=True)
        fields, stretch = recording.fields, 1 - 10 / 70
        law = ts.find_law("reduced_polynomial_2")
        cauchy = stretch * law.nominal_stress(stretch, STUDY)
        np.testing.assert_allclose(fields.at_points("cauchy_zz"), cauchy, rtol=1e-4)
        np.testing.assert_allclose(fields.at_points("von_mises"), -cauchy, rtol=1e-4)
        for name in ("cauchy_rr", "cauchy_hoop", "cauchy_rz"):
            np.testing.assert_allclose(fields.at_points(name), 0.0, atol=1e-8 * abs(cauchy))
        np.testing.assert_allclose(fields.at_points("pressure"), -cauchy / 3, rtol=1e-4)
        np.testing.assert_allclose(fields.at_points("energy"), -np.trapezoid(
            law.nominal_stress(np.linspace(stretch, 1, 2001), STUDY), np.linspace(stretch, 1, 2001)), rtol=1e-4)
        np.testing.assert_allclose(fields.at_points("J"), 1.0, atol=1e-3)
        assert fields.at_points("displacement").max() < 10.0e-3

    def test_every_field_has_values_at_points_and_nodes(self, accurate):
        for name in FIELD_UNITS:
            assert np.isfinite(accurate.fields.at_points(name)).all()
            nodal = accurate.fields.at_nodes(name)
            assert nodal.shape == (len(accurate.fields.mesh.nodes),) and np.isfinite(nodal).all()

    def test_volume_is_kept(self, accurate):
        fields = accurate.fields
        assert (fields.weights * fields.at_points("J")).sum() == pytest.approx(fields.weights.sum(), rel=2e-4)

    def test_unknown_field(self, accurate):
        with pytest.raises(ts.InputError, match="did you mean 'von_mises'"):
            accurate.fields.at_points("von_mieses")


class TestExperiment:
    def test_deeper_than_the_specimen(self):
        with pytest.raises(ts.InputError, match="deeper than the specimen"):
            ts.Experiment(ts.Specimen(0.04, 0.07), ts.Protocol.ramp(0.08))

    @pytest.mark.parametrize("values", [(-0.04, 0.07), (0.04, 0.0), (float("nan"), 0.07)])
    def test_sizes(self, values):
        with pytest.raises(ts.InputError, match="must be a positive length"):
            ts.Specimen(*values)

    @pytest.mark.parametrize(("time", "displacement", "words"), [
        ([0, 1], [0], "same length"), ([0, 0], [0, 1], "increase"), ([0, np.nan], [0, 1], "finite"), ([], [], "length"),
    ])
    def test_protocol(self, time, displacement, words):
        with pytest.raises(ts.InputError, match=words):
            ts.Protocol(time, displacement)

    def test_interface(self):
        with pytest.raises(ts.InputError, match="is not a coefficient of friction"):
            ts.Experiment(ts.Specimen(0.04, 0.07), ts.Protocol.ramp(0.01), friction=-0.7)

    def test_base_is_like_the_tool_between_two_plates(self):
        ways = ts.Specimen(0.04, 0.07), ts.Protocol.ramp(0.01)
        assert ts.Experiment(*ways, friction=0.1).resolved_base_interface == 0.1
        assert replace(ts.Experiment(*ways, friction=0.1), friction=0.3).resolved_base_interface == 0.3
        assert ts.Experiment(*ways, friction="stick").resolved_base_interface == "stick"
        assert ts.Experiment(*ways, friction=0.1, friction_base=0.7).resolved_base_interface == 0.7
        assert ts.Experiment(*ways, friction=0.1, tool=ts.Tool("round", 0.008)).resolved_base_interface == "bonded"
        kind = ts.KINDS["friction_compression"]
        assert kind.experiment(specimen=ways[0], protocol=ways[1], friction=0.1).resolved_base_interface == 0.1
        assert kind.experiment(specimen=ways[0], protocol=ways[1]).resolved_base_interface == 0.7

    def test_mesh_of_a_homogeneous_experiment_is_small(self):
        assert len(build_mesh(model("frictionless").experiment, "accurate").connectivity) == 4

    def test_cylinder_mesh_sets(self):
        from tissue_sim.mesh.elements import Q9P1

        mesh = cylinder_mesh(0.04, 0.07, (2, 3), Q9P1)
        np.testing.assert_allclose(mesh.nodes[mesh.sets["top"], 1], 0)
        np.testing.assert_allclose(mesh.nodes[mesh.sets["base"], 1], -0.07)
        np.testing.assert_allclose(mesh.nodes[mesh.sets["axis"], 0], 0)
        np.testing.assert_allclose(mesh.nodes[mesh.sets["side"], 0], 0.04)
