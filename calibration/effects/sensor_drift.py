"""A sensor whose zero wanders."""

from calibration.effects.candidates import beside_material, require_tests
from calibration.effects.effect import Candidate, Effect, Situation

#: Share of the smallest test's largest force by which the zero wanders in the longest recording, tried first.
_SHARE = 0.01


class SensorDrift(Effect):
    """A zero that goes on evenly with time."""

    name = "sensor_drift"
    room = "rig"
    title = "drift of the sensor"
    signature = "the force is off in proportion to the time, also in holds and in the air"
    separated_by = "a hold, and unloading"

    def candidates(self, situation: Situation) -> list[Candidate]:
        _, longest = situation.times
        tests = require_tests(situation.simulated(), "no test was recorded as force and displacement")
        return beside_material(self, situation, "rig.sensor_drift", tests,
                               lambda group: _SHARE * min(map(situation.force, group)) / longest)
