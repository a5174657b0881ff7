"""A needle whose edge is rounder than stated."""

from calibration.effects.candidates import beside_material, require_tests
from calibration.effects.effect import Candidate, Effect, Situation, experiment_of
from tissue_sim.parameters import declared

#: Rounding that is tried first, in radii of the needle.
_SHARE = 0.1


class EdgeRounding(Effect):
    """A rounding between face and shaft, beyond what is stated."""

    name = "edge_rounding"
    room = "geometry"
    title = "rounding of the tip's edge"
    signature = "the needle starts too softly and catches up with depth; plates agree"
    separated_by = "a microscope, or a second tip"

    def candidates(self, situation: Situation) -> list[Candidate]:
        needles = require_tests(situation.simulated(
            lambda test: "edge_radius" in declared(type(experiment_of(test).tool))), "no test has a tool with an edge")
        return beside_material(self, situation, "experiment.tool.edge_radius", needles,
                               lambda tests: _SHARE * experiment_of(tests[0]).tool.require_radius(), both_ways=False)
