"""Elastic compliance of the load train."""

from calibration.effects.candidates import make_experiment_or_rig_candidates, require_tests
from calibration.effects.effect import Candidate, DiagnosisData, Effect


class MachineCompliance(Effect):
    """Effect of the deflection of the load train per unit force, m/N."""

    name = "machine_compliance"
    category = "rig"
    title = "machine compliance"
    signature = "the displacement is too large in proportion to the force, so stiff tests appear too soft"
    separated_by = "pressing on steel, or a deeper ramp"
    #: Trial deflection of the load train at the largest force, as a fraction of the largest displacement.
    trial_fraction = 0.01

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return the candidates whose trial compliance follows from the stiffest test."""
        tests = require_tests(situation.simulated_tests(), "no test was recorded as force and displacement")
        stiffest = max(tests, key=lambda test: situation.largest_force(test) / situation.largest_displacement(test))
        size = self.trial_fraction * situation.largest_displacement(stiffest) / situation.largest_force(stiffest)
        return make_experiment_or_rig_candidates(self, situation, "rig.compliance", tests, lambda _: size,
                                                 two_sided=False)
