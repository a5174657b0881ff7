"""Friction of the linear guide."""

from calibration.effects.candidates import require_tests, rig_parameter_candidates
from calibration.effects.effect import Candidate, Effect, Situation

#: Trial friction force as a fraction of the smallest of the tests' largest forces.
_TRIAL_FRACTION = 0.01


class GuideFriction(Effect):
    """Constant force against the direction of motion, N."""

    name = "guide_friction"
    category = "rig"
    title = "friction of the guide"
    signature = "the force is too high by a constant in loading and too low by it in unloading, also in air"
    separated_by = "unloading, or a run in air"

    def candidates(self, situation: Situation) -> list[Candidate]:
        tests = require_tests(situation.simulated_tests(), "no test was recorded as force and displacement")
        return rig_parameter_candidates(self, situation, "rig.guide_friction", tests,
                                        lambda group: _TRIAL_FRACTION * min(map(situation.force, group)),
                                        two_sided=False)
