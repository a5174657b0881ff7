"""What a calibration answers: one `Fit` a law, and predictions of the held-out tests."""

from __future__ import annotations

from collections.abc import Iterable

import msgspec

from calibration.fit.usability_records import Alternative, Clause


class Minimum(msgspec.Struct, frozen=True, kw_only=True):
    """A local minimum of the sum of squares that some of the starts ended in.

    Attributes:
        parameters: name -> value, SI.
        R2: coefficient of determination there.
        starts: how many starts ended in it.
        rise: its sum of squares less that of the best, in units of the variance of the residuals.
    """

    parameters: dict[str, float]
    R2: float
    starts: int
    rise: float = 0.0


class Nuisance(msgspec.Struct, frozen=True, kw_only=True):
    """Contact offset and zero of one replicate, in the units of the file.

    Attributes:
        replicate: its name.
        contact_offset_mm: reported displacement at which the tool truly touches.
        zero_offset_N: reading without load.
        contact_offset_error_mm, zero_offset_error_N: standard errors; None on a bound, or where not determined.
        on_bound: names of those that ended on their bound.
    """

    replicate: str
    contact_offset_mm: float
    contact_offset_error_mm: float | None
    zero_offset_N: float
    zero_offset_error_N: float | None
    on_bound: list[str] = []


class Prediction(msgspec.Struct, frozen=True, kw_only=True):
    """A test as a law predicts it that was fitted without that test.

    Attributes:
        test, law: names.
        RMSE_N: root mean square error of the force; None without a specimen.
        RMSE_Pa: of the nominal stress; None where the deformation is not homogeneous.
        percent: error relative to the largest measured stress, or force.
        expected_N: RMSE that noise, jitter and the uncertainty of the parameters would make; None where unknown.
        fitted: tests that the law was fitted to for this; empty: all that are not held out.
        note: why there is no prediction; empty where there is one.
        mean_of: specimens whose mean predicts, as nothing else tells the numbers of the test's own; empty: they are
            known. What is expected then includes the scatter between specimens.
        parameters: free ones of the fit that predicts, name -> value, SI, of an inverse fit.

    Errors are None where the law does not carry the specimen as far as the test went, or where the other tests leave a
    parameter open.
    """

    test: str
    law: str
    RMSE_N: float | None
    RMSE_Pa: float | None
    percent: float | None
    expected_N: float | None = None
    fitted: list[str] = []
    note: str = ""
    mean_of: list[str] = []
    parameters: dict[str, float] = {}


class Iteration(msgspec.Struct, frozen=True, kw_only=True):
    """One solve of an inverse fit: all tests simulated at one set of parameters.

    Attributes:
        start: number of the start, from 1. run: number of the solve from that start, from 1.
        parameters: free ones, name -> value, SI. error: sum of squares of the whitened residuals and priors.
        RMSE_N: of all samples. corrected: whether the difference to the accurate mesh was in.
    """

    start: int
    run: int
    parameters: dict[str, float]
    error: float
    RMSE_N: float
    corrected: bool


class Profile(msgspec.Struct, frozen=True, kw_only=True):
    """Profile likelihood of one parameter: the smallest sum of squares for each of its values.

    Attributes:
        values: ascending, SI; the estimate is among them.
        rises: of the sum of squares above its minimum there, in units of the noise (or of the residuals where these
            exceed it).
        level: rise at the ends of the 95 % interval.
        notes: what ended the interval early, such as ``"low: bound 0"``.
    """

    values: list[float]
    rises: list[float]
    level: float
    notes: list[str] = []


class Region(msgspec.Struct, frozen=True, kw_only=True):
    """Whether a smooth misfit is left in one part of one test.

    Attributes:
        test, segment: names. start, end: displacement at its ends, mm (strain where the test has no specimen).
        p: probability of so large a misfit by chance, adjusted for the number of regions (Holm).
        statistic, freedom: of the test, see `calibration.statistics.adequacy`.
        misfit_N: root mean square of the smooth part of model minus data (Pa where the test has no specimen).
        largest_N, at: where that is largest: its value with sign, and the displacement there, mm.
        adequate: p above 0.05.
    """

    test: str
    segment: str
    start: float
    end: float
    p: float
    statistic: float
    freedom: int
    misfit_N: float
    largest_N: float
    at: float
    adequate: bool


class Direction(msgspec.Struct, frozen=True, kw_only=True):
    """A combination of parameters that the tests tell poorly.

    Attributes:
        shares: parameter -> component of the unit vector of relative changes.
        relative_error: standard error along it, relative to the parameters.
    """

    shares: dict[str, float]
    relative_error: float


class Suggestion(msgspec.Struct, frozen=True, kw_only=True):
    """A further test, and what it would do.

    Attributes:
        test: in words.
        standard_errors: name -> standard error with it, SI.
    """

    test: str
    standard_errors: dict[str, float]


