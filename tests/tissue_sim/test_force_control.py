"""Tests with a prescribed force: the displacement found is that of a displacement-controlled test with this force."""

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim import tool_drive
from tissue_sim.fem.solver import SOLVERS, Solver, Step, StepStatus
from tissue_sim.fem.stepping import iterate_adaptive_steps_to_pose
from tissue_sim.mesh import cylinder_mesh_refined_under_tip
from tissue_sim.mesh.elements import Q9P1
from tissue_sim.mesh.solid import create_cylinder_mesh_under_needle
from tissue_sim.mesh.solid_element import HEX8P0
from tissue_sim.rig.fault import RigFault
from tissue_sim.tool_drive import TOOL_SEARCH, SafeguardedSecant

#: Parameters of the reference study, Pa.
STUDY = {"C10": 1404.9, "C20": 699.4}
SERIES = ts.Prony((ts.PronyTerm(0.3, 2.0), ts.PronyTerm(0.2, 10.0)))
SOFT = ts.Softening(0.4, modulus=20.0, share=0.5)
#: Flat punch with a rounded edge.
PUNCH = ts.Tool("flat", 8e-3, 1e-3)


def model_of(protocol, tool=PUNCH, friction="bonded", rig=None, approach=None, **material):
    """A test of the reference study, between plates or on a bonded base."""
    if isinstance(protocol, str):
        protocol = ts.Protocol.parse(protocol, points=9)
    experiment = ts.Experiment(ts.Specimen(0.040, 0.070), protocol, tool=tool, friction=friction,
                               friction_base=friction if tool.is_plate else "bonded", approach=approach)
    stuff = ts.Material("reduced_polynomial_2", STUDY, ts.Bulk("bulk_ratio", 1e4), **material)
    return ts.Model(experiment, stuff, rig or ts.Rig())


def simulated(*arguments, solver="axisymmetric", mesh=None, error=False, **options):
    return ts.simulate(model_of(*arguments, **options), solver=solver, mesh=mesh, estimate_error=error)


def driven_along(recording, *, mesh=None, **options):
    """The forces of the displacement-controlled test along the displacements of a recording."""
    followed = ts.Protocol(recording.time, recording.displacement, recording.labels["segment"])
    return simulated(followed, mesh=mesh, **options).force


