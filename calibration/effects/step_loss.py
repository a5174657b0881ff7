"""Lost steps of a stepper motor."""

from calibration.effects.candidates import make_experiment_or_rig_candidates, require_tests
from calibration.effects.effect import Candidate, DiagnosisData, Effect


class StepLoss(Effect):
    """Effect of a displacement that is lost permanently at one depth; one candidate per test and trial depth."""

    name = "step_loss"
    category = "rig"
    title = "step loss"
    signature = "the force of one test drops suddenly at one depth, as if the tool had moved back, and stays low"
    separated_by = "counting the steps on the return to zero"
    #: Trial loss as a fraction of the largest displacement.
    trial_fraction = 0.01
    #: Trial depths of the loss as fractions of the largest displacement.
    trial_depths = tuple(0.05 * step for step in range(2, 20))

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return one candidate per test and trial depth."""
        tests = require_tests(situation.simulated_tests(), "no test was recorded as force and displacement")
        loss, depth, found = "rig.step_loss", "rig.step_loss_depth", []

        def compute_trial_loss(group):
            """Return the trial loss of the first test of a group, m."""
            return self.trial_fraction * situation.largest_displacement(group[0])

        for fraction in self.trial_depths:
            for test in tests:
                found += make_experiment_or_rig_candidates(
                    self, situation, loss, [test], compute_trial_loss, each=True, two_sided=False,
                    shape={depth: fraction * situation.largest_displacement(test)}, jump=depth)
        return found
