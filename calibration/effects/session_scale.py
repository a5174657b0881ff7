"""A test on a warmer or colder day."""

from calibration.effects.candidates import per_test, require_tests
from calibration.effects.effect import Candidate, Effect, Situation

#: Relative change of the stiffness that is tried first, and the largest factor that a refit may find.
_CHANGE, _LARGEST = 0.02, 5.0


class SessionScale(Effect):
    """All of the material of one test times a number. The first test is what the others are compared with."""

    name = "session_scale"
    room = "tissue"
    title = "stiffness of one session (temperature)"
    signature = "every force of one test is too high, or too low, by the same share"
    separated_by = "a thermometer, or repeating the first test after the last"
    known_twins = ("radius_error",)

    def candidates(self, situation: Situation) -> list[Candidate]:
        path = "effects.stiffness_scale.ratio"
        situation.require_new(path)
        others = require_tests(situation.simulated()[1:],
                               "there is one test with a tool, and nothing to compare it with")
        return per_test(self, others, lambda _: {path: 1.0 + _CHANGE}, bounds={path: (1.0 / _LARGEST, _LARGEST)})
