"""Backlash: play between lead screw and nut."""

from calibration.effects.candidates import make_experiment_or_rig_candidates, require_tests
from calibration.effects.effect import Candidate, DiagnosisData, Effect


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
