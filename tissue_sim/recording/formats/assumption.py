"""Assumptions that an import makes about a file, each with its evidence and the alternatives that also fit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

#: Relative difference of the modulus above which an alternative must be decided by the user.
MODULUS_TOLERANCE = 0.05


@dataclass(frozen=True)
class AlternativeValue:
    """Another value of an assumption that the evidence in the file does not exclude.

    Attributes:
        value: in words, as `Assumption.value`.
        modulus_ratio: modulus with this value divided by the modulus with the assumed value; None if unknown.
        flag: command-line flag that selects this value, e.g. ``--decimal ","``.
    """

    value: str
    modulus_ratio: float | None = None
    flag: str = ""

    @property
    def may_change_modulus(self) -> bool:
        """Whether the modulus changes by more than `MODULUS_TOLERANCE`, or by an unknown amount.

        Either value may be the true one: the change counts relative to the smaller modulus.
        """
        ratio = self.modulus_ratio
        return ratio is None or not ratio > 0 or max(ratio, 1.0 / ratio) > 1.0 + MODULUS_TOLERANCE


@dataclass(frozen=True)
class Assumption:
    """One assumption about a file: its value, the evidence, and the alternatives.

    Attributes:
        subject: e.g. ``"thousands separator"``, ``"unit of force"``, ``"kind of test"``, ``"zero of displacement"``.
        value: assumed value in words.
        evidence: sentences that support the value.
        against: sentences that contradict the value.
        alternatives: values that also fit.
        flag: command-line flag that states the assumed value; empty if there is none.
        is_stated: whether the user stated the value. A stated value is never a question.
    """

    subject: str
    value: str
    evidence: tuple[str, ...] = ()
    against: tuple[str, ...] = ()
    alternatives: tuple[AlternativeValue, ...] = ()
    flag: str = ""
    is_stated: bool = False

    @property
    def needs_user_decision(self) -> bool:
        """Whether the user must decide: an alternative fits as well and changes the modulus."""
        return not self.is_stated and any(each.may_change_modulus for each in self.alternatives)

    @property
    def question_text(self) -> str:
        """The question in one sentence, with the flags that decide it."""
        choices = [(self.value, self.flag), *((each.value, each.flag) for each in self.alternatives)]
        listed = " or ".join(f"{value} ({flag})" if flag else value for value, flag in choices)
        reasons = f" ({'; '.join((*self.evidence, *self.against))})" if self.evidence or self.against else ""
        return f"{self.subject}: {listed}?{reasons}"

    def to_json(self) -> dict[str, Any]:
        """JSON object with the fields of this assumption and ``is_question``."""
        return {"subject": self.subject, "value": self.value, "evidence": list(self.evidence),
                "against": list(self.against), "flag": self.flag, "is_stated": self.is_stated,
                "is_question": self.needs_user_decision,
                "alternatives": [{"value": each.value, "modulus_ratio": each.modulus_ratio, "flag": each.flag}
                                 for each in self.alternatives]}
