"""Effects of the rig: compliance, backlash, offsets and drift of the sensor, friction and inertia."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from calibration.campaign.campaign import Test
from calibration.effects.candidates import make_experiment_or_rig_candidates, require_tests
from calibration.effects.effect import Candidate, DiagnosisData, Effect, NotTestableError
from tissue_sim.model import Model
from tissue_sim.rig.fault import Inertia as Mass


class MachineCompliance(Effect):
    """Effect of the deflection of the load train per unit force, m/N."""

    name = "machine_compliance"
    category = "rig"
    title = "machine compliance"
    signature = "the displacement is too large in proportion to the force, so stiff tests appear too soft"
    separated_by = "pressing on steel, or a deeper ramp"
    #: Trial deflection of the load train at the largest force, as a fraction of the largest displacement.
    trial_fraction = 0.01

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return the candidates whose trial compliance follows from the stiffest test."""
        tests = require_tests(situation.simulated_tests(), "no test was recorded as force and displacement")
        stiffest = max(tests, key=lambda test: situation.largest_force(test) / situation.largest_displacement(test))
        size = self.trial_fraction * situation.largest_displacement(stiffest) / situation.largest_force(stiffest)
        return make_experiment_or_rig_candidates(self, situation, "rig.compliance", tests, lambda _: size,
                                                 two_sided=False)


class DisplacementGain(Effect):
    """Effect of a relative error of the scale that all displacements share."""

    name = "displacement_gain"
    category = "rig"
    title = "error of the displacement's scale"
    signature = "the displacement axis is scaled by the same factor in every test, independently of the stiffness"
    separated_by = "a dial gauge, or a deeper ramp"
    #: Trial relative error.
    trial_error = 0.01

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return the candidates with a relative error of the displacement."""
        tests = require_tests(situation.simulated_tests(), "no test was recorded as force and displacement")
        return make_experiment_or_rig_candidates(self, situation, "rig.displacement_gain", tests,
                                                 lambda _: self.trial_error)


class Backlash(Effect):
    """Effect of lost motion of the drive at a reversal of its direction; the parameter is the lost motion, m."""

    name = "backlash"
    category = "rig"
    title = "backlash"
    signature = "after the reversal the force stays constant for a while, and the unloading curve is shifted by a " \
                "constant displacement"
    separated_by = "unloading; a ramp alone does not show it"
    #: Trial backlash as a fraction of the largest displacement.
    trial_fraction = 0.01

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return the candidates in the simulated tests with an unloading, one for each stated backlash."""
        tests = require_tests(situation.simulated_tests(situation.test_has_unloading),
                              "no recording has an unloading, and backlash shows only after a reversal")
        return make_experiment_or_rig_candidates(
            self, situation, "rig.backlash", tests,
            lambda group: self.trial_fraction * min(map(situation.largest_displacement, group)), two_sided=False)


class StepLoss(Effect):
    """Effect of a displacement that is lost permanently at one depth; one candidate per test and trial depth."""

    name = "step_loss"
    category = "rig"
    title = "step loss"
    signature = "the force of one test drops suddenly at one depth, as if the tool had moved back, and stays low"
    separated_by = "counting the steps on the return to zero"
    #: Trial loss as a fraction of the largest displacement.
    trial_fraction = 0.01
    #: Trial depths of the loss as fractions of the largest displacement.
    trial_depths = tuple(0.05 * step for step in range(2, 20))

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return one candidate per test and trial depth."""
        tests = require_tests(situation.simulated_tests(), "no test was recorded as force and displacement")
        loss, depth, found = "rig.step_loss", "rig.step_loss_depth", []

        def compute_trial_loss(group):
            """Return the trial loss of the first test of a group, m."""
            return self.trial_fraction * situation.largest_displacement(group[0])

        for fraction in self.trial_depths:
            for test in tests:
                found += make_experiment_or_rig_candidates(
                    self, situation, loss, [test], compute_trial_loss, each=True, two_sided=False,
                    shape={depth: fraction * situation.largest_displacement(test)}, jump=depth)
        return found


class ZeroOffset(Effect):
    """Effect of a constant error of the force, N; one candidate for all tests together and one for each test."""

    name = "zero_offset"
    category = "rig"
    title = "zero offset"
    signature = "the force is wrong by a constant, also in air"
    separated_by = "unloading, or an approach through air"
    #: Trial offset as a fraction of the smallest of the tests' largest forces.
    trial_fraction = 0.01

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return the candidates of all tests together and, for two or more tests, of each test."""
        tests = require_tests(situation.simulated_tests(), "no test was recorded as force and displacement")
        path = "rig.zero_offset"

        def compute_trial_offset(group):
            """Return the trial offset of a group of tests, N."""
            return self.trial_fraction * min(map(situation.largest_force, group))

        shared = make_experiment_or_rig_candidates(self, situation, path, tests, compute_trial_offset)
        if len(tests) < 2:
            return shared
        return [*shared,
                *make_experiment_or_rig_candidates(self, situation, path, tests, compute_trial_offset, each=True)]


