"""Records of a diagnosis, their JSON, and sentences that describe them.

The records are the verdict, the misfit of each region, candidates, added effects and further experiments.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import msgspec
from msgspec.structs import replace

from calibration.campaign.campaign import Campaign
from calibration.diagnosis.settings import LIMITS, DecisionLimits
from calibration.fit.fit import Fit

Verdict = Literal["NAMED", "SET", "LOOKS_LIKE", "UNKNOWN", "NONE"]
VERDICTS: dict[Verdict, str] = {
    "NAMED": "one effect explains the misfit, and no other effect does",
    "SET": "several effects explain the misfit, and these tests cannot distinguish them",
    "LOOKS_LIKE": "one effect explains most of the misfit, and its form is not confirmed",
    "UNKNOWN": "no known effect explains the misfit",
    "NONE": "nothing is missing that these tests could show"}


class EffectParameter(msgspec.Struct, frozen=True, kw_only=True):
    """Fitted parameter of an effect.

    Attributes:
        path: path of the parameter in the model.
        symbol: symbol.
        unit: SI unit.
        value: value, SI.
        standard_error: standard error, SI; None if the tests do not determine the parameter.
        absent: value at which the effect is absent, SI; None for a parameter without influence in this case.
        bound: bound at which the fit ended, SI; None: none.
    """

    path: str
    symbol: str
    unit: str
    value: float
    standard_error: float | None = None
    absent: float | None = None
    bound: float | None = None

    @property
    def is_effect_size_at_bound(self) -> bool:
        """Whether the size of the effect ended on a bound, so that its value is not reliable."""
        return self.bound is not None and self.absent is not None


class FoundEffect(msgspec.Struct, frozen=True, kw_only=True):
    """Effect that was added to the model.

    Attributes:
        name: name of the effect.
        category: category of the effect; ``room`` in JSON.
        title: name for reports.
        tests: tests in which the effect acts alone; empty: all tests that have its parameters.
        parameters: fitted parameters of the effect.
        acts_in: regions in which the effect changes the force most, such as ``needle (hold 1)``.
        written_to: output file that contains the effect; empty: none.
    """

    name: str
    category: str = msgspec.field(name="room")
    title: str
    tests: list[str] = []
    parameters: list[EffectParameter] = []
    acts_in: list[str] = []
    written_to: str = ""


class CandidateResult(msgspec.Struct, frozen=True, kw_only=True):
    """Result of a diagnosis for one candidate: detectability, score and fit of an effect of the catalogue.

    Attributes:
        name: name of the candidate: the effect, with its test if it acts in one only.
        effect: name of the effect.
        category: category of the effect; ``room`` in JSON.
        title: name for reports.
        testable: whether the tests can show the effect.
        reason: reason why they cannot; empty if testable.
        seen_from: path -> size that is detected with a probability of 90 %, SI.
        symbols: path -> symbol of these sizes.
        units: path -> SI unit of these sizes.
        absent: path -> value at which the effect is absent, SI.
        twins: names of candidates whose change of the forces agrees within a few per cent.
        separated_by: test or measurement that separates the effect from others.
        score: score in standard deviations, with the sign of the effect.
        p: family-wise p value of the score.
        estimate: path -> size from the score, SI.
        refitted: whether the effect was fitted with finite elements.
        delta_BIC: decrease of BIC by the effect; None if not fitted.
        explained_percent: explained fraction of the misfit, %.
        evidence_ratio: evidence ratio of the best candidate to this one; 1 for the best.
        parameters: fitted parameters of the effect.
        on_bound: symbols of parameters on a bound.
        note: reason of a failed fit; empty otherwise.
    """

    name: str
    effect: str
    category: str = msgspec.field(name="room")
    title: str
    testable: bool
    reason: str = ""
    seen_from: dict[str, float] = {}
    symbols: dict[str, str] = {}
    units: dict[str, str] = {}
    absent: dict[str, float] = {}
    twins: list[str] = []
    separated_by: str = ""
    score: float | None = None
    p: float | None = None
    estimate: dict[str, float] = {}
    refitted: bool = False
    delta_BIC: float | None = None
    explained_percent: float | None = None
    evidence_ratio: float | None = None
    parameters: list[EffectParameter] = []
    on_bound: list[str] = []
    note: str = ""


class SegmentMisfit(msgspec.Struct, frozen=True, kw_only=True):
    """Misfit in one segment of one test before and after effects were added; values after are None if none was added.

    Attributes:
        test: name of the test.
        segment: name of the segment.
        speed_mm_s: mean speed, mm/s; 0 in a hold; None without time.
        cycle: number of the cycle.
        before_N: root mean square of the smooth misfit before, N.
        largest_before_N: largest smooth misfit before, data minus model, N.
        before_sigma: significance before, in standard deviations of a normal distribution.
        adequate_before: whether the residuals before are compatible with chance.
        after_N: root mean square of the smooth misfit after, N.
        after_sigma: significance after.
        adequate_after: whether the residuals after are compatible with chance.
        sentence: description of the misfit.
    """

    test: str
    segment: str
    speed_mm_s: float | None = None
    cycle: int = 1
    before_N: float
    largest_before_N: float
    before_sigma: float
    adequate_before: bool
    after_N: float | None = None
    after_sigma: float | None = None
    adequate_after: bool | None = None
    sentence: str = ""


class HeldOutPrediction(msgspec.Struct, frozen=True, kw_only=True):
    """Prediction of data that were not fitted.

    Attributes:
        name: name of the recording or test.
        kind: ``replicate`` or ``test``.
        before_N: root mean square error of the prediction without effects, N.
        after_N: root mean square error with effects, N; None if none was added.
        noise_N: noise of the sensor, N.
        adequate_before: whether the errors before are compatible with noise, jitter and parameter uncertainty.
        adequate_after: the same after; None if not tested.
        note: reason why there is no prediction; empty otherwise.
    """

    name: str
    kind: str
    before_N: float | None = None
    after_N: float | None = None
    noise_N: float | None = None
    adequate_before: bool | None = None
    adequate_after: bool | None = None
    note: str = ""


class NextExperiment(msgspec.Struct, frozen=True, kw_only=True):
    """Further experiment whose result would separate candidates.

    Attributes:
        sentence: description of the experiment.
        separates: names of the candidates that it separates.
        deviations: expected difference in standard deviations; None: not computed.
    """

    sentence: str
    separates: list[str] = []
    deviations: float | None = None


class DiagnosisStage(msgspec.Struct, frozen=True, kw_only=True):
    """Duration and number of simulations of one stage of a diagnosis.

    Attributes:
        name: name of the stage.
        wall_s: wall time, s.
        simulations: number of simulations.
    """

    name: str
    wall_s: float
    simulations: int = 0


class Diagnosis(msgspec.Struct, frozen=True, kw_only=True):
    """Diagnosis of one campaign.

    Attributes:
        campaign: name of the campaign.
        law: name of the fitted law.
        verdict: one of `VERDICTS`.
        message: summary in a few sentences.
        effects: effects that were added.
        indistinguishable: names of all candidates that explain the misfit equally well, including the added ones.
        candidates: all candidates, best first.
        regions: regions of all tests.
        gap_before_N: root mean square of the smooth residuals without effects, N.
        gap_after_N: the same with effects, N; None if none was added.
        noise_N: noise of the sensors, N.
        noise_correlation_s: correlation time of the noise, s; 0: white noise.
        contact_jitter_mm: scatter of the contact between replicates, mm.
        zero_jitter_N: scatter of the zero between replicates, N.
        mesh_percent: assumed error of the mesh, %.
        held_out: predictions of unseen data.
        next_experiment: further experiments, the most informative first.
        fit_before: fit without effects.
        fit_after: fit with effects; None if none was added.
        stages: duration of each stage.
        files: kind of file -> name of the written file.
        decision_limits: name -> value of the decision limits that differ from the defaults.
        refit_settings: name -> value of the settings of the fits with an effect that differ from the defaults.
    """

    campaign: str
    law: str
    verdict: Verdict
    message: str
    effects: list[FoundEffect] = []
    indistinguishable: list[str] = []
    candidates: list[CandidateResult] = []
    regions: list[SegmentMisfit] = []
    gap_before_N: float
    gap_after_N: float | None = None
    noise_N: float
    noise_correlation_s: float = 0.0
    contact_jitter_mm: float = 0.0
    zero_jitter_N: float = 0.0
    mesh_percent: float = 0.0
    held_out: list[HeldOutPrediction] = []
    next_experiment: list[NextExperiment] = []
    fit_before: Fit
    fit_after: Fit | None = None
    stages: list[DiagnosisStage] = []
    files: dict[str, str] = {}
    decision_limits: dict[str, float] = {}
    refit_settings: dict[str, float | tuple[float, ...]] = {}


@dataclass(frozen=True)
class DiagnosisResult:
    """Result of the diagnosis of one campaign.

    Attributes:
        campaign: campaign with one law.
        diagnosis: diagnosis.
        output: output folder.
        digest: hash of all inputs of the diagnosis.
        resumed: whether the result was read from an earlier run.
    """

    campaign: Campaign
    diagnosis: Diagnosis
    output: Path
    digest: str
    resumed: bool = False


def diagnosis_to_json(results: Sequence[DiagnosisResult]) -> dict[str, Any]:
    """Return the JSON object of ``diagnose --json`` and ``diagnosis.json``.

    Several campaigns are a list under the key ``campaigns``.
    """
    if len(results) != 1:
        return {"campaigns": [diagnosis_to_json([result]) for result in results]}
    result = results[0]
    return {**msgspec.to_builtins(result.diagnosis), "output": str(result.output), "work": result.digest}


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
                        stressed: bool = False, has_moduli: bool = False, limits: DecisionLimits = LIMITS) -> str:
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
        has_moduli: whether a test is a table of moduli, so that the tests have different units.
        limits: decision limits of the diagnosis.
    """
    before, after, noise = gaps
    where = [region.sentence for region in regions if not region.adequate_before]
    if repeated:
        where.append(f"all recordings of {join_as_enumeration(repeated)} have a common signal in their residuals")
    unit, factor = ("kPa", 1e-3) if stressed else ("N", 1.0)
    of_noise = "" if after is None else f"{before / noise:.2g} to {after / noise:.2g} times the noise"
    closed = "" if after is None else f" The misfit falls from {of_noise}." if has_moduli else (
        f" The misfit falls from {factor * before:.2g} to {factor * after:.2g} {unit} ({of_noise}).")
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