class Window(msgspec.Struct, frozen=True, kw_only=True):
    """The free parameters, SI, from the samples up to a share of the largest strain of each test."""

    share: float
    parameters: dict[str, float]


class SensorStatement(msgspec.Struct, frozen=True, kw_only=True):
    """Noise of one test's recordings, as stated or estimated.

    Attributes:
        test: name. deviation_N: standard deviation (Pa where the test has no specimen).
        correlation_time_s: 0 for white noise. source: ``"stated"``, ``"estimated"`` or ``"resolution"``.
    """

    test: str
    deviation_N: float
    correlation_time_s: float
    source: str


class JitterStatement(msgspec.Struct, frozen=True, kw_only=True):
    """Scatter between recordings.

    Attributes:
        contact_mm, zero_N: standard deviations; of tests without a specimen 1000 times strain, and Pa.
        freedom: degrees of freedom of an estimate; 0: assumed; None: stated.
        stressed: whether all tests are without a specimen.
    """

    contact_mm: float
    zero_N: float
    freedom: int | None = None
    stressed: bool = False

    @property
    def sizes(self) -> tuple[str, str]:
        """Contact and zero, with their units."""
        if self.stressed:
            return f"{self.contact_mm * 1e-3:.2g} of strain", f"{self.zero_N:.2g} Pa"
        return _in_digits(self.contact_mm, "mm", "µm", "nm"), _in_digits(self.zero_N, "N", "mN", "µN", "nN", "pN")


def _in_digits(value: float, *units: str) -> str:
    """Two digits in the first of these units, each a thousandth of the one before, in which it is 0.001 or more."""
    place = next((i for i in range(len(units)) if abs(value) * 1e3**i >= 1e-3), len(units) - 1) if value else 0
    return f"{value * 1e3**place:.2g} {units[place]}"


class MeshCorrection(msgspec.Struct, frozen=True, kw_only=True):
    """Accurate mesh against fast mesh in one test.

    Attributes:
        test: name. largest_percent: largest difference, relative to the largest force; None where the accurate mesh
            did not get through.
        remainder_percent: standard deviation of what the mesh that counts is off, relative to the force.
        refreshes: how often the difference was computed.
    """

    test: str
    largest_percent: float | None
    remainder_percent: float
    refreshes: int


class Covariance(msgspec.Struct, frozen=True, kw_only=True):
    """Covariance of the parameters, SI, in a stated order."""

    order: list[str]
    matrix: list[list[float]]


class PopulationStatement(msgspec.Struct, frozen=True, kw_only=True):
    """The population that specimens with numbers of their own come from, SI; see
    `calibration.statistics.population.Population`.

    Attributes:
        order: paths of the parameters. specimens: names of those that went in; `Fit.left_out_specimens` are the others.
        mean, mean_errors, mean_intervals, mean_covariance: of the population. covariance: of the mean together with the
            numbers that all specimens share.
        between: covariance between specimens. spread, spread_intervals: its standard deviations.
        next_specimen: 95 % interval for a specimen that was not measured.
        estimates, errors: of each specimen alone. shrunken, shrunken_errors: of each with what the others tell.
    """

    order: list[str]
    specimens: list[str]
    mean: list[float]
    mean_errors: list[float]
    mean_intervals: list[tuple[float, float]]
    mean_covariance: list[list[float]]
    covariance: Covariance
    between: list[list[float]]
    spread: list[float]
    spread_intervals: list[tuple[float, float]]
    next_specimen: list[tuple[float, float]]
    estimates: list[list[float]]
    errors: list[list[float]]
    shrunken: list[list[float]]
    shrunken_errors: list[list[float]]


