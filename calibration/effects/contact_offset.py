"""Error of the displacement at which the tool first touches the specimen."""

from calibration.effects.candidates import make_experiment_or_rig_candidates, require_tests
from calibration.effects.effect import Candidate, DiagnosisData, Effect


class ContactOffset(Effect):
    """Effect of a constant shift of the displacement, m, separate for each test."""

    name = "contact_offset"
    category = "rig"
    title = "contact offset"
    signature = "the force curve is shifted by a constant displacement, equally in loading and unloading"
    separated_by = "an approach through air, in which a kink of the force shows the first contact"
    #: Trial offset as a fraction of the largest displacement.
    trial_fraction = 0.005

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return one candidate with a trial shift of the displacement, m, for each simulated test."""
        tests = require_tests(situation.simulated_tests(), "no test was recorded as force and displacement")
        return make_experiment_or_rig_candidates(
            self, situation, "rig.contact_offset", tests,
            lambda group: self.trial_fraction * situation.largest_displacement(group[0]), each=True)
