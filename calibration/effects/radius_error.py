"""A specimen that is wider or thinner than stated."""

from calibration.effects.candidates import require_tests
from calibration.effects.effect import Candidate, Effect, Situation
from calibration.effects.specimen_size import sizes_of_specimens

#: Relative error that is tried first.
_ERROR = 0.01


class RadiusError(Effect):
    """An error of the radius, of each specimen its own."""

    name = "radius_error"
    room = "geometry"
    title = "error of the radius"
    signature = "plates are off by one share, and the needle is not"
    separated_by = "a caliper; no force tells it from another stiffness of the session"
    known_twins = ("session_scale",)

    def candidates(self, situation: Situation) -> list[Candidate]:
        tests = require_tests(situation.simulated(lambda test: test.specimen is not None),
                              "no test has a specimen of a size")
        return sizes_of_specimens(self, situation, "experiment.specimen.radius", tests, _ERROR)