class TestAgainstDisplacementControl:
    @pytest.mark.slow
    @pytest.mark.parametrize(("text", "options"), [
        ("ramp 1N @0.5N/s", {}),
        ("ramp 1N @0.5N/s; hold 5s; unload; reload 1.5N; unload 0.5N", {"viscoelastic": SERIES, "softening": SOFT}),
        ("ramp 1N @0.5N/s; hold 5s; unload 0.2N; reload", {"friction": 0.3, "viscoelastic": SERIES}),
        ("ramp 1N @0.5N/s; unload", {"tool": ts.Tool(), "friction": 0.3}),
        ("ramp 3N @0.5N/s; repeat 2 (unload 1N; reload 4N); hold 9s", {"tool": ts.Tool(), "friction": "frictionless",
                                                                    "viscoelastic": SERIES, "softening": SOFT}),
    ], ids=["ramp", "creep and cycles", "friction", "plates with friction", "lubricated cycles"])
    def test_force_ramp_is_the_inverse_of_the_displacement_ramp(self, text, options):
        """The force is prescribed to 1e-8 of its largest, and the test along the found displacements gives it."""
        found = simulated(text, **options)
        prescribed = ts.Protocol.parse(text, points=9)
        np.testing.assert_allclose(found.force, prescribed.force, atol=1e-8 * found.force.max())
        np.testing.assert_array_equal(found.time, prescribed.time)
        assert found.labels["segment"].tolist() == prescribed.segment.tolist()
        # Another friction path in cut steps changes the force a little.
        bound = 1e-4 if options.get("friction") == 0.3 else 1e-6
        np.testing.assert_allclose(driven_along(found, **options), found.force, atol=bound * found.force.max())

    def test_ball(self):
        """The same mesh, made for the same depth."""
        ball = {"tool": ts.Tool("sphere", 8e-3), "friction": "frictionless"}
        protocol = ts.Protocol([0.0, 0.5, 1.0, 1.5], force=[0.0, 0.05, 0.1, 0.15], expected_depth=2.5e-3)
        found = simulated(protocol, **ball)
        followed = ts.Protocol(found.time, found.displacement, expected_depth=2.5e-3)
        assert 1e-3 < found.displacement.max() < 2.5e-3
        np.testing.assert_allclose(simulated(followed, **ball).force, protocol.force, atol=1e-6 * 0.15)

    @pytest.mark.slow
    @pytest.mark.parametrize("approach", [None, ts.Approach(2e-3, 0.2)], ids=["upright", "oblique"])
    def test_solid(self, approach):
        """Indentation by a ball in three dimensions, in the frame of the tool's motion, with relaxation."""
        options = {"tool": ts.Tool("sphere", 6e-3), "friction": "frictionless", "approach": approach,
                   "viscoelastic": SERIES}
        mesh = create_cylinder_mesh_under_needle(0.04, 0.07, 6e-3, HEX8P0, smallest=1.5e-3, growth=2.4, largest=0.02,
                                                 around=4, centre=(0.0 if approach is None else 2e-3, 0.0))
        protocol = ts.Protocol([0.0, 1.0, 2.0, 5.0, 6.0], force=[0.0, 0.1, 0.2, 0.2, 0.1], expected_depth=4e-3,
                               segment=["ramp", "ramp", "ramp", "hold", "unload"])
        found = simulated(protocol, solver="solid", mesh=mesh, **options)
        np.testing.assert_allclose(found.force, protocol.force, atol=1e-8 * 0.2)
        assert found.displacement[3] > found.displacement[2] > found.displacement[1]
        np.testing.assert_allclose(driven_along(found, mesh=mesh, solver="solid", **options), protocol.force,
                                   atol=1e-6 * 0.2)


class TestHertz:
    RADIUS = 8e-3

    def test_small_force_on_a_half_space(self):
        """d = (3 F / (4 E* sqrt(R)))^(2/3) on a block of 150 contact radii, as in `test_tips.py`."""
        depths = np.linspace(0.0, 1e-3, 5) * self.RADIUS
        plane_modulus, contact = 3 * 2000.0 / 0.75, self.RADIUS * np.sqrt(1e-3)
        size = 150 * contact
        mesh = cylinder_mesh_refined_under_tip(size, size, contact, Q9P1, smallest=0.1 * contact, growth=1.25,
                                               largest=size / 6)
        forces = 4 / 3 * plane_modulus * np.sqrt(self.RADIUS) * depths**1.5
        protocol = ts.Protocol(np.arange(5.0), force=forces, expected_depth=depths[-1])
        tool = ts.Tool("sphere", self.RADIUS)
        material = ts.Material("neo_hooke", {"C10": 1000.0}, ts.Bulk("bulk_ratio", 1e4))
        experiment = ts.Experiment(ts.Specimen(size, size), protocol, tool, friction="frictionless")
        found = ts.simulate(ts.Model(experiment, material), mesh=mesh)
        np.testing.assert_allclose(found.displacement[1:], depths[1:], rtol=1e-2)

    def test_on_a_given_mesh_the_test_is_simulated_once(self, monkeypatch):
        from tissue_sim import simulation

        drives, drive = [], simulation.ToolDrive
        monkeypatch.setattr(simulation, "ToolDrive", lambda *args, **options: drives.append(drive(*args, **options))
                            or drives[-1])
        mesh = cylinder_mesh_refined_under_tip(0.04, 0.07, 3e-3, Q9P1, smallest=1e-3, growth=2.0, largest=0.02)
        found = simulated(ts.Protocol([0.0, 1.0], force=[0.0, 0.05]), tool=ts.Tool("sphere", self.RADIUS),
                          friction="frictionless", mesh=mesh)
        assert len(drives) == 1 and found.force[-1] == pytest.approx(0.05, rel=1e-8)

    @pytest.mark.slow
    def test_the_mesh_suits_the_depth_that_is_reached(self):
        """Without a stated depth: that of a test on a mesh for the known depth, within the error of the meshes."""
        ball = {"tool": ts.Tool("sphere", self.RADIUS), "friction": "frictionless", "viscoelastic": SERIES}
        found = simulated("ramp 0.2N @0.1N/s; hold 60s", error=True, **ball)
        solver = found.metadata["solver"]
        assert solver["largest_tool_displacement_mm"] == pytest.approx(1e3 * found.displacement.max())
        assert 0.0 < solver["force_error"] < 0.01 and solver["warnings"] == []
        known = ts.Protocol.parse("ramp 0.2N @0.1N/s; hold 60s", points=9)
        known = ts.Protocol(known.time, force=known.force, segment=known.segment,
                            expected_depth=float(found.displacement.max()))
        np.testing.assert_allclose(simulated(known, **ball).displacement, found.displacement, rtol=0.01, atol=1e-6)


