"""Drift of the force sensor's zero."""

from calibration.effects.candidates import make_experiment_or_rig_candidates, require_tests
from calibration.effects.effect import Candidate, DiagnosisData, Effect


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
