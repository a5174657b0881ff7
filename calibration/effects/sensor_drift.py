"""Drift of the force sensor's zero."""

from calibration.effects.candidates import require_tests, rig_parameter_candidates
from calibration.effects.effect import Candidate, Effect, Situation

#: Trial drift over the longest recording, as a fraction of the smallest of the tests' largest forces.
_TRIAL_FRACTION = 0.01


class SensorDrift(Effect):
    """Constant rate of change of the sensor's zero, N/s."""

    name = "sensor_drift"
    category = "rig"
    title = "drift of the sensor"
    signature = "the error of the force grows in proportion to time, also in holds and in air"
    separated_by = "a hold and an unloading"

    def candidates(self, situation: Situation) -> list[Candidate]:
        _, longest = situation.step_and_duration
        tests = require_tests(situation.simulated_tests(), "no test was recorded as force and displacement")
        return rig_parameter_candidates(self, situation, "rig.sensor_drift", tests,
                                        lambda group: _TRIAL_FRACTION * min(map(situation.force, group)) / longest)
