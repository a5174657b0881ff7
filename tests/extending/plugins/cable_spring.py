"""An effect that a diagnosis looks for, with the fault of the rig that makes it: a cable that pulls at the sensor."""

from dataclasses import dataclass, replace

import tissue_sim as ts
from calibration.effects.candidates import make_experiment_or_rig_candidates, require_tests
from calibration.effects.effect import Effect


@dataclass(frozen=True)
class CableSpring(ts.RigFault):
    """The cable of the sensor is a spring in parallel with the tissue: the reading is F + stiffness d."""

    name = "cable_spring"
    title = "a cable that pulls"
    stiffness: float = ts.parameter("k_c", "N/m", key="stiffness_N_per_mm", factor=1e3, bounds=(0.0, 1e4), absent=0.0)

    def reading(self, recording):
        return recording.with_channels(force=recording.force + self.stiffness * recording.displacement)


class CablePull(Effect):
    """The spring, with the same stiffness in all tests."""

    name = "cable_pull"
    category = "rig"
    title = "pull of the sensor's cable"
    signature = "the force is too high in proportion to the displacement, alike in stiff tests and in soft ones"
    separated_by = "a run in air"

    def candidates(self, situation):
        tests = [with_cable(test) for test in require_tests(situation.simulated_tests(), "no test has a tool")]

        def size(group):
            return 0.01 * min(situation.largest_force(test) / situation.largest_displacement(test) for test in group)

        return make_experiment_or_rig_candidates(self, situation, "rig.faults.cable_spring.stiffness", tests, size,
                                                 two_sided=False, prepare=with_cable)

    def apply(self, model, values):
        return super().apply(with_cable(model), values)


def with_cable(thing):
    """Return a test or model whose rig has a cable of stiffness 0."""
    if "cable_spring" in thing.rig.faults:
        return thing
    return replace(thing, rig=replace(thing.rig, faults=[*thing.rig.faults.values(), CableSpring(0.0)]))
