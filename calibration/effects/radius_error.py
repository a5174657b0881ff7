"""Error of the stated radius of a specimen."""

from calibration.effects.candidates import make_specimen_size_candidates, require_tests
from calibration.effects.effect import Candidate, DiagnosisData, Effect


class RadiusError(Effect):
    """Effect of a relative error of the stated radius, separate for each specimen."""

    name = "radius_error"
    category = "geometry"
    title = "error of the radius"
    signature = "forces under plates are wrong by a constant factor, and forces of the needle are correct"
    separated_by = "a caliper; no force separates it from a change of stiffness between sessions"
    known_twins = ("session_scale",)
    #: Trial relative error.
    trial_error = 0.01

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return one candidate per specimen with a stated radius."""
        tests = require_tests(situation.simulated_tests(lambda test: test.specimen is not None),
                              "no test has a specimen with stated dimensions")
        return make_specimen_size_candidates(self, situation, "experiment.specimen.radius", tests, self.trial_error)
