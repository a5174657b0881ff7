"""Puncture of the tissue by a needle."""

from calibration.effects.candidates import require_tests
from calibration.effects.effect import Candidate, DiagnosisData, Effect, NotTestableError, get_experiment


class Puncture(Effect):
    """Effect of a permanent drop of the needle force beyond a depth; one candidate per trial depth."""

    name = "puncture"
    category = "tissue"
    title = "puncture"
    signature = "the force of the needle drops suddenly at one depth and stays lower; plates show no drop"
    separated_by = "a repetition at a new site"
    #: Trial drop as a fraction of the force.
    trial_fraction = 0.05
    #: Largest drop, as a fraction of the force, that a refit may find.
    max_fraction = 0.95
    #: Trial depths as fractions of the largest depth of a needle.
    trial_depths = tuple(0.05 * step for step in range(1, 20))

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return one candidate (relative drop of the force) per trial depth of the puncture by a needle."""
        if situation.campaign.fit.placeholder_material_with_effects.puncture is not None:
            raise NotTestableError("the fitted material includes a puncture already, so this effect is not tested")
        needles = require_tests(situation.simulated_tests(lambda test: not get_experiment(test).tool.is_plate),
                                "no test has a needle")
        deepest = max(map(situation.largest_displacement, needles))
        drop, depth = "puncture.drop", "puncture.depth"
        return [Candidate(self, {drop: self.trial_fraction}, shape={depth: fraction * deepest},
                          bounds={drop: (0.0, self.max_fraction), depth: (0.01 * deepest, deepest)}, jump=depth)
                for fraction in self.trial_depths]