class TestCreep:
    def test_displacement_grows_towards_that_of_the_relaxed_material(self):
        """A hold of 30 relaxation times ends where the long-term material is under the same force."""
        options = {"tool": ts.Tool(), "friction": "frictionless"}
        crept = simulated("ramp 2N @0.5N/s; hold 900s", viscoelastic=SERIES, **options).displacement
        # Half of the shear modulus relaxes, and the bulk modulus does not.
        relaxed = ts.Material("reduced_polynomial_2", {name: 0.5 * value for name, value in STUDY.items()},
                              ts.Bulk("bulk_ratio", 2e4))
        slow = model_of("ramp 2N @0.5N/s", **options)
        expected = ts.simulate(ts.Model(slow.experiment, relaxed), estimate_error=False).displacement[-1]
        assert (np.diff(crept[:-10]) > 0).all()
        assert crept[-1] == pytest.approx(expected, rel=1e-6)


class TestSamplesOfAStickingContact:
    def test_the_error_of_few_samples_is_that_of_displacement_control(self):
        """Under a sphere each sample bonds new surface: a coarse path gives another force, equally in both controls."""
        options = {"tool": ts.Tool("sphere", 8e-3), "friction": "stick"}
        errors = []
        for points in (5, 9):
            coarse = simulated(ts.Protocol.parse("ramp 1N @0.5N/s", points=points), **options)
            np.testing.assert_allclose(driven_along(coarse, **options), coarse.force, atol=1e-6)
            fine = simulated(ts.Protocol.ramp(float(coarse.displacement[-1]), 65), **options)
            errors.append(fine.force[-1] / coarse.force[-1] - 1.0)
        assert 0.004 < errors[0] < 0.008 and errors[1] == pytest.approx(0.5 * errors[0], rel=0.1)


class TestAlternatingControl:
    TEXT = "ramp 3mm @1mm/s; hold 4s; ramp 1.5N @0.5N/s; hold 5s; unload 3mm; hold 2s; unload @0.1N/s"

    @pytest.mark.slow
    def test_each_segment_starts_from_the_response(self):
        found = simulated(self.TEXT, viscoelastic=SERIES)
        segment = found.labels["segment"]
        first, second = (int(np.argmin(abs(found.time - time))) for time in (3.0, 7.0))
        np.testing.assert_allclose(found.displacement[first:second + 1], 3e-3, rtol=1e-15)
        assert found.time[first] == pytest.approx(3.0) and found.time[second] == pytest.approx(7.0)
        raised = np.flatnonzero(np.isclose(found.force, 1.5, rtol=1e-8))
        rise = (1.5 - found.force[second]) / 0.5
        assert found.time[raised[0]] - 7.0 == pytest.approx(rise, rel=1e-9) and rise > 0
        assert found.time[raised[-1]] - found.time[raised[0]] == pytest.approx(5.0)
        out = np.flatnonzero(segment == "unload")[7:]
        assert found.displacement[out[0]] == pytest.approx(3e-3)
        assert segment[out[0]] == "unload" and found.force[-1] == pytest.approx(0.0, abs=1.5e-8)
        np.testing.assert_allclose(driven_along(found, viscoelastic=SERIES), found.force, atol=1e-6 * 1.5)

    def test_the_recording_ends_before_a_segment_that_cannot_start_from_the_response(self):
        words = r"next segment \(sample 10\), column 18: a ramp must increase the force, but the force is 0\.5"
        with pytest.raises(ts.ConvergenceError, match=words) as error:
            simulated("ramp 3mm @1mm/s; ramp 1mN @1N/s")
        assert len(error.value.recording) == 9 and error.value.recording.displacement[-1] == 3e-3


