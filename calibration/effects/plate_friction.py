"""Friction of plates that are assumed to be frictionless."""

from dataclasses import replace

from calibration.campaign.campaign import Test
from calibration.effects.candidates import make_experiment_or_rig_candidates, require_tests
from calibration.effects.effect import Candidate, DiagnosisData, Effect, get_experiment
from tissue_sim.experiment.contact_law import AS_TOOL


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