class Fit(msgspec.Struct, frozen=True, kw_only=True, rename={"E0": "E0_Pa", "mu0": "mu0_Pa"}):
    """A law fitted to a campaign. Encoded, it is an entry of ``fits`` in ``fit.json``.

    Attributes:
        law, formula: name and energy.
        parameters: name, a path in the model, -> value, SI. symbols: name -> as reports write it, such as ``g1``.
        units: name -> SI unit; ``"1"`` of a number.
        standard_errors: name -> standard deviation of the estimate; None where not determined or on a bound; 0 if
            fixed.
        derivatives: free parameter -> ``"exact"`` or ``"difference"``: how its derivatives were found.
        covariance: of the parameters, zero for those that are fixed or on a bound. correlation: in the same order.
        covariance_from: ``"noise"``, ``"residuals"`` or ``"replicates"``: what the standard errors rest on.
        intervals95: name -> (low, high) inside the bounds, None without a standard error.
        not_identifiable: names whose standard error exceeds the value or that lie in a singular direction.
        on_bound: parameters and nuisances that ended on a bound.
        R2: of the nominal stress. RMSE_N: None without a specimen. RMSE_Pa: of the nominal stress.
        noise_ratio: root mean square of the residuals, each in units of its noise.
        AIC, BIC: with the noise taken as known and priors as penalties, up to a constant that all laws share.
        E0, mu0: initial Young's and shear modulus of the incompressible law, Pa.
        stable_from, stable_to: stretches that are Drucker-stable in all three modes of loading; stability: the same
            in words; stretch_range: of all principal stretches of the data.
        sag_mm: specimen that weighs -> by how much it sags with this law and its own numbers (of one that was not
            fitted, those of the material).
        nuisances: of the replicates when offsets are fitted or their jitter is marginalised.
        minima: best first. starts: how many were tried.
        alternatives: other parameters that fit as well; standard errors of parameters that differ between them are
            None.
        misfits: fitted test -> root mean square residual, % of its largest force.
        status: ``"converged"``, or that of the first clause that fails: ``"misfit"`` (does not describe the data),
            ``"ambiguous"`` (other parameters fit as well), ``"not_determined"`` (the shear modulus by the tests),
            ``"unstable"`` (in the measured loading over the data),
            ``"not_physical"``, ``"not_converged"`` or ``"no_population"`` (specimens with numbers of their own, of
            which fewer than two are determined). Only the first is usable.
        clauses: of the rule of usable, in the order of their weight.
        unusable: why it is not usable; None where it is.
        warnings: what to mind, usable or not: bounds that hold unknowns, loss of stability in other loading.
        message: for people; holds both.
        iterations: evaluations of the model. fem_solves: simulated tests; 0 for a closed form. cpu_s: processor
            seconds.
        influence: recording -> free parameters without it, SI; of tests of three recordings or more.
        odd_recordings: those that disagree with the others. windows: parameters from parts of the strain.
        material_file: name of the file, None where the fit gives no material.
        population: of the specimens, where each has numbers of its own; the material is then its mean.
        material_of: specimens whose mean the material, E0, mu0 and stability are; one: its own; empty: all share them.
        left_out_specimens: specimen -> why its numbers are not in that mean.
        left_out: percent, root mean square over the tests, of the predictions that rank the laws.

    Of an inverse fit only:
        interval_notes: name -> what cut its interval. profiles: name -> profile likelihood.
        regions: where a smooth misfit is left. history: every solve of every start.
        condition: of the information, each parameter scaled by its value. directions: those told poorly.
        suggestions: further tests, best first, where something is not identifiable.
        jitter, mesh: what was marginalised and corrected.
        estimate_cpu_s: processor seconds from the best start to the estimate, the rest of `cpu_s` went into other
            starts, profiles, left-out tests and pictures.
    """

    law: str
    formula: str
    parameters: dict[str, float]
    symbols: dict[str, str]
    units: dict[str, str]
    standard_errors: dict[str, float | None]
    derivatives: dict[str, str] = {}
    covariance: Covariance
    correlation: list[list[float]]
    covariance_from: str
    intervals95: dict[str, tuple[float, float] | None]
    not_identifiable: list[str]
    on_bound: list[str]
    R2: float
    RMSE_N: float | None
    RMSE_Pa: float | None
    noise_ratio: float
    AIC: float
    BIC: float
    E0: float
    mu0: float
    stable_from: float
    stable_to: float
    stability: str
    stretch_range: tuple[float, float]
    sag_mm: dict[str, float] = {}
    nuisances: list[Nuisance] = []
    minima: list[Minimum] = []
    starts: int
    alternatives: list[Alternative] = []
    misfits: dict[str, float] = {}
    status: str
    unusable: str | None = None
    clauses: list[Clause] = []
    warnings: list[str] = []
    message: str
    iterations: int
    fem_solves: int = 0
    cpu_s: float
    influence: dict[str, dict[str, float]] = {}
    odd_recordings: list[str] = []
    windows: list[Window] = []
    material_file: str | None = None
    population: PopulationStatement | None = None
    material_of: list[str] = []
    left_out_specimens: dict[str, str] = {}
    interval_notes: dict[str, str] = {}
    profiles: dict[str, Profile] = {}
    regions: list[Region] = []
    history: list[Iteration] = []
    condition: float | None = None
    directions: list[Direction] = []
    suggestions: list[Suggestion] = []
    jitter: JitterStatement | None = None
    mesh: list[MeshCorrection] = []
    left_out: float | None = None
    estimate_cpu_s: float = 0.0

    def unit(self, name: str) -> str:
        """Of a parameter, as people read it: empty for a number."""
        return "" if self.units[name] == "1" else self.units[name]

    @property
    def held(self) -> list[str]:
        """Parameters that a bound holds."""
        return [name for name in self.on_bound if name in self.parameters]

    def in_symbols(self, names: Iterable[str]) -> str:
        """Symbols of parameters, such as ``C10, g1``."""
        return ", ".join(self.symbols[name] for name in names)
