"""A sensor whose every reading is off by one share."""

from calibration.effects.candidates import beside_material, require_tests
from calibration.effects.effect import Candidate, Effect, Situation

#: Relative error that is tried first.
_ERROR = 0.01


class SensorGain(Effect):
    """A relative error of every force: another stiffness, by force and displacement alone."""

    name = "sensor_gain"
    room = "rig"
    title = "error of the sensor's scale"
    signature = "every force is off by one share, as if the tissue were stiffer"
    separated_by = "dead weights; no test on tissue tells it from the moduli"
    known_twins = ("session_scale", "radius_error")
    like_moduli = True

    def candidates(self, situation: Situation) -> list[Candidate]:
        tests = require_tests(situation.simulated(), "no test was recorded as force and displacement")
        return beside_material(self, situation, "rig.sensor_gain", tests, lambda _: _ERROR)
