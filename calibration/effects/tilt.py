"""Tilt of the tool's face relative to the specimen."""

from calibration.effects.candidates import make_experiment_or_rig_candidates, require_tests
from calibration.effects.effect import Candidate, DiagnosisData, Effect


class Tilt(Effect):
    """Effect of a height difference across a face, m, separate for each test; one side of the face touches first."""

    name = "tilt"
    category = "geometry"
    title = "tilt of a face"
    signature = "the force begins with a toe region of some tenths of a millimetre, and the rest of the curve is " \
                "shifted by a constant displacement"
    separated_by = "denser samples in the first millimetre, or turning the specimen"
    #: Trial height difference across the face, as a fraction of the largest displacement.
    trial_fraction = 0.03

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return one candidate with a trial tilt (height difference, m) for each simulated test."""
        tests = require_tests(situation.simulated_tests(), "no test has a tool")
        return make_experiment_or_rig_candidates(
            self, situation, "experiment.tilt", tests,
            lambda group: self.trial_fraction * situation.largest_displacement(group[0]), each=True, two_sided=False)
