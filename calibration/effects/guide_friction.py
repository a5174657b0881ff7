"""A guide that rubs."""

from calibration.effects.candidates import beside_material, require_tests
from calibration.effects.effect import Candidate, Effect, Situation

#: Share of the smallest test's largest force that is tried first.
_SHARE = 0.01


class GuideFriction(Effect):
    """A constant force against the motion."""

    name = "guide_friction"
    room = "rig"
    title = "friction of the guide"
    signature = "the force is too high by a constant on the way in and too low by it on the way back, also in the air"
    separated_by = "unloading, or a run in air"

    def candidates(self, situation: Situation) -> list[Candidate]:
        tests = require_tests(situation.simulated(), "no test was recorded as force and displacement")
        return beside_material(self, situation, "rig.guide_friction", tests,
                               lambda group: _SHARE * min(map(situation.force, group)), both_ways=False)
