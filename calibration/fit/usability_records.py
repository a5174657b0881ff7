"""Records of the rule of usable: its clauses, and other optima of a fit."""

from __future__ import annotations

import msgspec


class Clause(msgspec.Struct, frozen=True, kw_only=True):
    """One clause of the rule by which a fit is called usable, see `calibration.fit.usability`.

    Attributes:
        name: ``"physical"``, ``"converged"``, ``"stable"``, ``"recordings"``, ``"replicates"``, ``"residuals"``,
            ``"explained"``, ``"displacement"``, ``"bounds"``, ``"determined"``, ``"unique"`` or ``"population"``.
        holds: whether it holds. status: of the fit where it fails and no clause before it does.
        reason, remedy: in words; empty where it holds.
    """

    name: str
    holds: bool
    status: str
    reason: str = ""
    remedy: str = ""


class Alternative(msgspec.Struct, frozen=True, kw_only=True):
    """Parameters that fit the recordings as well as those of the fit and are another material.

    Attributes:
        parameters: name -> value, SI. parameters_of_law: those of the law by their names in the law.
        R2, rise: as of a `Minimum`.
        separated_by: test that tells the two apart best, in words. at: its stretch, or shear strain.
        stress_Pa, alternative_stress_Pa: nominal stress there of the fit and of this alternative.
    """

    parameters: dict[str, float]
    parameters_of_law: dict[str, float]
    R2: float
    rise: float
    separated_by: str
    at: float
    stress_Pa: float
    alternative_stress_Pa: float

    @property
    def times(self) -> str:
        """``, 4.2 times``: ratio of the larger stress to the smaller; empty where their signs differ."""
        low, high = sorted((abs(self.stress_Pa), abs(self.alternative_stress_Pa)))
        same = self.stress_Pa * self.alternative_stress_Pa > 0
        return f", {high / low:.3g} times" if same else ""
