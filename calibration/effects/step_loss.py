"""A motor that loses steps."""

from calibration.effects.candidates import beside_material, require_tests
from calibration.effects.effect import Candidate, Effect, Situation

#: Loss that is tried first, in largest displacements; and depths at which it may happen, likewise.
_SHARE, _DEPTHS = 0.01, tuple(0.05 * step for step in range(2, 20))


class StepLoss(Effect):
    """A way that is lost for good at one depth, of each test its own."""

    name = "step_loss"
    room = "rig"
    title = "step loss"
    signature = "the force of one test drops at once at one depth, as if the tool had been set back, and stays so"
    separated_by = "counting the steps back to zero"

    def candidates(self, situation: Situation) -> list[Candidate]:
        tests = require_tests(situation.simulated(), "no test was recorded as force and displacement")
        loss, depth, found = "rig.step_loss", "rig.step_loss_depth", []
        for share in _DEPTHS:
            for test in tests:
                found += beside_material(self, situation, loss, [test],
                                         lambda group: _SHARE * situation.depth(group[0]), each=True, both_ways=False,
                                         shape={depth: share * situation.depth(test)}, jump=depth)
        return found
