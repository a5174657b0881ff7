"""Faces that do not hold the tissue as they should."""

from calibration.campaign.campaign import Test
from calibration.effects.candidates import beside_material, require_tests
from calibration.effects.effect import Candidate, Effect, Situation, experiment_of
from tissue_sim.errors import InputError

#: Share of the face that is tried first.
_SHARE = 0.05


class PartialSlip(Effect):
    """A share of bonded faces that slips, of each test its own."""

    name = "partial_slip"
    room = "contact"
    title = "partial slip of a bonded face"
    signature = "every force of one test with bonded faces is too low by about the same share"
    separated_by = "the other bonded test, or ink and sandpaper on the faces"

    def candidates(self, situation: Situation) -> list[Candidate]:
        tests = require_tests(situation.simulated(_slips), "no test is done with bonded faces that could slip; tissue "
                              "that slides round the sharp edge of a needle cannot be simulated")
        return beside_material(self, situation, "experiment.slip", tests, lambda _: _SHARE, each=True, both_ways=False)


def _slips(test: Test) -> bool:
    """Whether a face is bonded, and the same without friction can be simulated."""
    if experiment_of(test).friction != "bonded":
        return False
    try:
        experiment_of(test).with_free_faces()
    except InputError:
        return False
    return True
