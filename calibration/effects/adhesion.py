"""Tissue that sticks to a tool that leaves it."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from calibration.campaign.campaign import Test
from calibration.effects.candidates import beside_material, require_tests
from calibration.effects.effect import Candidate, Effect, Situation, experiment_of
from tissue_sim.experiment.adhesion import Adhesion as Pull
from tissue_sim.model import Model

#: Share of the largest force that is tried first; lengths that are tried, in largest displacements. The finite elements
#: lose much smaller pulls at the touch, and those that fall about as steeply as the tissue is stiff (shares alike).
_SHARE, _LENGTHS = 0.02, (0.05, 0.1, 0.2, 0.4)
#: A plate leaves beyond where it touched, a tip before, by these shares of the largest displacement.
_BEYOND, _BEFORE = -0.002, 0.05
_FORCE, _LENGTH = "experiment.adhesion.force", "experiment.adhesion.length"


class Adhesion(Effect):
    """A pull of the tool that lifts off, over each of some lengths."""

    name = "adhesion"
    room = "contact"
    title = "adhesion"
    signature = "the last millimetre of the return is too low, and the force may turn negative before it is gone"
    separated_by = "pulling the tool back past the contact"

    def candidates(self, situation: Situation) -> list[Candidate]:
        free = require_tests(situation.simulated(lambda test: experiment_of(test).friction != "bonded"
                                                 and experiment_of(test).adhesion is None),
                             "no face can lift off: they are bonded")
        tests = require_tests([test for test in free if _leaves(situation, test)],
                              "no tool comes back past where it touched, and a pull shows nowhere else")
        deepest = max(map(situation.depth, tests))
        size = _SHARE * min(map(situation.force, tests))

        def prepared(length: float):
            return lambda test: replace(test, experiment=replace(test.experiment, adhesion=Pull(0.0, length)))

        found = []
        for length in (share * deepest for share in _LENGTHS):
            ready = prepared(length)
            found += beside_material(self, situation, _FORCE, [ready(test) for test in tests], lambda _: size,
                                     both_ways=False, prepare=ready, shape={_LENGTH: length})
        return found

    def apply(self, model: Model, values: Mapping[str, float]) -> Model:
        if model.experiment.adhesion is None:
            pull = Pull(values[_FORCE], values[_LENGTH])
            return replace(model, experiment=replace(model.experiment, adhesion=pull))
        return super().apply(model, values)


def _leaves(situation: Situation, test: Test) -> bool:
    """Whether the tool comes back to where it lifts off: a plate past the touch, a tip from its rim on."""
    near = _BEYOND if experiment_of(test).tool.is_plate else _BEFORE
    for curve in situation.measured[test.name]:
        deepest = int(np.argmax(curve.displacement))
        if curve.displacement[deepest:].min() < near * curve.displacement[deepest]:
            return True
    return False
