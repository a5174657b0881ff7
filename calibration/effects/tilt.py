"""A face that leans."""

from calibration.effects.candidates import beside_material, require_tests
from calibration.effects.effect import Candidate, Effect, Situation

#: Height difference that is tried first, in largest displacements.
_SHARE = 0.03


class Tilt(Effect):
    """A face that touches on one side first, of each test its own."""

    name = "tilt"
    room = "geometry"
    title = "tilt of a face"
    signature = "the force begins with a toe of some tenths of a millimetre and lags by a constant way from there on"
    separated_by = "denser samples in the first millimetre, or turning the specimen"

    def candidates(self, situation: Situation) -> list[Candidate]:
        tests = require_tests(situation.simulated(), "no test has a tool")
        return beside_material(self, situation, "experiment.tilt", tests,
                               lambda group: _SHARE * situation.depth(group[0]), each=True, both_ways=False)
