"""Records of a calibration: one `Fit` per law, predictions of held-out tests, and their parts.

The parts are the covariance of parameters, the population of specimens, the clauses of the usability rule and other
optima. The representative material of a fit has the shared parameters and the mean of the individual ones.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import msgspec
import numpy as np

from tissue_sim.public_names import OldName


class ParameterCovariance(msgspec.Struct, frozen=True, kw_only=True):
    """Covariance matrix of parameters.

    Attributes:
        order: names of the parameters.
        matrix: covariance matrix, SI, shape (p, p) as lists.
    """

    order: list[str]
    matrix: list[list[float]]


class PopulationRecord(msgspec.Struct, frozen=True, kw_only=True):
    """Population of specimens with individual parameters, SI.

    See `calibration.statistics.population.PopulationEstimate`.

    Attributes:
        order: paths of the parameters.
        specimens: names of the included specimens; `Fit.left_out_specimens` are the others.
        mean: population mean.
        mean_errors: standard errors of the mean.
        mean_intervals: 95 % intervals of the mean.
        mean_covariance: covariance of the mean.
        covariance: joint covariance of the mean and the parameters that all specimens share.
        between: between-specimen covariance.
        spread: between-specimen standard deviations.
        spread_intervals: 95 % intervals of the spread.
        next_specimen: 95 % prediction intervals of a further specimen.
        estimates: estimates of each specimen alone.
        errors: standard errors of the estimates.
        shrunken: shrinkage estimates of each specimen.
        shrunken_errors: standard errors of the shrinkage estimates.
    """

    order: list[str]
    specimens: list[str]
    mean: list[float]
    mean_errors: list[float]
    mean_intervals: list[tuple[float, float]]
    mean_covariance: list[list[float]]
    covariance: ParameterCovariance
    between: list[list[float]]
    spread: list[float]
    spread_intervals: list[tuple[float, float]]
    next_specimen: list[tuple[float, float]]
    estimates: list[list[float]]
    errors: list[list[float]]
    shrunken: list[list[float]]
    shrunken_errors: list[list[float]]


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


class Minimum(msgspec.Struct, frozen=True, kw_only=True):
    """Local minimum of the sum of squares.

    Attributes:
        parameters: name -> value, SI.
        R2: coefficient of determination.
        starts: number of starts that ended in this minimum.
        rise: sum of squares minus that of the best minimum, in units of the variance of the residuals.
    """

    parameters: dict[str, float]
    R2: float
    starts: int
    rise: float = 0.0


class Nuisance(msgspec.Struct, frozen=True, kw_only=True):
    """Contact offset and zero of one replicate.

    Attributes:
        replicate: name of the replicate.
        contact_offset_mm: reported displacement at first contact, mm.
        contact_offset_error_mm: standard error, mm; None on a bound or if not determined.
        zero_offset_N: reading without load, N.
        zero_offset_error_N: standard error, N; None on a bound or if not determined.
        on_bound: names of the fields that ended on a bound.
    """

    replicate: str
    contact_offset_mm: float
    contact_offset_error_mm: float | None
    zero_offset_N: float
    zero_offset_error_N: float | None
    on_bound: list[str] = []


class Prediction(msgspec.Struct, frozen=True, kw_only=True):
    """Prediction of a test by a law that was fitted without this test.

    All errors are None if the simulation fails or the other tests do not determine the parameters.

    Attributes:
        test: name of the test.
        law: name of the law.
        RMSE_N: root mean square error of the force, N; None without a specimen.
        RMSE_Pa: root mean square error of the nominal stress, Pa; None if the deformation is not homogeneous.
        percent: error relative to the largest measured force or stress, %.
        expected_N: expected error from noise, jitter and parameter uncertainty, N; None if unknown.
        fitted: names of the fitted tests; empty: all tests that are not held out.
        note: reason why there is no prediction; empty otherwise.
        mean_of: specimens whose mean parameters predict the test, because its own are unknown; `expected_N` then
            includes the scatter between specimens. Empty: the parameters of the test are known.
        parameters: name -> value of the free parameters of the predicting inverse fit, SI.
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


