"""A lead screw of another pitch than it is taken for."""

from calibration.effects.candidates import beside_material, require_tests
from calibration.effects.effect import Candidate, Effect, Situation

#: Relative error that is tried first.
_ERROR = 0.01


class DisplacementGain(Effect):
    """A relative error of every displacement."""

    name = "displacement_gain"
    room = "rig"
    title = "error of the displacement's scale"
    signature = "the axis of displacement is stretched alike in every test, whatever its stiffness"
    separated_by = "a dial gauge, or a deeper ramp"

    def candidates(self, situation: Situation) -> list[Candidate]:
        tests = require_tests(situation.simulated(), "no test was recorded as force and displacement")
        return beside_material(self, situation, "rig.displacement_gain", tests, lambda _: _ERROR)