class TestRig:
    @pytest.mark.parametrize("rig", [
        ts.Rig(compliance=0.5e-3), ts.Rig(displacement_gain=-0.01, contact_offset=0.1e-3),
        ts.Rig(backlash=0.1e-3, compliance=0.1e-3), ts.Rig(sensor_gain=0.1, sensor_drift=1e-3)],
        ids=["compliance", "gain and offset", "backlash", "sensor"])
    def test_reading_is_prescribed_and_the_stage_reports_its_motion(self, rig):
        """The load cell reads the prescribed force, and this rig along the reported displacements gives it too."""
        text, options = "ramp 1N @0.5N/s; hold 5s; unload 0.3N; reload", {"viscoelastic": SERIES, "rig": rig}
        found = simulated(text, **options)
        np.testing.assert_allclose(found.force, ts.Protocol.parse(text, points=9).force, atol=2e-8)
        followed = driven_along(found, **options)
        # At the first touch of a stage with an offset, the displacement-controlled tool has no force.
        np.testing.assert_allclose(followed[1:], found.force[1:], atol=1e-6)

    @pytest.mark.parametrize("force", ["1N", "0.5N"])
    def test_backlash_does_not_act_while_the_force_is_held(self, force):
        """An elastic specimen holds its depth: the stage rests; it takes up the play where the force turns only."""
        text = f"ramp 1N @0.5N/s; hold 2s; unload 0.3N; hold 2s; reload {force}; hold 2s"
        ideal, found = (simulated(text, rig=ts.Rig(backlash=play)) for play in (0.0, 0.1e-3))
        segment = found.labels["segment"]
        play = ideal.displacement - found.displacement
        outwards = np.cumsum(segment == "unload") > 0
        outwards &= np.cumsum(segment == "reload") == 0
        np.testing.assert_allclose(play, np.where(outwards, 0.1e-3, 0.0), atol=1e-3 * 0.1e-3)

    def test_noise_does_not_move_the_tool(self):
        quiet, noisy = (simulated("ramp 1N @0.5N/s", rig=rig) for rig in (ts.Rig(), ts.Rig(force_noise=0.01)))
        np.testing.assert_array_equal(noisy.displacement, quiet.displacement)
        assert 1e-3 < abs(noisy.force - quiet.force).max() < 0.1

    @pytest.mark.parametrize("effect", ["latency", "guide_friction", "rate_damping", "zero_offset", "step_loss"])
    def test_effects_without_a_model(self, effect):
        with pytest.raises(ts.InputError, match=f"rig.{effect}: must be 0 with a prescribed force; got 0.01"):
            simulated("ramp 1N @0.5N/s", rig=ts.Rig(**{effect: 0.01}))

    def test_faults(self):
        class Drop(RigFault):
            name, title = "drop", "drop"

        with pytest.raises(ts.InputError, match=r"rig\.faults: must be empty with a prescribed force; got drop"):
            simulated("ramp 1N @0.5N/s", rig=ts.Rig(faults=[Drop()]))

    def test_reduced_forms_of_whole_tests(self):
        for name, value in (("slip", 0.5), ("tilt", 1e-4)):
            experiment = ts.Experiment(ts.Specimen(0.04, 0.07), ts.Protocol.parse("ramp 1N @1N/s"), **{name: value})
            with pytest.raises(ts.InputError, match=f"experiment.{name}: must be 0 with a prescribed force; got"):
                ts.simulate(ts.Model(experiment, ts.Material("neo_hooke", {"C10": 1e3})))


