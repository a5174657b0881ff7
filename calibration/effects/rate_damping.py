"""A drag that grows with the speed."""

from calibration.effects.candidates import beside_material, require_tests
from calibration.effects.effect import Candidate, Effect, Situation

#: Share of the smallest test's largest force at the fastest loading, which is tried first.
_SHARE = 0.005


class RateDamping(Effect):
    """A force in proportion to the speed."""

    name = "rate_damping"
    room = "rig"
    title = "damping of the rig"
    signature = "the force is off in proportion to the speed, and right in holds"
    separated_by = "a second speed"

    def candidates(self, situation: Situation) -> list[Candidate]:
        tests = require_tests(situation.simulated(), "no test was recorded as force and displacement")
        fastest = situation.fastest(tests)
        return beside_material(self, situation, "rig.rate_damping", tests,
                               lambda group: _SHARE * min(map(situation.force, group)) / fastest, both_ways=False)
