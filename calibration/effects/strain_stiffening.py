"""A tissue that stiffens more than the law can."""

from calibration.effects.effect import Candidate, Effect, Situation
from calibration.effects.wider_law import WIDER, absent_order

#: Share by which the new term changes the stress at the largest strain, which is tried first, and the largest that a
#: refit may find, in units of it: it grows so fast that most of the tissue knows little of it.
_SHARE, _LARGEST = 0.2, 500.0


class StrainStiffening(Effect):
    """The next power of I1 - 3."""

    name = "strain_stiffening"
    room = "tissue"
    title = "strain stiffening"
    signature = "the force rises more steeply at the end of the ramp than the law can, at every speed, in all tests"
    separated_by = "any second test, or a deeper ramp"
    law = WIDER

    def candidates(self, situation: Situation) -> list[Candidate]:
        path, order = absent_order(situation.law)
        largest = max((situation.strain(test) for test in situation.simulated()), default=0.1)
        # Of C10 (I1 - 3) + Cn0 (I1 - 3)^n, whose I1 is about 3 + 3 strain^2.
        size = _SHARE * 0.5 * situation.modulus / (order * (3.0 * largest**2) ** (order - 1))
        return [Candidate(self, {path: size}, absent={path: 0.0}, bounds={path: (0.0, _LARGEST * size)}, law=WIDER)]
