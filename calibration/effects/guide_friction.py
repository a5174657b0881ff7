"""Friction of the linear guide."""

from calibration.effects.candidates import make_experiment_or_rig_candidates, require_tests
from calibration.effects.effect import Candidate, DiagnosisData, Effect


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
