"""Viscous damping of the rig."""

from calibration.effects.candidates import make_experiment_or_rig_candidates, require_tests
from calibration.effects.effect import Candidate, DiagnosisData, Effect


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
