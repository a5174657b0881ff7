"""Records of the usability rule: clauses, and other optima of a fit."""

from __future__ import annotations

import msgspec


class UsabilityClauseResult(msgspec.Struct, frozen=True, kw_only=True):
    """One clause of the usability rule, see `calibration.fit.usability`.

    Attributes:
        name: ``"physical"``, ``"converged"``, ``"stable"``, ``"recordings"``, ``"replicates"``, ``"residuals"``,
            ``"explained"``, ``"displacement"``, ``"bounds"``, ``"determined"``, ``"unique"`` or ``"population"``.
        holds: whether the clause holds.
        status: status of the fit if this clause is the first one that fails.
        reason: reason of the failure in words; empty if the clause holds.
        remedy: remedy in words; empty if the clause holds.
    """

    name: str
    holds: bool
    status: str
    reason: str = ""
    remedy: str = ""


class AlternativeMinimum(msgspec.Struct, frozen=True, kw_only=True):
    """Second set of parameters that fits the recordings as well as the best fit but describes another material.

    Attributes:
        parameters: name -> value, SI.
        parameters_of_law: parameters of the law by their names in the law, SI.
        R2: coefficient of determination, see `calibration.fit.fit.Minimum`.
        rise: rise of the sum of squares, see `calibration.fit.fit.Minimum`.
        separated_by: test in which the nominal stresses of both differ most, in words.
        at: stretch, or shear strain, of that test.
        stress_Pa: nominal stress of the fit there, Pa.
        alternative_stress_Pa: nominal stress of this alternative there, Pa.
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
    def stress_ratio_suffix_or_empty(self) -> str:
        """Text that is appended to a sentence, such as ``, 4.2 times``; empty if the two stresses differ in sign.

        The number is the larger of the two stresses (fit and alternative) divided by the smaller.
        """
        low, high = sorted((abs(self.stress_Pa), abs(self.alternative_stress_Pa)))
        same = self.stress_Pa * self.alternative_stress_Pa > 0
        return f", {high / low:.3g} times" if same else ""