class SensorDrift(Effect):
    """Effect of a constant rate of change of the sensor's zero, N/s."""

    name = "sensor_drift"
    category = "rig"
    title = "drift of the sensor"
    signature = "the error of the force grows in proportion to time, also in holds and in air"
    separated_by = "a hold and an unloading"
    #: Trial drift over the longest recording, as a fraction of the smallest of the tests' largest forces.
    trial_fraction = 0.01

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return the candidates with a drift of the zero."""
        _, longest = situation.sampling_interval_and_duration
        tests = require_tests(situation.simulated_tests(), "no test was recorded as force and displacement")
        return make_experiment_or_rig_candidates(
            self, situation, "rig.sensor_drift", tests,
            lambda group: self.trial_fraction * min(map(situation.largest_force, group)) / longest)


class SensorGain(Effect):
    """Effect of a relative error that all forces share; forces alone cannot separate this error from the moduli."""

    name = "sensor_gain"
    category = "rig"
    title = "error of the sensor's scale"
    signature = "all forces are wrong by the same factor, as if the tissue had another stiffness"
    separated_by = "dead weights; no test on tissue separates it from the moduli"
    known_twins = ("session_scale", "radius_error")
    scales_all_forces = True
    #: Trial relative error.
    trial_error = 0.01

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return the candidates with a relative error of the force."""
        tests = require_tests(situation.simulated_tests(), "no test was recorded as force and displacement")
        return make_experiment_or_rig_candidates(self, situation, "rig.sensor_gain", tests, lambda _: self.trial_error)


class Latency(Effect):
    """Effect of a time, s, by which the force is recorded later than the displacement."""

    name = "latency"
    category = "rig"
    title = "latency of the force"
    signature = "the force lags: it is too low in loading and too high in unloading, in proportion to the speed"
    separated_by = "a second speed"
    #: Trial latency as a fraction of the duration of the fastest loading.
    trial_fraction = 0.01

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return the candidates with a latency above the stated one."""
        tests = require_tests(situation.simulated_tests(), "no test was recorded as force and displacement")
        fastest = situation.find_largest_loading_speed(tests)
        size = self.trial_fraction * min(map(situation.largest_displacement, tests)) / fastest
        return make_experiment_or_rig_candidates(self, situation, "rig.latency", tests, lambda _: size, two_sided=False)


class GuideFriction(Effect):
    """Effect of a constant friction force of the guide, N, against the direction of motion."""

    name = "guide_friction"
    category = "rig"
    title = "friction of the guide"
    signature = "the force is too high by a constant in loading and too low by it in unloading, also in air"
    separated_by = "unloading, or a run in air"
    #: Trial friction force as a fraction of the smallest of the tests' largest forces.
    trial_fraction = 0.01

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return the candidates with a friction force above the stated one."""
        tests = require_tests(situation.simulated_tests(), "no test was recorded as force and displacement")
        return make_experiment_or_rig_candidates(self, situation, "rig.guide_friction", tests,
                                                 lambda group: self.trial_fraction
                                                 * min(map(situation.largest_force, group)),
                                                 two_sided=False)


