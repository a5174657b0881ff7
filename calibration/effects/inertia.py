"""Mass of the tool."""

from collections.abc import Mapping
from dataclasses import replace

from calibration.campaign.campaign import Test
from calibration.effects.candidates import beside_material, require_tests
from calibration.effects.effect import Candidate, Effect, NotTestableError, Situation
from tissue_sim.model import Model
from tissue_sim.rig.inertia import Inertia as Mass

#: Mass of a tool that could be there, kg, which is tried first.
_MASS = 0.1
#: It shows where it moves the force by this share of the noise.
_SEEN = 0.1
_PATH = "rig.faults.inertia.mass"


class Inertia(Effect):
    """The mass between sensor and tissue."""

    name = "inertia"
    room = "rig"
    title = "inertia of the tool"
    signature = "the force is off where the tool is accelerated, and right at even speed"
    separated_by = "motion as fast as a hand's, in air"

    def candidates(self, situation: Situation) -> list[Candidate]:
        tests = require_tests(situation.simulated(lambda test: "inertia" not in test.rig.faults),
                              "the rig has a tool with a mass already")
        fastest = situation.fastest(tests)
        # To be up to speed within a hundredth of the way.
        acceleration = fastest**2 / (0.02 * min(map(situation.depth, tests)))
        quietest = min(curve.noise.deviation for curve in situation.curves(tests))
        if _MASS * acceleration < _SEEN * quietest:
            raise NotTestableError(f"the tests are quasi-static: at {fastest * 1e3:.3g} mm/s a tool of {_MASS:g} kg "
                                   f"moves the force by {_MASS * acceleration:.1g} N, in a noise of {quietest:.1g} N")
        return beside_material(self, situation, _PATH, [_with_mass(test) for test in tests], lambda _: _MASS,
                               both_ways=False, prepare=_with_mass)

    def apply(self, model: Model, values: Mapping[str, float]) -> Model:
        if "inertia" not in model.rig.faults:
            model = replace(model, rig=_massive(model.rig))
        return super().apply(model, values)


def _with_mass(test: Test) -> Test:
    return replace(test, rig=_massive(test.rig))


def _massive(rig):
    """The rig with a tool of no mass yet."""
    return replace(rig, faults=[*rig.faults.values(), Mass(0.0)])
