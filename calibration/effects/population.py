"""Differences in stiffness between specimens."""

from calibration.campaign.parameters import PER_SPECIMEN
from calibration.effects.effect import Candidate, DiagnosisData, Effect, NotTestableError


class Population(Effect):
    """Effect of a stiffness factor of each specimen relative to the first specimen."""

    name = "population"
    category = "population"
    title = "scatter between specimens"
    signature = "all forces of one specimen are too high, or too low, by the same factor in all of its tests"
    separated_by = "all tests on every specimen, and more specimens"
    #: Trial relative change of the stiffness.
    trial_change = 0.02
    #: Largest factor of the stiffness, and largest inverse factor, that a refit may find.
    max_factor = 5.0

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return the candidate with one factor for each specimen except the first."""
        path = "effects.stiffness_scale.ratio"
        situation.require_unused_parameter(path)
        tests = situation.simulated_tests(lambda test: test.specimen is not None)
        specimens = list(dict.fromkeys(test.specimen.name for test in tests if test.specimen is not None))
        if len(specimens) < 2:
            raise NotTestableError("all tests use one specimen, so variation between specimens is not tested")
        others = tuple(test.name for test in tests
                       if test.specimen is not None and test.specimen.name != specimens[0])
        return [Candidate(self, {path: 1.0 + self.trial_change},
                          bounds={path: (1.0 / self.max_factor, self.max_factor)}, tests=others, scope=PER_SPECIMEN)]
