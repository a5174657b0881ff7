"""A sensor that was not set to zero."""

from calibration.effects.candidates import beside_material, require_tests
from calibration.effects.effect import Candidate, Effect, Situation

#: Share of the smallest test's largest force that is tried first.
_SHARE = 0.01


class ZeroOffset(Effect):
    """A constant reading: one of all tests, and one of each test alone."""

    name = "zero_offset"
    room = "rig"
    title = "zero offset"
    signature = "the force is off by a constant, also in the air"
    separated_by = "unloading, or an approach in air"

    def candidates(self, situation: Situation) -> list[Candidate]:
        tests = require_tests(situation.simulated(), "no test was recorded as force and displacement")
        path = "rig.zero_offset"

        def size(group):
            return _SHARE * min(map(situation.force, group))

        alone = beside_material(self, situation, path, tests, size, each=True) if len(tests) > 1 else []
        return [*beside_material(self, situation, path, tests, size), *alone]
