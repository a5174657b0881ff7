"""Self-weight of the specimen."""

from collections.abc import Mapping
from dataclasses import replace

from calibration.campaign.campaign import Test
from calibration.effects.candidates import require_tests
from calibration.effects.effect import Candidate, DiagnosisData, Effect, get_experiment
from tissue_sim.model import Model
from tissue_sim.specimen import STANDARD_GRAVITY

#: Density of a specimen without a stated density, kg/m3: the density of water.
DEFAULT_DENSITY = 1000.0
#: Path of the acceleration of gravity, m/s2.
_GRAVITY = "experiment.specimen.gravity"


class SelfWeight(Effect):
    """Gravity that acts on the specimen, m/s2.

    Only density times gravity is observable. A specimen without a stated density gets that of water, so an error of
    the density appears as an error of the gravity that a refit finds.
    """

    name = "self_weight"
    category = "geometry"
    title = "self-weight"
    signature = "forces of plates and punch are higher than the stiffness explains, most for soft and high specimens"
    separated_by = "weighing the specimen and measuring its height before and after placing, or a horizontal test axis"

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return the candidate with standard gravity in the tests without gravity."""
        situation.require_unused_parameter(_GRAVITY)
        tests = require_tests(situation.simulated_tests(lambda test: not get_experiment(test).specimen.gravity),
                              "the specimens have self-weight already")
        return [Candidate(self, {_GRAVITY: STANDARD_GRAVITY}, bounds={_GRAVITY: (0.0, 1.5 * STANDARD_GRAVITY)},
                          tests=tuple(test.name for test in tests), prepare=_make_test_with_stated_or_water_density)]

    def apply(self, model: Model, values: Mapping[str, float]) -> Model:
        """Return the model with gravity; a specimen without a density gets that of the material or of water."""
        specimen = model.experiment.specimen
        if specimen.density is None:
            specimen = replace(specimen, density=model.material.density or DEFAULT_DENSITY)
        return super().apply(replace(model, experiment=replace(model.experiment, specimen=specimen)), values)


def _make_test_with_stated_or_water_density(test: Test) -> Test:
    """Return a test whose specimen has a density, `DEFAULT_DENSITY` unless stated."""
    if test.experiment is None or get_experiment(test).specimen.density is not None:
        return test
    specimen = replace(get_experiment(test).specimen, density=DEFAULT_DENSITY)
    return replace(test, experiment=replace(test.experiment, specimen=specimen))
