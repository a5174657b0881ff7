"""Change of stiffness between sessions, for example by temperature."""

from calibration.effects.candidates import make_candidate_per_test, require_tests
from calibration.effects.effect import Candidate, DiagnosisData, Effect


class SessionScale(Effect):
    """Effect of a stiffness factor of one test relative to the first test."""

    name = "session_scale"
    category = "tissue"
    title = "stiffness of one session (temperature)"
    signature = "all forces of one test are too high, or too low, by the same factor"
    separated_by = "a thermometer, or a repetition of the first test after the last test"
    known_twins = ("radius_error",)
    #: Trial relative change of the stiffness.
    trial_change = 0.02
    #: Largest factor of the stiffness, and largest inverse factor, that a refit may find.
    max_factor = 5.0

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return one candidate with a stiffness factor for each simulated test except the first."""
        path = "effects.stiffness_scale.ratio"
        situation.require_unused_parameter(path)
        others = require_tests(situation.simulated_tests()[1:],
                               "only one test has a tool, so its stiffness has no reference")
        return make_candidate_per_test(self, others, lambda _: {path: 1.0 + self.trial_change},
                                       bounds={path: (1.0 / self.max_factor, self.max_factor)})
