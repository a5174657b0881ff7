"""Plates that are not as smooth as they should be."""

from dataclasses import replace

from calibration.campaign.campaign import Test
from calibration.effects.candidates import beside_material, require_tests
from calibration.effects.effect import Candidate, Effect, Situation, experiment_of
from tissue_sim.experiment.interfaces import AS_TOOL

#: Coefficient of friction that is tried first.
_FIRST = 0.02


class PlateFriction(Effect):
    """Coulomb friction of frictionless plates, alike on both."""

    name = "plate_friction"
    room = "contact"
    title = "friction of the plates"
    signature = "lubricated plates press too hard on the way in, too little on the way back, with a jump between"
    separated_by = "unloading, and tests whose faces hold the tissue"

    def candidates(self, situation: Situation) -> list[Candidate]:
        tests = require_tests(situation.simulated(lambda test: experiment_of(test).tool.is_plate
                                                  and experiment_of(test).friction == "frictionless"),
                              "no test is done between frictionless plates")
        return beside_material(self, situation, "experiment.friction", tests, lambda _: _FIRST, both_ways=False,
                               prepare=_alike)


def _alike(test: Test) -> Test:
    """With a base that holds the tissue as the tool does."""
    if test.experiment is None:
        return test
    return replace(test, experiment=replace(test.experiment, friction_base=AS_TOOL))
