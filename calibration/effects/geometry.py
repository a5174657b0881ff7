"""Effects of the geometry: sizes of specimen and tool, tilt, self-weight."""

from collections.abc import Mapping
from dataclasses import replace

from calibration.campaign.campaign import Test
from calibration.effects.candidates import (
    make_experiment_or_rig_candidates,
    make_specimen_size_candidates,
    require_tests,
)
from calibration.effects.effect import Candidate, DiagnosisData, Effect, get_experiment
from tissue_sim.model import Model
from tissue_sim.parameters import list_field_declarations
from tissue_sim.specimen import STANDARD_GRAVITY


class EdgeRounding(Effect):
    """Effect of a radius, m, of the edge between face and shaft of a needle, larger than stated."""

    name = "edge_rounding"
    category = "geometry"
    title = "rounding of the tip's edge"
    signature = "the needle is too soft at first contact and agrees at larger depth; plates agree at all depths"
    separated_by = "a microscope, or a second tip"
    #: Trial increase of the edge radius as a fraction of the radius of the needle.
    trial_fraction = 0.1

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return the candidates in the tests whose needle has an edge radius."""
        needles = require_tests(situation.simulated_tests(
            lambda test: "edge_radius" in list_field_declarations(type(get_experiment(test).tool))),
                                "no test has a tool with an edge")
        return make_experiment_or_rig_candidates(
            self, situation, "experiment.tool.edge_radius", needles,
            lambda tests: self.trial_fraction * get_experiment(tests[0]).tool.require_radius(), two_sided=False)


class RadiusError(Effect):
    """Effect of a relative error of the stated radius, separate for each specimen."""

    name = "radius_error"
    category = "geometry"
    title = "error of the radius"
    signature = "forces under plates are wrong by a constant factor, and forces of the needle are correct"
    separated_by = "a caliper; no force separates it from a change of stiffness between sessions"
    known_twins = ("session_scale",)
    #: Trial relative error.
    trial_error = 0.01

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return one candidate per specimen with a stated radius."""
        tests = require_tests(situation.simulated_tests(lambda test: test.specimen is not None),
                              "no test has a specimen with stated dimensions")
        return make_specimen_size_candidates(self, situation, "experiment.specimen.radius", tests, self.trial_error)


class HeightError(Effect):
    """Effect of a relative error of the stated height, separate for each specimen."""

    name = "height_error"
    category = "geometry"
    title = "error of the height"
    signature = "the strain under plates is wrong by a constant factor, which changes the slope and the curvature of " \
                "their curves; the needle agrees"
    separated_by = "a caliper, or a deeper ramp"
    #: Trial relative error.
    trial_error = 0.01

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return one candidate per specimen with a stated height."""
        tests = require_tests(situation.simulated_tests(lambda test: test.specimen is not None),
                              "no test has a specimen with stated dimensions")
        return make_specimen_size_candidates(self, situation, "experiment.specimen.height", tests, self.trial_error)


class Tilt(Effect):
    """Effect of a height difference across a face, m, separate for each test; one side of the face touches first."""

    name = "tilt"
    category = "geometry"
    title = "tilt of a face"
    signature = "the force begins with a toe region of some tenths of a millimetre, and the rest of the curve is " \
                "shifted by a constant displacement"
    separated_by = "denser samples in the first millimetre, or turning the specimen"
    #: Trial height difference across the face, as a fraction of the largest displacement.
    trial_fraction = 0.03

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return one candidate with a trial tilt (height difference, m) for each simulated test."""
        tests = require_tests(situation.simulated_tests(), "no test has a tool")
        return make_experiment_or_rig_candidates(
            self, situation, "experiment.tilt", tests,
            lambda group: self.trial_fraction * situation.largest_displacement(group[0]), each=True, two_sided=False)


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
