"""A load train that gives way."""

from calibration.effects.candidates import beside_material, require_tests
from calibration.effects.effect import Candidate, Effect, Situation

#: Share of the largest displacement that the load train takes up, which is tried first.
_SHARE = 0.01


class MachineCompliance(Effect):
    """Displacement that the load train takes up, in proportion to the force."""

    name = "machine_compliance"
    room = "rig"
    title = "machine compliance"
    signature = "the displacement is too large in proportion to the force, so stiff tests look softer than soft ones"
    separated_by = "pressing on steel, or a deeper ramp"

    def candidates(self, situation: Situation) -> list[Candidate]:
        tests = require_tests(situation.simulated(), "no test was recorded as force and displacement")
        stiffest = max(tests, key=lambda test: situation.force(test) / situation.depth(test))
        size = _SHARE * situation.depth(stiffest) / situation.force(stiffest)
        return beside_material(self, situation, "rig.compliance", tests, lambda _: size, both_ways=False)
