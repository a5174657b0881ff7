"""What a diagnosis answers: where the gap is, which effects explain it, which cannot be told apart, what was added."""

from __future__ import annotations

from typing import Literal

import msgspec

from calibration.fit.fit import Fit

Verdict = Literal["NAMED", "SET", "LOOKS_LIKE", "UNKNOWN", "NONE"]
VERDICTS: dict[Verdict, str] = {
    "NAMED": "one effect explains the gap, and nothing else does",
    "SET": "several effects explain it, and these tests do not tell them apart",
    "LOOKS_LIKE": "one effect explains most of it, and its form is not confirmed",
    "UNKNOWN": "there is a gap that no known effect explains",
    "NONE": "nothing is missing that these tests could show"}


class Number(msgspec.Struct, frozen=True, kw_only=True):
    """A number of an effect.

    Attributes:
        path: in the model. symbol, unit: SI. value, standard_error: SI; the error is None where the tests leave it
            open. absent: value at which the effect is not there; None of a number that means nothing then.
        bound: on which it ended, SI; None: on none.
    """

    path: str
    symbol: str
    unit: str
    value: float
    standard_error: float | None = None
    absent: float | None = None
    bound: float | None = None

    @property
    def beyond(self) -> bool:
        """Whether it is a size that ended on a bound, and so no estimate."""
        return self.bound is not None and self.absent is not None


class FoundEffect(msgspec.Struct, frozen=True, kw_only=True):
    """An effect that was added.

    Attributes:
        name, room, title: of the catalogue. tests: in which it acts alone; empty: in all that have it.
        parameters: its numbers. acts_in: regions where it moves the force most, such as ``needle (hold 1)``.
        written_to: file that carries it from now on; empty where nothing was written.
    """

    name: str
    category: str = msgspec.field(name="room")
    title: str
    tests: list[str] = []
    parameters: list[Number] = []
    acts_in: list[str] = []
    written_to: str = ""


class CandidateStatement(msgspec.Struct, frozen=True, kw_only=True):
    """An effect of the catalogue, as these tests see it.

    Attributes:
        name: of the effect, with its test where it acts in one only. effect, room, title: of the catalogue.
        testable: whether these tests could show it. reason: why not; empty where they could.
        seen_from: path -> smallest size that nine of ten such data sets would show, SI.
        symbols, units, absent: path -> symbol, unit (SI) and value at which it is not there, of these sizes.
        twins: names of others whose signature here is the same but for a few per cent.
        separated_by: what would tell it from others.
        score: deviations that the data show of it, with its sign. p: that chance makes any effect score so.
        estimate: path -> size by the score, SI. refitted: whether it was fitted with the finite elements.
        delta_BIC: how much better the fit is with it; None where it was not fitted. explained_percent: of the gap.
        evidence_ratio: of the best candidate to this one, 1 for the best.
        parameters: its numbers of the refit. on_bound: symbols that ended on a bound. note: what else to know.
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
    parameters: list[Number] = []
    on_bound: list[str] = []
    note: str = ""


class RegionGap(msgspec.Struct, frozen=True, kw_only=True):
    """The gap in one segment of one test.

    Attributes:
        test, segment: names. speed_mm_s: of the motion; 0 in a hold; None without time. cycle: number.
        before_N, after_N: root mean square of what is smooth in it. largest_before_N: with its sign, data minus model.
        before_sigma, after_sigma: how improbable, in deviations of a normal distribution. adequate_before,
        adequate_after: whether chance makes it. sentence: in words. After: None where nothing was added.
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


class HeldOut(msgspec.Struct, frozen=True, kw_only=True):
    """Data that the fits have not seen.

    Attributes:
        name: of a recording, or of a test. kind: ``replicate`` or ``test``.
        before_N, after_N: root mean square error of the prediction. noise_N: of its sensor.
        adequate_after: whether what is left is noise, jitter and the parameters' uncertainty; None where not tested.
        note: why there is no prediction; empty where there is one.
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
    """An experiment that would tell more.

    Attributes:
        sentence: what to do. separates: names that it tells apart. deviations: by which it would; None: not computed.
    """

    sentence: str
    separates: list[str] = []
    deviations: float | None = None


class Stage(msgspec.Struct, frozen=True, kw_only=True):
    """What took how long, s of wall time, and how many simulations."""

    name: str
    wall_s: float
    simulations: int = 0


class Diagnosis(msgspec.Struct, frozen=True, kw_only=True):
    """The answer for one campaign.

    Attributes:
        campaign, law: names. verdict: one of `VERDICTS`. message: what was found, in a few sentences.
        effects: that were added. indistinguishable: names that explain the gap as well; the added ones are among them.
        candidates: the catalogue, best first. regions: of all tests.
        gap_before_N, gap_after_N: root mean square of what is smooth in the residuals, over all samples.
        noise_N: of the sensors. noise_correlation_s: 0: white. contact_jitter_mm, zero_jitter_N: between replicates.
        mesh_percent: what is known of the mesh's own error. held_out: predictions of unseen data.
        next_experiment: ranked by what they would separate. fit_before, fit_after: the fits; after: None where nothing
            was added. stages: what took how long. files: what was written, by what it is.
    """

    campaign: str
    law: str
    verdict: Verdict
    message: str
    effects: list[FoundEffect] = []
    indistinguishable: list[str] = []
    candidates: list[CandidateStatement] = []
    regions: list[RegionGap] = []
    gap_before_N: float
    gap_after_N: float | None = None
    noise_N: float
    noise_correlation_s: float = 0.0
    contact_jitter_mm: float = 0.0
    zero_jitter_N: float = 0.0
    mesh_percent: float = 0.0
    held_out: list[HeldOut] = []
    next_experiment: list[NextExperiment] = []
    fit_before: Fit
    fit_after: Fit | None = None
    stages: list[Stage] = []
    files: dict[str, str] = {}
