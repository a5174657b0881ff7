"""Play between screw and nut."""

from calibration.effects.candidates import beside_material, require_tests
from calibration.effects.effect import Candidate, Effect, Situation

#: Play that is tried first, in largest displacements.
_SHARE = 0.01


class Backlash(Effect):
    """Lost motion at a reversal."""

    name = "backlash"
    room = "rig"
    title = "backlash"
    signature = "after the reversal the force stands still for a while, and is too high by a constant way from there on"
    separated_by = "unloading; a ramp alone does not show it"

    def candidates(self, situation: Situation) -> list[Candidate]:
        tests = require_tests(situation.simulated(situation.returns),
                              "no tool comes back, and only a reversal shows it")
        return beside_material(self, situation, "rig.backlash", tests,
                               lambda group: _SHARE * min(map(situation.depth, group)), both_ways=False)
