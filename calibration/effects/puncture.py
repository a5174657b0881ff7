"""A surface that gives way under the needle."""

from calibration.effects.candidates import require_tests
from calibration.effects.effect import Candidate, Effect, NotTestableError, Situation, experiment_of

#: Share of the force that is tried first, and the largest that a refit may find.
_SHARE, _LARGEST = 0.05, 0.95
#: Depths that are tried, in largest depths of a needle.
_DEPTHS = tuple(0.05 * step for step in range(1, 20))


class Puncture(Effect):
    """A drop of the needle's force that stays, at each of some depths."""

    name = "puncture"
    room = "tissue"
    title = "puncture"
    signature = "the force of the needle drops at once at one depth and stays lower; plates feel nothing"
    separated_by = "a repeat at a new site"

    def candidates(self, situation: Situation) -> list[Candidate]:
        if situation.campaign.fit.material.puncture is not None:
            raise NotTestableError("the material that is fitted is punctured already")
        needles = require_tests(situation.simulated(lambda test: not experiment_of(test).tool.is_plate),
                                "no test has a needle")
        deepest = max(map(situation.depth, needles))
        drop, depth = "puncture.drop", "puncture.depth"
        return [Candidate(self, {drop: _SHARE}, shape={depth: share * deepest},
                          bounds={drop: (0.0, _LARGEST), depth: (0.01 * deepest, deepest)}, jump=depth)
                for share in _DEPTHS]