class TestForcesThatAreNotReached:
    def test_the_recording_ends_where_no_displacement_is_found(self):
        """Nothing pulls at a tool that may lift off."""
        protocol = ts.Protocol([0.0, 1.0, 2.0, 3.0, 4.0], force=[0.0, 0.1, 0.2, 0.1, -0.1])
        with pytest.raises(ts.ConvergenceError, match=r"on the way to a force of -0.1 N \(sample 5\), no displacement "
                                                      "of the tool gives this force; at .* the force is 0 N") as error:
            simulated(protocol, friction="stick")
        np.testing.assert_allclose(error.value.recording.force, [0.0, 0.1, 0.2, 0.1], atol=2e-9)
        assert error.value.recording.metadata["solver"]["status"] == "not_converged"

    def test_a_sharp_face_without_friction_stays_within_its_accurate_depth(self):
        with pytest.raises(ts.ConvergenceError, match=r"no displacement of the tool gives this force; at 1\.4 mm"):
            simulated("ramp 5N @1N/s", tool=ts.Tool("flat", 8e-3), friction="frictionless")

    @pytest.mark.parametrize(("tool", "friction", "material"), [
        (PUNCH, "stick", {}), (ts.Tool("sphere", 8e-3), 0.3, {"viscoelastic": SERIES})], ids=["punch", "sphere"])
    def test_a_pull_beyond_the_pull_off_force_ends_with_the_remedy(self, tool, friction, material, monkeypatch):
        """A smaller pull is reached; a larger one ends after a limited number of trials at the lift-off."""
        trials = []

        def count_and_iterate(*arguments, **options):
            trials.append(arguments[1])
            yield from iterate_adaptive_steps_to_pose(*arguments, **options)

        monkeypatch.setattr(tool_drive, "iterate_adaptive_steps_to_pose", count_and_iterate)
        experiment = ts.Experiment(ts.Specimen(0.040, 0.070), ts.Protocol(np.arange(5.0), force=[0, 0.2, 0, -5e-4, -1]),
                                   tool=tool, friction=friction, friction_base="bonded",
                                   adhesion=ts.Adhesion(0.02, 0.5e-3))
        model = ts.Model(experiment, ts.Material("neo_hooke", {"C10": 1e3}, ts.Bulk("bulk_ratio", 1e4), **material))
        with pytest.raises(ts.ConvergenceError, match=r"on the way to a force of -1 N \(sample 5\), no displacement .* "
                                                      "The tool lifts off at a smaller pull. Pull with a") as error:
            ts.simulate(model, estimate_error=False)
        np.testing.assert_allclose(error.value.recording.force, [0.0, 0.2, 0.0, -5e-4], atol=4e-9)
        assert len(trials) < 4 * TOOL_SEARCH.most_trials + TOOL_SEARCH.most_sample_trials

    def test_no_force_is_contact_without_a_gap(self):
        """After unloading to 0 N the tool touches: any motion into the tissue gives a force."""
        found = simulated("ramp 0.5N @0.5N/s; unload", friction="stick", viscoelastic=SERIES)
        assert found.displacement[-1] > 0.1e-3 and abs(found.force[-1]) <= 0.5e-8
        further = np.append(found.displacement, found.displacement[-1] + 2e-6)
        time = np.append(found.time, found.time[-1])
        pressed = simulated(ts.Protocol(time + 1e-9 * np.arange(time.size), further), friction="stick",
                            viscoelastic=SERIES)
        assert pressed.force[-1] > 1e-5


@pytest.mark.parametrize("use", [
    ts.Simulator, ts.sensitivities, ts.ForceCurve,
    lambda model: model.experiment.protocol.resample_at_fractional_samples(np.array([0.5]))],
    ids=["simulator", "sensitivities", "force curve", "resampling"])
def test_what_needs_displacements_refuses_a_force(use):
    with pytest.raises(ts.InputError, match=r"must prescribe displacements for .*; got a prescribed force"):
        use(model_of("ramp 1N @1N/s"))


