"""Error of the stated height of a specimen."""

from calibration.effects.candidates import make_specimen_size_candidates, require_tests
from calibration.effects.effect import Candidate, DiagnosisData, Effect


class HeightError(Effect):
    """Effect of a relative error of the stated height, separate for each specimen."""

    name = "height_error"
    category = "geometry"
    title = "error of the height"
    signature = "the strain under plates is wrong by a constant factor, which changes the slope and the curvature of " \
                "their curves; the needle agrees"
    separated_by = "a caliper, or a deeper ramp"
    #: Trial relative error.
    trial_error = 0.01

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return one candidate per specimen with a stated height."""
        tests = require_tests(situation.simulated_tests(lambda test: test.specimen is not None),
                              "no test has a specimen with stated dimensions")
        return make_specimen_size_candidates(self, situation, "experiment.specimen.height", tests, self.trial_error)
