"""Plates that are not as smooth as they should be."""

from calibration.effects.candidates import beside_material, require_tests
from calibration.effects.effect import Candidate, Effect, Situation, experiment_of

#: Coefficient of friction that is tried first.
_FIRST = 0.02


class PlateFriction(Effect):
    """Coulomb friction of frictionless plates. Both plates hinder the tissue alike, so the one on the tool's side
    stands for the two: its number is about the sum of theirs while they are small."""

    name = "plate_friction"
    room = "contact"
    title = "friction of the plates"
    signature = "lubricated plates press too hard on the way in, too little on the way back, with a jump between"
    separated_by = "unloading, and tests whose faces hold the tissue"

    def candidates(self, situation: Situation) -> list[Candidate]:
        tests = require_tests(situation.simulated(lambda test: experiment_of(test).tool.is_plate
                                                  and experiment_of(test).friction == "frictionless"),
                              "no test is done between frictionless plates")
        return beside_material(self, situation, "experiment.friction", tests, lambda _: _FIRST, both_ways=False)