class SnappingSolver(Solver):
    """Elastic foundation of 100 N/m whose force falls by half at 5 mm."""

    def __init__(self, model, *, resolution, mesh=None, topology=None):
        self._depth = 0.0

    @property
    def pose(self):
        return ts.Pose.at_depth(self._depth)

    def step(self, pose, dt=0.0, **options):
        self._depth = pose.depth
        force = 100.0 * self._depth * (0.5 if self._depth > 5e-3 else 1.0)
        return Step.from_axial_force(StepStatus.CONVERGED, 1, 0.0, force)

    def save(self):
        return self._depth

    def restore(self, saved):
        self._depth = saved

    def get_recording_metadata(self):
        return {"element": "spring", "mesh": {}}

    def _unused(self, *arguments):
        raise NotImplementedError

    set_material = reset_to_first_touch = enable_stiffness_output = field_sample = fields = deformed_surface = _unused


def test_force_is_found_beyond_a_drop():
    """0.5 N is reached at 5 mm; a larger force needs twice its displacement on the first branch."""
    SOLVERS.register(SnappingSolver, "snapping")
    try:
        found = simulated(ts.Protocol(np.arange(4.0), force=[0.0, 0.3, 0.45, 0.6]), solver="snapping")
    finally:
        SOLVERS.unregister("snapping")
    np.testing.assert_allclose(found.displacement, [0.0, 3e-3, 4.5e-3, 12e-3], rtol=1e-6)


class TestSafeguardedSecant:
    @pytest.mark.parametrize(("function", "root"), [
        (lambda x: x**3 - 8.0, 2.0), (lambda x: max(x - 1.0, 0.0)**1.5 - 1e-3, 1.01),
        (lambda x: np.arctan(x - 50.0), 50.0),
        (lambda x: -1.0 if x < 3.3 else x - 3.3 + 1e-12, 3.3)])
    @pytest.mark.parametrize("start", [0.1, 20.0])
    def test_roots(self, function, root, start):
        search = SafeguardedSecant(start, None, least_slope=0.0, first_step=0.1)
        for _ in range(60):
            residual = function(search.trial)
            if abs(residual) < 1e-9 or not search.register_residual(residual):
                break
        assert search.trial == pytest.approx(root, rel=1e-6)

    def test_trials_do_not_grow_by_more_than_the_expansion(self):
        search, trials = SafeguardedSecant(0.0, 1e-9, least_slope=0.0, first_step=1.0, highest=500.0), [0.0]
        while search.trial < 500.0:
            search.register_residual(-1.0)
            trials.append(search.trial)
        assert trials == [0.0, *[sum(TOOL_SEARCH.expansion**k for k in range(1, n + 1)) for n in range(1, 6)], 500.0]


def test_tool_at_zero_force_follows_the_recovering_tissue():
    """After unloading to 0 N the tissue recovers, and the tool stays at its surface instead of in the air."""
    material = ts.Material("neo_hooke", {"C10": 1000.0}, ts.Bulk("bulk_ratio", 1e4),
                           viscoelastic=ts.Prony((ts.PronyTerm(0.5, 1.0),)))
    experiment = ts.KINDS["lubricated_compression"].experiment(
        specimen=ts.Specimen(0.01, 0.02), protocol=ts.Protocol.parse("ramp 0.5N @5N/s; hold 5s; unload; hold 5s", 8))
    recording = ts.simulate(ts.Model(experiment, material), estimate_error=False)
    fine = np.union1d(np.linspace(0.0, recording.time[-1], 2001), recording.time)
    stress = -np.interp(fine, recording.time, recording.force) / (np.pi * 0.01**2)
    closed = np.interp(recording.time, fine, 0.02 * (1.0 - ts.stretch_history(material, fine, stress)))
    np.testing.assert_allclose(recording.displacement, closed, atol=5e-3 * closed.max())
    assert (recording.force[-5:] < 1e-8 * 0.5).all() and (np.diff(recording.displacement[-5:]) < 0.0).all()