class DescentEvaluation(msgspec.Struct, frozen=True, kw_only=True):
    """Evaluation of an inverse fit: simulation of all tests at one set of parameters.

    Attributes:
        start: number of the start, from 1.
        run: number of the evaluation from this start, from 1.
        parameters: name -> value of the free parameters, SI.
        error: sum of squares of whitened residuals, nuisances and priors.
        RMSE_N: root mean square error of all samples, N.
        corrected: whether the mesh correction was included.
    """

    start: int
    run: int
    parameters: dict[str, float]
    error: float
    RMSE_N: float
    corrected: bool


class ProfileLikelihood(msgspec.Struct, frozen=True, kw_only=True):
    """Profile likelihood of one parameter: smallest sum of squares for each value of the parameter.

    Attributes:
        values: values of the parameter in ascending order including the estimate, SI.
        rises: rise of the sum of squares above its minimum, in units of the variance of noise or residuals.
        level: rise at the ends of the 95 % interval.
        notes: reasons why an end is not at this rise, such as ``"low: bound 0"``.
    """

    values: list[float]
    rises: list[float]
    level: float
    notes: list[str] = []


class RegionMisfitTest(msgspec.Struct, frozen=True, kw_only=True):
    """Test for a smooth misfit in one part of one test.

    Attributes:
        test: name of the test.
        segment: name of the segment, or third of a loading.
        start: smallest displacement, mm (strain without a specimen).
        end: largest displacement, mm (strain without a specimen).
        p: p value, adjusted for the number of regions (Holm).
        statistic: statistic of the score test, see `calibration.statistics.adequacy`.
        freedom: degrees of freedom of the statistic.
        misfit_N: root mean square of the smooth part of model minus data, N (Pa without a specimen).
        largest_N: largest smooth misfit with its sign, N (Pa without a specimen).
        at: displacement at the largest misfit, mm (strain without a specimen).
        adequate: whether p exceeds 0.05.
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


class WeakDirection(msgspec.Struct, frozen=True, kw_only=True):
    """Combination of parameters that the tests determine weakly.

    Attributes:
        shares: parameter -> component of the unit vector of relative changes.
        relative_error: relative standard error along this vector.
    """

    shares: dict[str, float]
    relative_error: float


class SuggestedTest(msgspec.Struct, frozen=True, kw_only=True):
    """Further test that would determine the weakest combination of parameters better.

    Attributes:
        test: description of the test.
        standard_errors: name -> expected standard error with this test, SI.
    """

    test: str
    standard_errors: dict[str, float]


class WindowFit(msgspec.Struct, frozen=True, kw_only=True):
    """Parameters from the samples up to a fraction of the largest displacement of each test.

    Attributes:
        share: fraction of the largest displacement.
        parameters: name -> value of the free parameters, SI.
    """

    share: float
    parameters: dict[str, float]


class SensorNoiseRecord(msgspec.Struct, frozen=True, kw_only=True):
    """Noise of the recordings of one test.

    Attributes:
        test: name of the test.
        deviation_N: standard deviation, N (Pa without a specimen).
        correlation_time_s: correlation time, s; 0: white noise.
        source: ``"stated"``, ``"estimated"`` or ``"resolution"``.
    """

    test: str
    deviation_N: float
    correlation_time_s: float
    source: str


class ReplicateJitterRecord(msgspec.Struct, frozen=True, kw_only=True):
    """Scatter between recordings.

    Attributes:
        contact_mm: standard deviation of the contact, mm (1000 times strain without a specimen).
        zero_N: standard deviation of the zero, N (Pa without a specimen).
        freedom: degrees of freedom of the estimate; 0: assumed; None: stated.
        stressed: whether no test has a specimen.
    """

    contact_mm: float
    zero_N: float
    freedom: int | None = None
    stressed: bool = False

    @property
    def contact_and_zero_jitter_texts(self) -> tuple[str, str]:
        """Jitter of contact and of zero as two texts with units, such as ``30 µm`` and ``5 mN``."""
        if self.stressed:
            return f"{self.contact_mm * 1e-3:.2g} of strain", f"{self.zero_N:.2g} Pa"
        return _format_in_readable_unit(self.contact_mm, "mm", "µm", "nm"), _format_in_readable_unit(self.zero_N, "N",
                                                                                                     "mN", "µN", "nN",
                                                                                                     "pN")


def _format_in_readable_unit(value: float, *units: str) -> str:
    """Format a value with two digits in the first unit in which it is at least 0.001.

    Args:
        value: value in the first unit.
        units: units in descending order, each a thousandth of the previous one.
    """
    index = next((i for i in range(len(units)) if abs(value) * 1e3**i >= 1e-3), len(units) - 1) if value else 0
    return f"{value * 1e3**index:.2g} {units[index]}"


class MeshCorrectionSummary(msgspec.Struct, frozen=True, kw_only=True):
    """Difference of the accurate and the fast mesh in one test.

    Attributes:
        test: name of the test.
        largest_percent: largest difference relative to the largest force, %; None if the accurate mesh did not
            converge.
        remainder_percent: assumed standard deviation of the remaining mesh error relative to the force, %.
        refreshes: number of computations of the difference.
    """

    test: str
    largest_percent: float | None
    remainder_percent: float
    refreshes: int


class Fit(msgspec.Struct, frozen=True, kw_only=True, rename={"E0": "E0_Pa", "mu0": "mu0_Pa"}):
    """Law fitted to a campaign; an entry of ``fits`` in ``fit.json``.

    Attributes:
        law: name of the law.
        formula: strain energy.
        parameters: name (a path in the model) -> value, SI.
        symbols: name -> symbol in reports, such as ``g1``.
        units: name -> SI unit; ``"1"`` for a dimensionless parameter.
        standard_errors: name -> standard error, SI; None if not determined or on a bound; 0 if fixed.
        derivatives: free parameter -> ``"exact"`` or ``"difference"`` (finite difference).
        covariance: covariance of the parameters; zero for fixed parameters and those on a bound.
        correlation: correlation matrix in the order of `covariance`.
        covariance_from: source of the standard errors: ``"noise"``, ``"residuals"`` or ``"replicates"``.
        intervals95: name -> 95 % interval within the bounds, SI; None without a standard error.
        not_identifiable: names of parameters whose standard error exceeds their size or that lie in a singular
            direction.
        on_bound: names of parameters and nuisances on a bound.
        R2: coefficient of determination of the nominal stress (force of an inverse fit).
        RMSE_N: root mean square error of the force, N; None without a specimen.
        RMSE_Pa: root mean square error of the nominal stress, Pa.
        noise_ratio: root mean square of the residuals in units of their noise.
        AIC: Akaike information criterion for known noise and priors as penalties, up to a constant common to all laws.
        BIC: Schwarz criterion, likewise.
        E0: initial Young's modulus, Pa: 3 mu0 of an incompressible material, and that of a compressible law.
        mu0: initial shear modulus, Pa.
        stable_from: smallest stretch that is Drucker-stable in all three modes of loading.
        stable_to: largest such stretch.
        stability: description of the stable stretches.
        stretch_range: range of all principal stretches of the data.
        sag_mm: specimen with self-weight -> sag with this law and the parameters of the specimen, mm.
        nuisances: contact offset and zero of each replicate if they are fitted or marginalised.
        minima: distinct minima, best first.
        starts: number of starts.
        alternatives: other materials that fit equally well; parameters that differ between them have no standard error.
        misfits: fitted test -> root mean square residual, % of its largest force.
        status: ``"converged"``, or that of the first clause that fails: ``"misfit"`` (does not describe the data),
            ``"ambiguous"`` (other parameters fit as well), ``"not_determined"`` (the shear modulus by the tests),
            ``"unstable"`` (in the measured loading over the data),
            ``"not_physical"``, ``"not_converged"`` or ``"no_population"`` (specimens with numbers of their own, of
            which fewer than two are determined). Only the first is usable.
        clauses: clauses of the usability rule, the most important first.
        unusable: reason why the fit is not usable; None: it is usable.
        warnings: warnings, such as parameters on bounds and instability in other modes of loading.
        message: status, reasons and warnings in one text.
        iterations: number of evaluations of the model.
        fem_solves: number of simulated tests; 0 for a closed form.
        cpu_s: processor time, s.
        influence: recording -> free parameters without it, SI; for tests with at least three recordings.
        odd_recordings: names of recordings that disagree with the others.
        windows: parameters from parts of the strain.
        material_file: name of the material file; None if the fit gives no material.
        population: population of specimens with individual parameters; the material is then its mean.
        material_of: specimens whose mean the material is, including E0, mu0 and stability; empty: all specimens share
            it.
        left_out_specimens: specimen -> reason why it is not included in this mean.
        left_out: root mean square error over the predicted tests that ranks the laws, %.
        interval_notes: name -> reason why its interval ends early.
        profiles: name -> profile likelihood.
        regions: tests for smooth misfit.
        history: all evaluations of all starts.
        condition: condition number of the scaled information.
        directions: weakly determined directions.
        suggestions: further tests, best first, if parameters are not identifiable.
        jitter: marginalised scatter between recordings.
        mesh: mesh corrections.
        estimate_cpu_s: processor time from the best start to the estimate, s, without other starts, profiles, left-out
            tests and figures.
    """

    law: str
    formula: str
    parameters: dict[str, float]
    symbols: dict[str, str]
    units: dict[str, str]
    standard_errors: dict[str, float | None]
    derivatives: dict[str, str] = {}
    covariance: ParameterCovariance
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
    alternatives: list[AlternativeMinimum] = []
    misfits: dict[str, float] = {}
    status: str
    unusable: str | None = None
    clauses: list[UsabilityClauseResult] = []
    warnings: list[str] = []
    message: str
    iterations: int
    fem_solves: int = 0
    cpu_s: float
    influence: dict[str, dict[str, float]] = {}
    odd_recordings: list[str] = []
    windows: list[WindowFit] = []
    material_file: str | None = None
    population: PopulationRecord | None = None
    material_of: list[str] = []
    left_out_specimens: dict[str, str] = {}
    interval_notes: dict[str, str] = {}
    profiles: dict[str, ProfileLikelihood] = {}
    regions: list[RegionMisfitTest] = []
    history: list[DescentEvaluation] = []
    condition: float | None = None
    directions: list[WeakDirection] = []
    suggestions: list[SuggestedTest] = []
    jitter: ReplicateJitterRecord | None = None
    mesh: list[MeshCorrectionSummary] = []
    left_out: float | None = None
    estimate_cpu_s: float = 0.0

    unit = OldName("get_unit_or_empty_if_dimensionless")
    held = OldName("parameters_on_bounds")
    in_symbols = OldName("format_symbols")

    def get_unit_or_empty_if_dimensionless(self, name: str) -> str:
        """Return the SI unit of a parameter; an empty text for a dimensionless parameter."""
        return "" if self.units[name] == "1" else self.units[name]

    @property
    def parameters_on_bounds(self) -> list[str]:
        """Names of parameters whose estimates are on a bound, without contact offsets and zeros."""
        return [name for name in self.on_bound if name in self.parameters]

    def format_symbols(self, names: Iterable[str]) -> str:
        """Return the symbols of parameters as one text, such as ``C10, g1``."""
        return ", ".join(self.symbols[name] for name in names)


@dataclass(frozen=True, eq=False)
class RepresentativeMaterial:
    """Shared parameters, and the mean over specimens of individual parameters (or those of the only specimen).

    Attributes:
        parameters: path -> value, SI.
        errors: path -> standard error, SI; 0 if fixed, None if not determined.
        covariance: covariance in the order of `parameters`, SI, shape (p, p); zero for fixed parameters and bounds.
    """

    parameters: dict[str, float]
    errors: dict[str, float | None]
    covariance: np.ndarray


def get_shared_and_population_mean_material(fit: Fit) -> RepresentativeMaterial:
    """Return the representative material of a fit, without parameters of single tests or recordings."""
    name_of: dict[str, str] = {}
    for name in fit.parameters:
        path, at, mark = name.partition("@")
        if not at or mark in fit.material_of[:1]:
            name_of[path] = name
    order, indices = list(name_of), [fit.covariance.order.index(name) for name in name_of.values()]
    parameters = {path: fit.parameters[name] for path, name in name_of.items()}
    errors = {path: fit.standard_errors[name] for path, name in name_of.items()}
    covariance = np.array(fit.covariance.matrix)[np.ix_(indices, indices)]
    if fit.population is not None:
        found = fit.population
        parameters |= dict(zip(found.order, found.mean, strict=True))
        errors |= dict(zip(found.order, found.mean_errors, strict=True))
        means = [order.index(path) for path in found.order]
        covariance[means], covariance[:, means] = 0.0, 0.0
        together = [order.index(path) for path in found.covariance.order]
        covariance[np.ix_(together, together)] = found.covariance.matrix
    return RepresentativeMaterial(parameters, errors, covariance)
