"""A specimen that is higher or lower than stated."""

from calibration.effects.candidates import require_tests
from calibration.effects.effect import Candidate, Effect, Situation
from calibration.effects.specimen_size import sizes_of_specimens

#: Relative error that is tried first.
_ERROR = 0.01


class HeightError(Effect):
    """An error of the height, of each specimen its own."""

    name = "height_error"
    room = "geometry"
    title = "error of the height"
    signature = "the strain of plates is off by one share, so both their level and their curvature; the needle agrees"
    separated_by = "a caliper, or a deeper ramp"

    def candidates(self, situation: Situation) -> list[Candidate]:
        tests = require_tests(situation.simulated(lambda test: test.specimen is not None),
                              "no test has a specimen of a size")
        return sizes_of_specimens(self, situation, "experiment.specimen.height", tests, _ERROR)
