"""A tissue that gives way in volume."""

from calibration.effects.effect import Candidate, Effect, NotTestableError, Situation
from tissue_sim.material.material import BULK_RATIOS, Bulk

#: K / mu that is tried first: bonded compression of the study's cylinder loses one part in a hundred.
_RATIO = 100.0


class Compressibility(Effect):
    """A bulk modulus below the one that the campaign assumes, in the unit in which it states it."""

    name = "compressibility"
    room = "tissue"
    title = "compressibility"
    signature = "tests in which the tissue cannot escape sideways are softer than the others say, from the start on"
    separated_by = "unloading, which tells it from friction, and a specimen of another height"

    def candidates(self, situation: Situation) -> list[Candidate]:
        fit, mu = situation.campaign.fit, situation.modulus
        for path in (path for path in fit.named if path.startswith("bulk.")):
            situation.require_new(path)
        if not situation.simulated():
            raise NotTestableError("all tests are answered by closed forms of an incompressible tissue")
        bulk = fit.bulk if fit.bulk.value is not None else Bulk("bulk_ratio", BULK_RATIOS[1])
        tried = min(_RATIO, 0.1 * bulk.modulus(mu) / mu)
        if tried < 2.0 * BULK_RATIOS[0]:
            raise NotTestableError("the campaign states a tissue that is as compressible as it can be here")
        path, absent = f"bulk.{bulk.kind}", float(bulk.value or 0.0)

        def stated(ratio: float) -> float:
            return {"bulk_ratio": ratio, "K_Pa": ratio * mu, "D1_per_Pa": 2.0 / (ratio * mu)}[bulk.kind]

        low, high = sorted((absent, stated(BULK_RATIOS[0])))
        return [Candidate(self, {path: stated(tried)}, absent={path: absent}, bounds={path: (low, high)},
                          inverse=bulk.kind != "D1_per_Pa")]
