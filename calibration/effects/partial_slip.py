"""Partial slip of bonded faces."""

from calibration.campaign.campaign import Test
from calibration.effects.candidates import make_experiment_or_rig_candidates, require_tests
from calibration.effects.effect import Candidate, DiagnosisData, Effect, get_experiment


class PartialSlip(Effect):
    """Effect of slip on a fraction of the bonded faces, separate for each test."""

    name = "partial_slip"
    category = "contact"
    title = "partial slip of a bonded face"
    signature = "all forces of one test with bonded faces are too low by about the same factor"
    separated_by = "the other bonded test, or ink and sandpaper on the faces"
    #: Trial slip fraction: 0 is a bonded face, 1 a frictionless face.
    trial_fraction = 0.05

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return one candidate (slip fraction) for each test with bonded faces."""
        tests = require_tests(situation.simulated_tests(_has_bonded_faces_that_can_slip),
                              "no test has bonded faces that can slip; tissue that slides round the sharp edge of a "
                              "needle cannot be simulated")
        return make_experiment_or_rig_candidates(self, situation, "experiment.slip", tests,
                                                 lambda _: self.trial_fraction,
                                                 each=True, two_sided=False)


def _has_bonded_faces_that_can_slip(test: Test) -> bool:
    """Return whether a test has bonded faces and the same test with frictionless faces can be simulated."""
    experiment = get_experiment(test)
    return experiment.friction == "bonded" and not experiment.tool.has_sharp_edge
