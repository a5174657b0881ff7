"""Effects of the contact: friction of the plates, partial slip of bonded faces, adhesion."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from calibration.campaign.campaign import Test
from calibration.effects.candidates import make_experiment_or_rig_candidates, require_tests
from calibration.effects.effect import Candidate, DiagnosisData, Effect, get_experiment
from tissue_sim.experiment.adhesion import Adhesion as Pull
from tissue_sim.experiment.contact_law import AS_TOOL
from tissue_sim.model import Model


class PartialSlip(Effect):
    """Effect of slip on a fraction of the bonded faces, separate for each test."""

    name = "partial_slip"
    category = "contact"
    title = "partial slip of a bonded face"
    signature = "all forces of one test with bonded faces are too low by about the same factor"
    separated_by = "the other bonded test, or ink and sandpaper on the faces"
    #: Trial slip fraction: 0 is a bonded face, 1 a frictionless face.
    trial_fraction = 0.05

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return one candidate (slip fraction) for each test with bonded faces."""
        tests = require_tests(situation.simulated_tests(_has_bonded_faces_that_can_slip),
                              "no test has bonded faces that can slip; tissue that slides round the sharp edge of a "
                              "needle cannot be simulated")
        return make_experiment_or_rig_candidates(self, situation, "experiment.slip", tests,
                                                 lambda _: self.trial_fraction,
                                                 each=True, two_sided=False)


def _has_bonded_faces_that_can_slip(test: Test) -> bool:
    """Return whether a test has bonded faces and the same test with frictionless faces can be simulated."""
    experiment = get_experiment(test)
    return experiment.friction == "bonded" and not experiment.tool.has_sharp_edge


#: Path of the pull-off force, N.
_FORCE = "experiment.adhesion.force"
#: Path of the range of the adhesive force, m.
_LENGTH = "experiment.adhesion.length"


class Adhesion(Effect):
    """Effect of an adhesive pull-off force of a tool that lifts off; one candidate per trial range."""

    name = "adhesion"
    category = "contact"
    title = "adhesion"
    signature = "the force is too low in the last millimetre of unloading, and it may become negative before lift-off"
    separated_by = "pulling the tool back past the contact"
    #: Trial pull-off force as a fraction of the largest force. The finite elements do not resolve much smaller pulls at
    #: first contact.
    trial_fraction = 0.02
    #: Trial ranges of the adhesive force as fractions of the largest displacement. With a shorter range the adhesive
    #: force falls about as steeply as the tissue is stiff, which the finite elements do not resolve either.
    trial_ranges = (0.05, 0.1, 0.2, 0.4)
    #: Displacement below which a plate separates, as a fraction of the largest displacement. The negative value lies
    #: above the undeformed surface.
    plate_separation = -0.002
    #: Displacement below which the rim of a tip separates, as a fraction of the largest displacement.
    tip_separation = 0.05

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return a candidate per trial range in the tests whose tool lifts off."""
        free = require_tests(situation.simulated_tests(lambda test: get_experiment(test).friction != "bonded"
                                                       and get_experiment(test).adhesion is None),
                             "no face can lift off, because all faces are bonded")
        tests = require_tests([test for test in free if self._lifts_off(situation, test)],
                              "no tool returns past the first contact, and adhesion shows only there")
        deepest = max(map(situation.largest_displacement, tests))
        trial_force = self.trial_fraction * min(map(situation.largest_force, tests))

        def make_function_adding_adhesion(length: float):
            """Return a function that adds to a test an adhesion without force and with this range, m."""
            return lambda test: replace(test, experiment=replace(test.experiment, adhesion=Pull(0.0, length)))

        found = []
        for length in (fraction * deepest for fraction in self.trial_ranges):
            prepare = make_function_adding_adhesion(length)
            found += make_experiment_or_rig_candidates(self, situation, _FORCE, [prepare(test) for test in tests],
                                                       lambda _: trial_force, two_sided=False, prepare=prepare,
                                                       shape={_LENGTH: length})
        return found

    def apply(self, model: Model, values: Mapping[str, float]) -> Model:
        """Return the model with the adhesion; an experiment without adhesion gets one."""
        if model.experiment.adhesion is None:
            pull = Pull(values[_FORCE], values[_LENGTH])
            return replace(model, experiment=replace(model.experiment, adhesion=pull))
        return super().apply(model, values)

    def _lifts_off(self, situation: DiagnosisData, test: Test) -> bool:
        """Return whether the tool separates from the tissue during unloading in any recording of a test.

        A plate separates as a whole, above the undeformed surface. A tip separates from its rim inwards, below the
        surface.
        """
        limit = self.plate_separation if get_experiment(test).tool.is_plate else self.tip_separation
        for curve in situation.measured[test.name]:
            deepest = int(np.argmax(curve.displacement))
            if curve.displacement[deepest:].min() < limit * curve.displacement[deepest]:
                return True
        return False


class PlateFriction(Effect):
    """Effect of Coulomb friction with the same coefficient at both plates."""

    name = "plate_friction"
    category = "contact"
    title = "friction of the plates"
    signature = "the force between lubricated plates is too high in loading and too low in unloading, with a jump at " \
                "the reversal"
    separated_by = "unloading, and tests with bonded faces"
    #: Trial coefficient of friction.
    trial_coefficient = 0.02

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return the candidates in the tests between frictionless plates."""
        tests = require_tests(situation.simulated_tests(lambda test: get_experiment(test).tool.is_plate
                                                        and get_experiment(test).friction == "frictionless"),
                              "no test is done between frictionless plates")
        return make_experiment_or_rig_candidates(self, situation, "experiment.friction", tests,
                                                 lambda _: self.trial_coefficient,
                                                 two_sided=False, prepare=_make_test_with_base_friction_of_tool)


def _make_test_with_base_friction_of_tool(test: Test) -> Test:
    """Return a test whose base has the friction of the tool."""
    if test.experiment is None:
        return test
    return replace(test, experiment=replace(test.experiment, friction_base=AS_TOOL))
