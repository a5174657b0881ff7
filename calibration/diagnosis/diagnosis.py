"""Records of a diagnosis: verdict, misfit of each region, candidates, added effects and further experiments."""

from __future__ import annotations

from typing import Literal

import msgspec

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
