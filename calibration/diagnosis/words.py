"""Sentences that describe a diagnosis."""

from __future__ import annotations

from collections.abc import Sequence

from msgspec.structs import replace

from calibration.diagnosis.decision_limits import LIMITS, DecisionLimits
from calibration.diagnosis.diagnosis import (
    CandidateResult,
    EffectParameter,
    FoundEffect,
    HeldOutPrediction,
    SegmentMisfit,
    Verdict,
)

#: SI unit -> unit in sentences, and the factor of the value.
_UNITS = {"m": ("mm", 1e3), "m/N": ("mm/N", 1e3), "m2/s": ("mm2/s", 1e6), "N s/m": ("N s/mm", 1e-3), "1": ("", 1.0)}


def join_as_enumeration(words: Sequence[str], last: str = "and") -> str:
    """Join words to an enumeration, such as ``a, b and c``."""
    return f" {last} ".join(filter(None, (", ".join(words[:-1]), words[-1]))) if words else ""


def describe_parameter(number: EffectParameter) -> str:
    """Describe a parameter, such as ``tau1 = 19.7 ± 0.3 s``."""
    unit, factor = _UNITS.get(number.unit, (number.unit, 1.0))
    error = "" if number.standard_error is None else f" ± {factor * number.standard_error:.2g}"
    return f"{number.symbol} = {factor * number.value:.4g}{error}{' ' + unit if unit else ''}"


def describe_effect(effect: FoundEffect) -> str:
    """Describe an effect, such as ``viscoelasticity (g1 = 0.0301 ± 0.0002, tau1 = 19.7 ± 0.3 s)``."""
    where = f" in {join_as_enumeration(effect.tests)}" if effect.tests else ""
    return f"{effect.title}{where} ({', '.join(map(describe_parameter, effect.parameters))})"


def describe_parameter_at_its_bound(number: EffectParameter) -> str:
    """Describe a parameter on its bound, such as ``c = 2 mm/N, the largest that a fit may take``."""
    assert number.bound is not None
    end = "smallest" if number.bound < (number.absent or 0.0) else "largest"
    return f"{describe_parameter(replace(number, standard_error=None))}, the {end} that a fit may take"


def _describe_best_rejected_effect(nearest: CandidateResult) -> str:
    """Describe the effect that explains most of the misfit and was not added, with the reason."""
    title, share = f"{nearest.title[:1].upper()}{nearest.title[1:]}", f"{nearest.explained_percent:.0f} %"
    beyond = [each for each in nearest.parameters if each.is_effect_size_at_bound]
    if not beyond:
        return f"{title} comes nearest and explains {share} of it."
    remedy = f" (here: {nearest.separated_by})" if nearest.separated_by else ""
    return (f"{title} comes nearest and explains {share} of it, but its fit ended on a bound, "
            f"{join_as_enumeration([describe_parameter_at_its_bound(each) for each in beyond])}. A value on a bound is "
            "not reliable, so the effect was not named. Either its size exceeds the bound, which a separate "
            f"measurement would show{remedy}, or another effect changes the forces in the same way.")


def summarise_diagnosis(verdict: Verdict, effects: Sequence[FoundEffect], titles: Sequence[str],
                        regions: Sequence[SegmentMisfit], gaps: tuple[float, float | None, float], untestable: int,
                        unseen: Sequence[HeldOutPrediction] = (), nearest: CandidateResult | None = None,
                        repeated: Sequence[str] = (), offsets: Sequence[str] = (), scored: Sequence[str] = (), *,
                        stressed: bool = False, limits: DecisionLimits = LIMITS) -> str:
    """Summarise a diagnosis in a few sentences.

    Args:
        verdict: verdict.
        effects: added effects.
        titles: titles of all candidates that explain the misfit equally well.
        regions: regions of all tests.
        gaps: root mean square of the smooth residuals before and after, and noise, N.
        untestable: number of effects that the tests cannot show.
        unseen: predictions of unseen data.
        nearest: effect that explains most of the misfit.
        repeated: tests with a common signal in the residuals of their recordings.
        offsets: descriptions of contact offsets beyond their assumed scatter.
        scored: descriptions of effects with significant scores, strongest first.
        stressed: whether stress was recorded, Pa.
        limits: decision limits of the diagnosis.
    """
    before, after, noise = gaps
    where = [region.sentence for region in regions if not region.adequate_before]
    if repeated:
        where.append(f"all recordings of {join_as_enumeration(repeated)} have a common signal in their residuals")
    unit, factor = ("kPa", 1e-3) if stressed else ("N", 1.0)
    closed = "" if after is None else (f" The misfit falls from {factor * before:.2g} to {factor * after:.2g} {unit} "
                                       f"({before / noise:.2g} to {after / noise:.2g} of the noise).")
    pairs = [(each.before_N, each.after_N) for each in unseen if each.before_N is not None and each.after_N is not None]
    if pairs and sum(two**2 for _, two in pairs) > limits.error_growth * sum(one**2 for one, _ in pairs):
        closed += " Data that were not fitted are predicted worse with the added effect. Do not rely on this effect."
    silent = f" These tests cannot detect {untestable} effects of the catalogue." if untestable else ""
    match verdict:
        case "NONE":
            if offsets:
                return (f"Nothing is missing except an offset, which the fit removes: {'; '.join(offsets)}. State "
                        f"it as contact in mm in its [[test]], or set offset = \"fit\" with a prior that covers it."
                        f"{silent}")
            return f"Nothing is missing that these tests could show.{silent}"
        case "UNKNOWN":
            worth = nearest is not None and (nearest.explained_percent or 0.0) >= limits.min_mentioned_percent
            near = f" {_describe_best_rejected_effect(nearest)}" if nearest is not None and worth else ""
            if not where:
                several = f" ({join_as_enumeration(scored[:3])})" if scored else ""
                return ("The residuals of every region are within the noise. The residuals of all regions together "
                        f"have a shape that neither chance nor a single effect explains{several}.{near} Nothing was "
                        f"added.{silent}")
            return ("Something is missing that no known effect explains: " + "; ".join(where[:3])
                    + f".{near} Nothing was added.{silent}")
        case "SET":
            names = join_as_enumeration(titles, "or")
            return (f"{names[:1].upper()}{names[1:]} is missing, and these tests cannot distinguish them. The most "
                    f"likely effect was added: {describe_effect(effects[0])}.{closed}")
        case "LOOKS_LIKE":
            return (f"It looks like {join_as_enumeration([describe_effect(each) for each in effects])}, but its form "
                    f"is not confirmed: a smooth misfit remains.{closed}")
        case _:
            named = join_as_enumeration([describe_effect(each) for each in effects])
            return f"{named[:1].upper()}{named[1:]} {'were' if len(effects) > 1 else 'was'} missing.{closed}"
