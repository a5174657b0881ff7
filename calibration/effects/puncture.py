"""Puncture of the tissue by a needle."""

from calibration.effects.candidates import require_tests
from calibration.effects.effect import Candidate, Effect, NotTestableError, Situation, experiment_of

#: Trial drop as a fraction of the force.
_TRIAL_FRACTION = 0.05
#: Largest drop, as a fraction of the force, that a refit may find.
_MAX_FRACTION = 0.95
#: Trial depths as fractions of the largest depth of a needle.
_TRIAL_DEPTHS = tuple(0.05 * step for step in range(1, 20))


class Puncture(Effect):
    """Permanent drop of the needle force beyond a depth; one candidate per trial depth."""

    name = "puncture"
    category = "tissue"
    title = "puncture"
    signature = "the force of the needle drops suddenly at one depth and stays lower; plates show no drop"
    separated_by = "a repetition at a new site"

    def candidates(self, situation: Situation) -> list[Candidate]:
        if situation.campaign.fit.material.puncture is not None:
            raise NotTestableError("the fitted material has a puncture already")
        needles = require_tests(situation.simulated_tests(lambda test: not experiment_of(test).tool.is_plate),
                                "no test has a needle")
        deepest = max(map(situation.depth, needles))
        drop, depth = "puncture.drop", "puncture.depth"
        return [Candidate(self, {drop: _TRIAL_FRACTION}, shape={depth: fraction * deepest},
                          bounds={drop: (0.0, _MAX_FRACTION), depth: (0.01 * deepest, deepest)}, jump=depth)
                for fraction in _TRIAL_DEPTHS]
