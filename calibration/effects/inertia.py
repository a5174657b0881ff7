"""Inertia of the tool between force sensor and tissue."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from calibration.campaign.campaign import Test
from calibration.effects.candidates import make_experiment_or_rig_candidates, require_tests
from calibration.effects.effect import Candidate, DiagnosisData, Effect, NotTestableError
from tissue_sim.model import Model
from tissue_sim.rig.inertia import Inertia as Mass

#: Path of the mass, kg.
_PATH = "rig.faults.inertia.mass"


class Inertia(Effect):
    """Effect of a mass, kg, between force sensor and tissue, whose inertial force adds to the reading."""

    name = "inertia"
    category = "rig"
    title = "inertia of the tool"
    signature = "the force is wrong while the tool accelerates, and correct at constant speed"
    separated_by = "motion in air at the speed of a hand"
    #: Trial mass of the tool, kg: a typical mass of a small tool.
    trial_mass = 0.1
    #: Smallest inertial force that is worth a test, as a fraction of the noise.
    detectable_fraction = 0.1

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return the candidates with the trial mass if its inertial force would be detectable."""
        tests = require_tests(situation.simulated_tests(lambda test: "inertia" not in test.rig.faults),
                              "the rig states the mass of its tool already")
        fastest = situation.find_largest_loading_speed(tests)
        # Acceleration from rest to the largest speed v within 1 % of the displacement d: a = v^2 / (2 * 0.01 d).
        acceleration = fastest**2 / (0.02 * min(map(situation.largest_displacement, tests)))
        quietest = min(curve.noise.deviation for curve in situation.list_recordings(tests))
        if self.trial_mass * acceleration < self.detectable_fraction * quietest:
            raise NotTestableError(
                f"the tests are quasi-static: at {fastest * 1e3:.3g} mm/s a tool of {self.trial_mass:g} kg changes the "
                f"force by {self.trial_mass * acceleration:.1g} N, and the noise is {quietest:.1g} N")
        return make_experiment_or_rig_candidates(self, situation, _PATH,
                                                 [_add_massless_inertia_fault_to_test(test) for test in tests],
                                                 lambda _: self.trial_mass, two_sided=False,
                                                 prepare=_add_massless_inertia_fault_to_test)

    def apply(self, model: Model, values: Mapping[str, float]) -> Model:
        """Return the model with the mass; a rig without this fault gets it."""
        if "inertia" not in model.rig.faults:
            model = replace(model, rig=_add_massless_inertia_fault_to_rig(model.rig))
        return super().apply(model, values)


def _add_massless_inertia_fault_to_test(test: Test) -> Test:
    """Return the test with a fault `tissue_sim.rig.inertia.Inertia` of mass 0 in its rig."""
    return replace(test, rig=_add_massless_inertia_fault_to_rig(test.rig))


def _add_massless_inertia_fault_to_rig(rig: Any) -> Any:
    """Return the rig with the additional fault `tissue_sim.rig.inertia.Inertia` of mass 0."""
    return replace(rig, faults=[*rig.faults.values(), Mass(0.0)])
