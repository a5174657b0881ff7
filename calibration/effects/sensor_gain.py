"""Scale error of the force sensor."""

from calibration.effects.candidates import make_experiment_or_rig_candidates, require_tests
from calibration.effects.effect import Candidate, DiagnosisData, Effect


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
