"""Zero offset of the force sensor."""

from calibration.effects.candidates import require_tests, rig_parameter_candidates
from calibration.effects.effect import Candidate, Effect, Situation

#: Trial offset as a fraction of the smallest of the tests' largest forces.
_TRIAL_FRACTION = 0.01


class ZeroOffset(Effect):
    """Constant error of the force, N; one candidate for all tests together and one for each test."""

    name = "zero_offset"
    category = "rig"
    title = "zero offset"
    signature = "the force is wrong by a constant, also in air"
    separated_by = "unloading, or an approach through air"

    def candidates(self, situation: Situation) -> list[Candidate]:
        tests = require_tests(situation.simulated_tests(), "no test was recorded as force and displacement")
        path = "rig.zero_offset"

        def trial_offset(group):
            return _TRIAL_FRACTION * min(map(situation.force, group))

        shared = rig_parameter_candidates(self, situation, path, tests, trial_offset)
        if len(tests) < 2:
            return shared
        return [*shared, *rig_parameter_candidates(self, situation, path, tests, trial_offset, each=True)]
