"""Zero offset of the force sensor."""

from calibration.effects.candidates import make_experiment_or_rig_candidates, require_tests
from calibration.effects.effect import Candidate, DiagnosisData, Effect


class ZeroOffset(Effect):
    """Effect of a constant error of the force, N; one candidate for all tests together and one for each test."""

    name = "zero_offset"
    category = "rig"
    title = "zero offset"
    signature = "the force is wrong by a constant, also in air"
    separated_by = "unloading, or an approach through air"
    #: Trial offset as a fraction of the smallest of the tests' largest forces.
    trial_fraction = 0.01

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return the candidates of all tests together and, for two or more tests, of each test."""
        tests = require_tests(situation.simulated_tests(), "no test was recorded as force and displacement")
        path = "rig.zero_offset"

        def compute_trial_offset(group):
            """Return the trial offset of a group of tests, N."""
            return self.trial_fraction * min(map(situation.largest_force, group))

        shared = make_experiment_or_rig_candidates(self, situation, path, tests, compute_trial_offset)
        if len(tests) < 2:
            return shared
        return [*shared,
                *make_experiment_or_rig_candidates(self, situation, path, tests, compute_trial_offset, each=True)]
