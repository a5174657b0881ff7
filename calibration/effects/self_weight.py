"""A specimen that sags under its own weight."""

from collections.abc import Mapping
from dataclasses import replace

from calibration.campaign.campaign import Test
from calibration.effects.candidates import require_tests
from calibration.effects.effect import Candidate, Effect, Situation, experiment_of
from tissue_sim.model import Model
from tissue_sim.specimen import STANDARD_GRAVITY

#: Of a specimen whose density nobody stated, kg/m3: that of water.
DENSITY = 1000.0
_GRAVITY = "experiment.specimen.gravity"


class SelfWeight(Effect):
    """Gravity; a density that nobody stated is that of water, and its error is in the number that is found."""

    name = "self_weight"
    room = "geometry"
    title = "self-weight"
    signature = "plates and punch press harder than the tissue is stiff, most where the specimen is soft and high"
    separated_by = "the weight, and the height before and after placing; or turning the axis"

    def candidates(self, situation: Situation) -> list[Candidate]:
        situation.require_new(_GRAVITY)
        tests = require_tests(situation.simulated(lambda test: not experiment_of(test).specimen.gravity),
                              "the specimens weigh already")
        return [Candidate(self, {_GRAVITY: STANDARD_GRAVITY}, bounds={_GRAVITY: (0.0, 1.5 * STANDARD_GRAVITY)},
                          tests=tuple(test.name for test in tests), prepare=_with_density)]

    def apply(self, model: Model, values: Mapping[str, float]) -> Model:
        specimen = model.experiment.specimen
        if specimen.density is None:
            specimen = replace(specimen, density=model.material.density or DENSITY)
        return super().apply(replace(model, experiment=replace(model.experiment, specimen=specimen)), values)


def _with_density(test: Test) -> Test:
    if test.experiment is None or experiment_of(test).specimen.density is not None:
        return test
    specimen = replace(experiment_of(test).specimen, density=DENSITY)
    return replace(test, experiment=replace(test.experiment, specimen=specimen))
