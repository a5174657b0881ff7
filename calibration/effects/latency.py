"""Force that is read later than displacement."""

from calibration.effects.candidates import beside_material, require_tests
from calibration.effects.effect import Candidate, Effect, Situation

#: Delay that is tried first, in times of the fastest loading.
_SHARE = 0.01


class Latency(Effect):
    """A delay of the force."""

    name = "latency"
    room = "rig"
    title = "latency of the force"
    signature = "the force is that of a moment before: low on the way in, high on the way back, the faster the more"
    separated_by = "a second speed"

    def candidates(self, situation: Situation) -> list[Candidate]:
        tests = require_tests(situation.simulated(), "no test was recorded as force and displacement")
        fastest = situation.fastest(tests)
        size = _SHARE * min(map(situation.depth, tests)) / fastest
        return beside_material(self, situation, "rig.latency", tests, lambda _: size, both_ways=False)
