"""Compressibility of the tissue."""

from calibration.effects.effect import Candidate, DiagnosisData, Effect, NotTestableError
from tissue_sim.material.material import BULK_RATIOS, Bulk


class Compressibility(Effect):
    """Effect of a bulk modulus below the assumed one, in the quantity that the campaign states (K/mu, K or D1)."""

    name = "compressibility"
    category = "tissue"
    title = "compressibility"
    signature = "tests that confine the tissue laterally are softer than the other tests predict, from the start on"
    separated_by = "unloading, which separates compressibility from friction, and a specimen of another height"
    #: Trial ratio K / mu. It lowers the force of bonded compression of the reference cylinder by 1 %.
    trial_ratio = 100.0

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return the candidate with the trial ratio K / mu, or with a tenth of the stated ratio if this is smaller."""
        fit, mu = situation.campaign.fit, situation.estimated_shear_modulus
        for path in (path for path in fit.named if path.startswith("bulk.")):
            situation.require_unused_parameter(path)
        if not situation.simulated_tests():
            raise NotTestableError("all tests are computed by closed forms of an incompressible tissue")
        bulk = fit.bulk if fit.bulk.value is not None else Bulk("bulk_ratio", BULK_RATIOS[1])
        trial_ratio = min(self.trial_ratio, 0.1 * bulk.modulus(mu) / mu)
        if trial_ratio < 2.0 * BULK_RATIOS[0]:
            raise NotTestableError("the stated bulk modulus is already close to the smallest that the solver accepts")
        path, absent = f"bulk.{bulk.kind}", float(bulk.value or 0.0)

        def convert_ratio_to_stated_parameter(ratio: float) -> float:
            """Return the parameter of the bulk response (K / mu, K or D1) for a ratio K / mu."""
            return {"bulk_ratio": ratio, "K_Pa": ratio * mu, "D1_per_Pa": 2.0 / (ratio * mu)}[bulk.kind]

        low, high = sorted((absent, convert_ratio_to_stated_parameter(BULK_RATIOS[0])))
        return [Candidate(self, {path: convert_ratio_to_stated_parameter(trial_ratio)}, absent={path: absent},
                          bounds={path: (low, high)},
                          inverse=bulk.kind != "D1_per_Pa")]