class RateDamping(Effect):
    """Effect of a damping force of the rig in proportion to the speed; the parameter is the damping, N s/m."""

    name = "rate_damping"
    category = "rig"
    title = "damping of the rig"
    signature = "the force is wrong in proportion to the speed, and correct in holds"
    separated_by = "a second speed"
    #: Trial damping force at the largest speed, as a fraction of the smallest of the tests' largest forces.
    trial_fraction = 0.005

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return the candidates with a damping above the stated one."""
        tests = require_tests(situation.simulated_tests(), "no test was recorded as force and displacement")
        fastest = situation.find_largest_loading_speed(tests)
        return make_experiment_or_rig_candidates(
            self, situation, "rig.rate_damping", tests,
            lambda group: self.trial_fraction * min(map(situation.largest_force, group)) / fastest, two_sided=False)


#: Path of the mass, kg.
_PATH = "rig.faults.inertia.mass"


class Inertia(Effect):
    """Effect of a mass, kg, between force sensor and tissue, whose inertial force adds to the reading."""

    name = "inertia"
    category = "rig"
    title = "inertia of the tool"
    signature = "the force is wrong while the tool accelerates, and correct at constant speed"
    separated_by = "motion in air at the speed of a hand"
    #: Trial mass of the tool, kg: a typical mass of a small tool.
    trial_mass = 0.1
    #: Smallest inertial force that is worth a test, as a fraction of the noise.
    detectable_fraction = 0.1

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return the candidates with the trial mass if its inertial force would be detectable."""
        tests = require_tests(situation.simulated_tests(lambda test: "inertia" not in test.rig.faults),
                              "the rig states the mass of its tool already")
        fastest = situation.find_largest_loading_speed(tests)
        # Acceleration from rest to the largest speed v within 1 % of the displacement d: a = v^2 / (2 * 0.01 d).
        acceleration = fastest**2 / (0.02 * min(map(situation.largest_displacement, tests)))
        quietest = min(curve.noise.deviation for curve in situation.list_recordings(tests))
        if self.trial_mass * acceleration < self.detectable_fraction * quietest:
            raise NotTestableError(
                f"the tests are quasi-static: at {fastest * 1e3:.3g} mm/s a tool of {self.trial_mass:g} kg changes the "
                f"force by {self.trial_mass * acceleration:.1g} N, and the noise is {quietest:.1g} N")
        return make_experiment_or_rig_candidates(self, situation, _PATH,
                                                 [_add_massless_inertia_fault_to_test(test) for test in tests],
                                                 lambda _: self.trial_mass, two_sided=False,
                                                 prepare=_add_massless_inertia_fault_to_test)

    def apply(self, model: Model, values: Mapping[str, float]) -> Model:
        """Return the model with the mass; a rig without this fault gets it."""
        if "inertia" not in model.rig.faults:
            model = replace(model, rig=_add_massless_inertia_fault_to_rig(model.rig))
        return super().apply(model, values)


def _add_massless_inertia_fault_to_test(test: Test) -> Test:
    """Return the test with a fault `tissue_sim.rig.fault.Inertia` of mass 0 in its rig."""
    return replace(test, rig=_add_massless_inertia_fault_to_rig(test.rig))


def _add_massless_inertia_fault_to_rig(rig: Any) -> Any:
    """Return the rig with the additional fault `tissue_sim.rig.fault.Inertia` of mass 0."""
    return replace(rig, faults=[*rig.faults.values(), Mass(0.0)])


class ContactOffset(Effect):
    """Effect of a constant shift of the displacement, m, separate for each test."""

    name = "contact_offset"
    category = "rig"
    title = "contact offset"
    signature = "the force curve is shifted by a constant displacement, equally in loading and unloading"
    separated_by = "an approach through air, in which a kink of the force shows the first contact"
    #: Trial offset as a fraction of the largest displacement.
    trial_fraction = 0.005

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return one candidate with a trial shift of the displacement, m, for each simulated test."""
        tests = require_tests(situation.simulated_tests(), "no test was recorded as force and displacement")
        return make_experiment_or_rig_candidates(
            self, situation, "rig.contact_offset", tests,
            lambda group: self.trial_fraction * situation.largest_displacement(group[0]), each=True)
