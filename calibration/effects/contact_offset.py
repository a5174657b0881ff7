"""A touch that is elsewhere than it was taken for."""

from calibration.effects.candidates import beside_material, require_tests
from calibration.effects.effect import Candidate, Effect, Situation

#: Shift that is tried first, in largest displacements.
_SHARE = 0.005


class ContactOffset(Effect):
    """A shift of the displacement, of each test its own."""

    name = "contact_offset"
    room = "rig"
    title = "contact offset"
    signature = "the force is off by its slope times a constant way, to the same side on the way in and back"
    separated_by = "an approach in air, whose kink shows the touch"

    def candidates(self, situation: Situation) -> list[Candidate]:
        tests = require_tests(situation.simulated(), "no test was recorded as force and displacement")
        return beside_material(self, situation, "rig.contact_offset", tests,
                               lambda group: _SHARE * situation.depth(group[0]), each=True)
