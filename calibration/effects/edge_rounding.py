"""Edge radius of a needle above the stated one."""

from calibration.effects.candidates import make_experiment_or_rig_candidates, require_tests
from calibration.effects.effect import Candidate, DiagnosisData, Effect, get_experiment
from tissue_sim.parameters import list_field_declarations


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
