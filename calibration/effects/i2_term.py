"""A tissue whose energy depends on the second invariant."""

from calibration.effects.effect import Candidate, Effect, NotTestableError, Situation
from calibration.effects.wider_law import WIDER, require_contained

#: Share of the shear modulus that is tried first, and the largest that a refit may find.
_SHARE, _LARGEST = 0.05, 2.0


class I2Term(Effect):
    """A term in I2 - 3."""

    name = "i2_term"
    room = "tissue"
    title = "second invariant (tension/compression asymmetry)"
    signature = "plates and needle disagree in how the stiffness changes with depth, alike at every speed"
    separated_by = "tension, or a compression to 20 mm"
    law = WIDER

    def candidates(self, situation: Situation) -> list[Candidate]:
        if "C01" in require_contained(situation.law):
            raise NotTestableError("the law that is fitted has such a term already")
        # mu = 2 (C10 + C01).
        size = 0.5 * _SHARE * situation.modulus
        return [Candidate(self, {"C01": size}, absent={"C01": 0.0},
                          bounds={"C01": (0.0, _LARGEST * situation.modulus)}, law=WIDER)]
