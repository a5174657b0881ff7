"""Specimens that differ."""

from calibration.campaign.parameters import PER_SPECIMEN
from calibration.effects.effect import Candidate, Effect, NotTestableError, Situation

#: Relative change of the stiffness that is tried first, and the largest factor that a refit may find.
_CHANGE, _LARGEST = 0.02, 5.0


class Population(Effect):
    """A stiffness of its own of each specimen. The first one is what the others are compared with."""

    name = "population"
    room = "population"
    title = "scatter between specimens"
    signature = "every force of one specimen is too high, or too low, by the same share in all of its tests"
    separated_by = "all tests on each specimen, and more specimens"

    def candidates(self, situation: Situation) -> list[Candidate]:
        path = "effects.stiffness_scale.ratio"
        situation.require_new(path)
        tests = situation.simulated(lambda test: test.specimen is not None)
        specimens = list(dict.fromkeys(test.specimen.name for test in tests if test.specimen is not None))
        if len(specimens) < 2:
            raise NotTestableError("all tests are of one specimen")
        others = tuple(test.name for test in tests
                       if test.specimen is not None and test.specimen.name != specimens[0])
        return [Candidate(self, {path: 1.0 + _CHANGE}, bounds={path: (1.0 / _LARGEST, _LARGEST)}, tests=others,
                          scope=PER_SPECIMEN)]
