"""Scale error of the displacement, such as a wrong pitch of the lead screw."""

from calibration.effects.candidates import make_experiment_or_rig_candidates, require_tests
from calibration.effects.effect import Candidate, DiagnosisData, Effect


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
