"""Least-squares problems over all tests of a campaign: whitened residuals, priors, and elimination of nuisances.

The variables of the optimiser are transformations of the unknowns. `build_generalised_problem` constructs
the problem of a law from a campaign and its recordings.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from calibration.campaign.campaign import Campaign
from calibration.campaign.measured import MeasuredCurve, compute_default_contact_offset_deviation
from calibration.campaign.parameter_space import ParameterSpace
from calibration.campaign.parameters import OFFSET_DEFAULTS
from calibration.forward.contract import ForwardTest, InfeasibleError, find_largest_strain_of_data_or_none
from calibration.forward.force_control import whiten_force_changes
from calibration.forward.forms import build_forward_test_of_inverse_fit, compute_mesh_uncertainty
from calibration.forward.meshes import FAST_MESH_ERRORS
from calibration.forward.simulation_cache import SimulationCache
from calibration.statistics.jitter import ContactAndForceZeroJitter, WhitenedReplicate
from tissue_sim.errors import InputError


@dataclass(frozen=True)
class PronyVariableBoundSettings:
    """Default bounds of the variables of a law with Prony terms, used where the campaign states no bounds.

    Attributes:
        max_ratio: largest ratio r_i = g_i / (1 - sum g) of a relaxing to the long-term stiffness.
        time_margin: factor by which a relaxation time may be shorter than the sampling interval or longer than the
            longest recording. A larger value admits times on which the samples have no information.
    """

    max_ratio: float = 1e3
    time_margin: float = 10.0


_BOUNDS = PronyVariableBoundSettings()


@dataclass(frozen=True, eq=False)
class SizeScaledVariables:
    """Variables that are the unknowns divided by their sizes; all arrays have shape (k,).

    Attributes:
        sizes: scale of each unknown.
        bounds: lower and upper bounds of the variables.
    """

    sizes: np.ndarray
    bounds: tuple[np.ndarray, np.ndarray]

    def convert_from_unknowns(self, unknowns: np.ndarray) -> np.ndarray:
        """Convert unknowns (SI units) to variables of the optimiser; both have shape (k,)."""
        return unknowns / self.sizes

    def convert_to_unknowns(self, variables: np.ndarray) -> np.ndarray:
        """Convert variables of the optimiser to unknowns (SI units); both have shape (k,)."""
        return variables * self.sizes

    def convert_jacobian_to_variables(self, jacobian: np.ndarray, variables: np.ndarray) -> np.ndarray:
        """Return derivatives with respect to the variables, from those with respect to the unknowns (chain rule).

        Args:
            jacobian: derivatives with respect to the unknowns, shape (n, k).
            variables: variables at which the Jacobian was evaluated, shape (k,).
        """
        return jacobian * self.sizes


@dataclass(frozen=True, eq=False)
class LongTermPronyVariables:
    """Variables of a law with Prony terms: long-term moduli, ratios r_i = g_i / (1 - sum g), and ln tau_i.

    Every set of ratios r_i >= 0 gives fractions g_i with sum g < 1, so simple bounds suffice.

    Attributes:
        moduli: indices of the moduli among the unknowns.
        exponents: indices of the exponents and other dimensionless parameters of the law.
        exponent_bounds: lower and upper bounds of the parameters in `exponents`, 1.
        g: indices of the fractions g_i.
        tau: indices of the relaxation times.
        time_range: sampling interval and duration of the longest recording, s.
    """

    moduli: np.ndarray
    exponents: np.ndarray
    exponent_bounds: tuple[np.ndarray, np.ndarray]
    g: np.ndarray
    tau: np.ndarray
    time_range: tuple[float, float]

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of the variables, shapes (k,)."""
        low = np.full(self.moduli.size + self.exponents.size + self.g.size + self.tau.size, -np.inf)
        high = -low
        low[self.exponents], high[self.exponents] = self.exponent_bounds
        low[self.g], high[self.g] = 0.0, _BOUNDS.max_ratio
        shortest, longest = self.time_range
        low[self.tau], high[self.tau] = np.log([shortest / _BOUNDS.time_margin, longest * _BOUNDS.time_margin])
        return low, high

    def convert_from_unknowns(self, unknowns: np.ndarray) -> np.ndarray:
        """Convert unknowns (SI units) to variables of the optimiser; both have shape (k,)."""
        rest, variables = max(1.0 - unknowns[self.g].sum(), 1.0 / _BOUNDS.max_ratio), unknowns.copy()
        variables[self.moduli] *= rest
        variables[self.g] /= rest
        variables[self.tau] = np.log(unknowns[self.tau])
        return variables

    def convert_to_unknowns(self, variables: np.ndarray) -> np.ndarray:
        """Convert variables of the optimiser to unknowns (SI units); both have shape (k,)."""
        factor, unknowns = 1.0 + variables[self.g].sum(), variables.copy()
        unknowns[self.moduli] *= factor
        unknowns[self.g] /= factor
        unknowns[self.tau] = np.exp(variables[self.tau])
        return unknowns

    def convert_jacobian_to_variables(self, jacobian: np.ndarray, variables: np.ndarray) -> np.ndarray:
        """Return derivatives with respect to the variables; see `SizeScaledVariables.convert_jacobian_to_variables`."""
        factor, changed = 1.0 + variables[self.g].sum(), jacobian.copy()
        changed[:, self.moduli] *= factor
        changed[:, self.tau] *= np.exp(variables[self.tau])
        # Each r_i changes all instantaneous moduli and all fractions g_j.
        shared = jacobian[:, self.moduli] @ variables[self.moduli] - jacobian[:, self.g] @ variables[self.g] / factor**2
        changed[:, self.g] = jacobian[:, self.g] / factor + shared[:, None]
        return changed


Variables = SizeScaledVariables | LongTermPronyVariables


@dataclass(frozen=True)
class NuisanceEliminationSettings:
    """Settings of the elimination of nuisances.

    Attributes:
        max_steps: maximum number of Gauss-Newton steps for the nuisances; the force is nearly linear in them.
        tolerance: change of a nuisance at which the iteration ends, in standard deviations.
        extrapolation: contact offset, in standard deviations, beyond which the force is extrapolated linearly, because
            no larger depth was simulated.
        relative_step: relative difference of two offsets for the derivative of the rates in the extrapolation.
        scan_range: largest trial contact offset, in standard deviations.
        scan_points: number of trial contact offsets.
    """

    max_steps: int = 10
    tolerance: float = 3e-4
    extrapolation: float = 4.0
    relative_step: float = 1e-3
    scan_range: float = 3.0
    scan_points: int = 25


_ELIMINATION = NuisanceEliminationSettings()
#: Number of modes of the mesh error: proportional to the force, and to the force times the displacement.
MESH_MODES = 2


@dataclass(frozen=True, eq=False)
class ProblemEvaluation:
    """Residuals and derivatives at one set of parameters, with the best nuisances.

    The m nuisances are in units of their standard deviations: contact offset and zero of each recording, then the modes
    of each mesh error. N is the number of samples, p that of parameters, q that of priors.

    Attributes:
        theta: unknowns, SI, shape (p,).
        residual: whitened model minus data with these nuisances, shape (N,).
        rates: whitened derivatives of the model with respect to the parameters, shape (N, p).
        columns: whitened derivatives of the model with respect to the nuisances, shape (N, m).
        nuisances: nuisances, shape (m,).
        prior_residual: deviations of the parameters from their priors in standard deviations, shape (q,).
        prior_rates: derivatives of `prior_residual`, shape (q, p).
        force: force of the model with offsets and zeros and without the mesh error, N, shape (N,).
    """

    theta: np.ndarray
    residual: np.ndarray
    rates: np.ndarray
    columns: np.ndarray
    nuisances: np.ndarray
    prior_residual: np.ndarray
    prior_rates: np.ndarray
    force: np.ndarray

    @property
    def penalised_sum_of_squares(self) -> float:
        """Minimised sum of squares: residuals, nuisances and prior residuals."""
        return float(self.residual @ self.residual + self.nuisances @ self.nuisances
                     + self.prior_residual @ self.prior_residual)

    @property
    def covariance_log_determinant(self) -> float:
        """Log determinant of the covariance of the whitened samples, log det(I + C C') with C = `columns`."""
        m = self.columns.shape[1]
        return float(np.linalg.slogdet(np.eye(m) + self.columns.T @ self.columns)[1])

    @property
    def projected_residual_and_jacobian(self) -> tuple[np.ndarray, np.ndarray]:
        """Residual, shape (M,), and Jacobian, shape (M, p), after elimination of the nuisances (variable projection).

        The derivative of the nuisances with respect to the parameters is -(I + C'C)^-1 C'J, J = `rates`, C = `columns`.

        Source: Kaufman, BIT 15 (1975) 49.
        """
        response = self._compute_compensating_nuisances(self.rates)
        return (np.concatenate([self.residual, self.nuisances, self.prior_residual]),
                np.concatenate([self.rates + self.columns @ response, response, self.prior_rates]))

    def _compute_compensating_nuisances(self, columns: np.ndarray) -> np.ndarray:
        """Return the change of the nuisances that compensates changes of the model, shape (m, ...).

        Args:
            columns: whitened changes of the model, shape (N, ...).
        """
        if not self.columns.shape[1]:
            return np.zeros((0, *columns.shape[1:]))
        factor = cho_factor(np.eye(self.columns.shape[1]) + self.columns.T @ self.columns)
        return -cho_solve(factor, self.columns.T @ columns)

    @property
    def full_residual_and_jacobian(self) -> tuple[np.ndarray, np.ndarray]:
        """Residual, shape (M,), and Jacobian, shape (M, p + m), with parameters and nuisances as unknowns."""
        p, m = self.rates.shape[1], self.columns.shape[1]
        rows = [np.hstack([self.rates, self.columns]), np.hstack([np.zeros((m, p)), np.eye(m)]),
                np.hstack([self.prior_rates, np.zeros((self.prior_rates.shape[0], m))])]
        return np.concatenate([self.residual, self.nuisances, self.prior_residual]), np.concatenate(rows)


@dataclass(frozen=True, eq=False)
class LeastSquaresProblem(ABC):
    """Least-squares problem of one law over all fitted tests; the k unknowns begin with the free parameters.

    A problem is immutable: `dataclasses.replace` and the methods ``with_...`` derive other problems. Forward models
    belong to one problem; a model with another mesh correction is a copy in another problem.

    Attributes:
        space: parameter space.
        tests: forward models of the fitted tests.
        solves: cache of simulations.
    """

    space: ParameterSpace
    tests: tuple[ForwardTest, ...]
    solves: SimulationCache
    #: The last evaluation; empty before the first one.
    _last: list[ProblemEvaluation] = field(default_factory=list, init=False, repr=False)

    @cached_property
    def places(self) -> list[tuple[int, int]]:
        """For each recording the index of its test and its index in the test."""
        return [(t, r) for t, test in enumerate(self.tests) for r in range(len(test.measured))]

    @property
    def measured(self) -> list[MeasuredCurve]:
        """Recordings of all tests, in the order of the rows of the residual."""
        return [self.tests[t].measured[r] for t, r in self.places]

    @cached_property
    def rows(self) -> list[slice]:
        """For each recording the slice of its samples."""
        ends = np.cumsum([0, *(curve.force.size for curve in self.measured)]).tolist()
        return list(map(slice, ends[:-1], ends[1:]))

    @property
    def samples(self) -> int:
        """Number of samples of all recordings, N."""
        return self.rows[-1].stop

    @cached_property
    def data(self) -> np.ndarray:
        """Measured force of all samples, N, shape (N,)."""
        return np.concatenate([curve.force for curve in self.measured])

    @cached_property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of the unknowns, shapes (k,)."""
        return self.space.low, self.space.high

    @cached_property
    def prior_mean(self) -> np.ndarray:
        """Means of the priors, shape (k,)."""
        return self.space.prior_mean

    @cached_property
    def prior_deviation(self) -> np.ndarray:
        """Standard deviations of the priors, shape (k,); inf without a prior."""
        return self.space.prior_deviation

    def with_simulation_cache(self, solves: SimulationCache) -> Self:
        """Return the same problem with another cache of simulations; the last evaluation remains valid."""
        other = replace(self, solves=solves)
        other._last.extend(self._last)
        return other

    def compute_unknown_scales(self, theta: np.ndarray) -> np.ndarray:
        """Return the scale of each unknown, SI, shape (k,)."""
        return self.space.compute_typical_parameter_sizes(self.space.get_values_by_name(theta))

    def make_scaled_or_long_term_variables(self, theta: np.ndarray) -> Variables:
        """Return the variables of a descent from `theta`: the unknowns in units of their scales there."""
        sizes, (low, high) = self.compute_unknown_scales(theta), self.bounds
        return SizeScaledVariables(sizes, (low / sizes, high / sizes))

    def evaluate(self, theta: np.ndarray) -> ProblemEvaluation:
        """Evaluate residuals and derivatives; the last evaluation is cached.

        Args:
            theta: unknowns, SI, shape (k,).

        Raises:
            InfeasibleError: the material is invalid, the solver does not converge, or the force is not finite.
        """
        theta = np.array(theta, dtype=float)
        if not self._last or not np.array_equal(self._last[0].theta, theta):
            residual, rates, columns, nuisances, force = self._compute_residual_rates_columns_and_force(theta)
            prior = np.flatnonzero(np.isfinite(self.prior_deviation))
            deviation = self.prior_deviation[prior]
            prior_rates = np.zeros((prior.size, theta.size))
            prior_rates[np.arange(prior.size), prior] = 1.0 / deviation
            self._last[:] = [ProblemEvaluation(theta, residual, rates, columns, nuisances,
                                               (theta[prior] - self.prior_mean[prior]) / deviation, prior_rates, force)]
        return self._last[0]

    @abstractmethod
    def _compute_residual_rates_columns_and_force(self, theta: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return residual, rates, columns, nuisances and force of a `ProblemEvaluation`."""

    def with_samples_up_to_displacement_fraction(self, fraction: float) -> LeastSquaresProblem:
        """Return the problem with the samples of each test up to a fraction of its largest displacement."""
        tests = []
        for test in self.tests:
            reach = fraction * max(float(np.abs(curve.displacement).max()) for curve in test.measured)
            kept = tuple(curve.select(np.flatnonzero(np.abs(curve.displacement) <= reach)) for curve in test.measured)
            tests.append(replace(test, measured=kept))
        return replace(self, tests=tuple(tests))

    @abstractmethod
    def make_problem_and_unknowns_without_test(self, number: int,
                                               theta: np.ndarray) -> tuple[LeastSquaresProblem, np.ndarray]:
        """Return the problem without one test, and its unknowns.

        Args:
            number: index of the test.
            theta: unknowns of this problem, SI, shape (k,).
        """


@dataclass(frozen=True, eq=False)
class GeneralisedProblem(LeastSquaresProblem):
    """Generalised least-squares problem on forces; contact offsets, zeros and mesh errors are eliminated as nuisances.

    Attributes:
        jitter: standard deviations of contact offset and zero.
        mesh_error: standard deviation of the mesh error of each test, relative to the force of the model. Tests with
            one mesh share one error.
    """

    jitter: ContactAndForceZeroJitter
    mesh_error: tuple[float, ...]

    @cached_property
    def kinds(self) -> list[str]:
        """Nuisances of each recording: contact and zero, without those that have no jitter."""
        return [name for name in ("contact", "zero") if getattr(self.jitter, name) > 0]

    @cached_property
    def offset_columns(self) -> list[slice]:
        """For each recording the slice of its contact offset and zero in the nuisances."""
        return [slice(i * len(self.kinds), (i + 1) * len(self.kinds)) for i in range(len(self.places))]

    @property
    def shared(self) -> list[slice]:
        """For each test the slice of its mesh error in the nuisances; empty without a mesh error."""
        return self._mesh_columns_and_nuisance_count[0]

    @property
    def nuisances(self) -> int:
        """Number of nuisances, m."""
        return self._mesh_columns_and_nuisance_count[1]

    @cached_property
    def _mesh_columns_and_nuisance_count(self) -> tuple[list[slice], int]:
        """The values of `shared` and `nuisances`."""
        shared, end = [], len(self.places) * len(self.kinds)
        meshes: dict[str, slice] = {}
        for test, size in zip(self.tests, self.mesh_error, strict=True):
            columns = meshes.get(test.mesh_key) or slice(end, end + MESH_MODES * (size > 0))
            if size > 0 and test.mesh_key:
                meshes[test.mesh_key] = columns
            end = max(end, columns.stop)
            shared.append(columns if size > 0 else slice(end, end))
        return shared, end

    def make_problem_and_unknowns_without_test(self, number: int,
                                               theta: np.ndarray) -> tuple[GeneralisedProblem, np.ndarray]:
        """Return the problem without one test, and its unknowns; see the method of `LeastSquaresProblem`."""
        kept = [i for i in range(len(self.tests)) if i != number]
        return GeneralisedProblem(self.space, tuple(self.tests[i] for i in kept), self.solves, self.jitter,
                                  tuple(self.mesh_error[i] for i in kept)), theta

    def _compute_residual_rates_columns_and_force(self, theta: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return whitened residuals (noise, jitter, mesh); see the method of `LeastSquaresProblem`."""
        try:
            self.space.build_material(self.space.get_values_by_name(theta))
        except InputError as error:
            raise InfeasibleError(str(error)) from None
        answers = [test.solve(self.space, theta, self.solves) for test in self.tests]
        nuisances, (residual, rates, columns, force) = self._solve_nuisances_and_linearise(answers)
        return residual, rates, columns, nuisances, force

    def linearise_without_nuisances(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return whitened residual, shape (N,), and rates, shape (N, p), with all nuisances zero.

        Raises:
            InfeasibleError: see `LeastSquaresProblem.evaluate`.
        """
        answers = [test.solve(self.space, theta, self.solves) for test in self.tests]
        return self._compute_whitened_terms_at_nuisances(answers, np.zeros(self.nuisances))[:2]

    def _solve_nuisances_and_linearise(self, answers: list) -> tuple[np.ndarray, tuple]:
        """Return the nuisances that minimise the sum of squares, shape (m,), and the linearised problem.

        Gauss-Newton with step halving. Each call begins with a scan, so that the sum of squares is a function of the
        parameters alone and does not depend on earlier calls.
        """
        trial, lowest, step = self._scan_contact_offsets(answers), np.inf, 1.0
        best, found, change = trial, (), trial
        for _ in range(_ELIMINATION.max_steps):
            linearised = self._compute_whitened_terms_at_nuisances(answers, trial)
            residual, columns = linearised[0], linearised[2]
            error = residual @ residual + trial @ trial
            if found and error > lowest:
                step *= 0.5
                trial = best + step * change
                continue
            best, lowest, found, step = trial, error, linearised, 1.0
            if not trial.size:
                break
            change = -cho_solve(cho_factor(np.eye(trial.size) + columns.T @ columns), columns.T @ residual + trial)
            if np.abs(change).max() < _ELIMINATION.tolerance:
                break
            trial = trial + change
        return best, found

    def _scan_contact_offsets(self, answers: list) -> np.ndarray:
        """Return starting values of the nuisances, shape (m,): the best trial contact offset of each recording.

        The sum of squares may have a local minimum for each sample that first contact passes, so Gauss-Newton from
        offset zero could end in a wrong one.
        """
        trial = np.zeros(self.nuisances)
        if "contact" not in self.kinds:
            return trial
        offsets = np.linspace(-_ELIMINATION.scan_range, _ELIMINATION.scan_range, _ELIMINATION.scan_points)
        for columns, (t, r) in zip(self.offset_columns, self.places, strict=True):
            test, measured = self.tests[t], self.tests[t].measured[r]
            if not hasattr(test, "compute_force_at_contact_offsets"):
                continue
            forces = test.compute_force_at_contact_offsets(answers[t], r, offsets * self.jitter.contact)
            gaps = forces - measured.force[:, None]
            white = whiten_force_changes(test, answers[t], r, np.column_stack(
                [gaps, np.full(measured.force.size, self.jitter.zero)]))
            gaps, zero = white[:, :-1], white[:, -1]
            # The zero enters linearly, so its best value for each offset has a closed form.
            zeros = -(zero @ gaps) / (1.0 + zero @ zero)
            squares = np.einsum("ng,ng->g", gaps, gaps) - (1.0 + zero @ zero) * zeros**2 + offsets**2
            best = int(np.argmin(squares))
            found = {"contact": offsets[best], "zero": zeros[best]}
            trial[columns] = [found[kind] for kind in self.kinds]
        return trial

    def _compute_whitened_terms_at_nuisances(self, answers: list, nuisances: np.ndarray):
        """Return whitened residual (N,), rates (N, p) and columns (N, m) at these nuisances, and the force, N, (N,)."""
        residual = np.empty(self.samples)
        rates = np.empty((self.samples, len(self.space.free)))
        columns = np.zeros((self.samples, self.nuisances))
        force = np.empty(self.samples)
        sizes = [getattr(self.jitter, name) for name in self.kinds]
        for rows, places, (t, r) in zip(self.rows, self.offset_columns, self.places, strict=True):
            test, measured = self.tests[t], self.tests[t].measured[r]
            values = dict(zip(self.kinds, nuisances[places] * sizes, strict=True))
            offset, farthest = values.get("contact", 0.0), _ELIMINATION.extrapolation * self.jitter.contact
            near = float(np.clip(offset, -farthest, farthest))
            model, model_rates, contact_rate = test.evaluate_force_and_derivatives(answers[t], r, near)
            if offset != near:
                # The derivatives are extrapolated too, so that they are those of the extrapolated force.
                close = _ELIMINATION.relative_step
                other = test.evaluate_force_and_derivatives(answers[t], r, (1 - close) * near)[1]
                model_rates = model_rates + (offset - near) * (model_rates - other) / (close * near)
                model = model + (offset - near) * contact_rate
            modes, weights = self._compute_mesh_error_modes_of_force(t, measured, model), nuisances[self.shared[t]]
            # A mesh error proportional to the force changes the derivatives by the same factor.
            factor = 1.0 + self._compute_mesh_error_modes_of_force(t, measured, np.ones_like(model)) @ weights
            zero = np.full_like(model, float(measured.has_zero))
            nuisance_columns = {"contact": factor * contact_rate, "zero": zero}
            force[rows] = model + values.get("zero", 0.0) * zero
            gap = force[rows] - measured.force + modes @ weights
            changes = np.column_stack([gap, factor[:, None] * model_rates, *(
                size * nuisance_columns[name] for name, size in zip(self.kinds, sizes, strict=True)), modes])
            white = whiten_force_changes(test, answers[t], r, changes, contact_rate)
            p = rates.shape[1]
            residual[rows], rates[rows] = white[:, 0], white[:, 1:p + 1]
            columns[rows, places] = white[:, p + 1:p + 1 + len(self.kinds)]
            columns[rows, self.shared[t]] = white[:, p + 1 + len(self.kinds):]
        if not np.isfinite(residual).all():
            raise InfeasibleError("the force of the model is not finite")
        return residual, rates, columns, force

    def _compute_mesh_error_modes_of_force(self, number: int, measured: MeasuredCurve, force: np.ndarray) -> np.ndarray:
        """Return the modes of the mesh error for one standard deviation each, N, shape (n, modes).

        The modes are proportional to the force of the model. Modes proportional to the measured force would bias all
        moduli low (Peelle's pertinent puzzle).

        Args:
            number: index of the test.
            measured: recording.
            force: force of the model, N, shape (n,).

        Source: D'Agostini, Nucl. Instrum. Methods A 346 (1994) 306.
        """
        if not self.mesh_error[number]:
            return np.zeros((force.size, 0))
        along = 2.0 * measured.displacement / np.abs(measured.displacement).max() - 1.0
        return self.mesh_error[number] * np.column_stack([force, along * force])

    def linearise_replicates(self, theta: np.ndarray) -> list[list[WhitenedReplicate]]:
        """Return the linearised replicates of each test for `calibration.statistics.jitter.estimate_jitter`.

        Args:
            theta: unknowns, SI, shape (p,).
        """
        answers = [test.solve(self.space, theta, self.solves) for test in self.tests]
        found: list[list[WhitenedReplicate]] = [[] for _ in self.tests]
        for t, r in self.places:
            measured = self.tests[t].measured[r]
            if not measured.has_zero:
                continue
            model, rates, contact = self.tests[t].evaluate_force_and_derivatives(answers[t], r, 0.0)
            changes = np.column_stack([model - measured.force, contact, np.ones_like(model), rates,
                                       self._compute_mesh_error_modes_of_force(t, measured, model)])
            white = whiten_force_changes(self.tests[t], answers[t], r, changes, contact)
            p = rates.shape[1]
            found[t].append(WhitenedReplicate(white[:, 0], white[:, 1], white[:, 2], white[:, 3:3 + p],
                                              white[:, 3 + p:]))
        return found


def build_generalised_problem(law: str, campaign: Campaign, measured: Mapping[str, Sequence[MeasuredCurve]],
                              solves: SimulationCache) -> GeneralisedProblem:
    """Return the least-squares problem of one law over all tests that are not held out.

    Args:
        law: name of the law.
        campaign: campaign.
        measured: test -> its recordings.
        solves: cache of simulations.
    """
    names = {test: [curve.name for curve in curves] for test, curves in measured.items()}
    space = ParameterSpace.from_campaign(law, campaign, names)
    fitted = [test for test in campaign.tests if not test.hold_out]
    jitter = make_stated_or_guessed_jitter(campaign, [curve for test in fitted for curve in measured[test.name]])
    tests = tuple(build_forward_test_of_inverse_fit(test, measured[test.name], campaign.fit, jitter.contact)
                  for test in fitted)
    space = space.with_ranges_of_data(find_largest_strain_of_data_or_none(tests))
    # With the error of the fast mesh in the covariance, offsets do not compensate for this error.
    return GeneralisedProblem(space, tests, solves, jitter,
                              tuple(compute_mesh_uncertainty(test, FAST_MESH_ERRORS) for test in tests))


def make_stated_or_guessed_jitter(campaign: Campaign, curves: Sequence[MeasuredCurve]) -> ContactAndForceZeroJitter:
    """Return one jitter for all tests: stated values, or first guesses of values that are estimated later."""
    fit, noise = campaign.fit, campaign.noise
    contact, zero, freedom = noise.contact_jitter, noise.zero_jitter, None
    curves = [curve for curve in curves if curve.has_zero]
    if not curves:
        return ContactAndForceZeroJitter(0.0, 0.0, None)
    largest = float(np.median([np.abs(curve.force).max() for curve in curves]))
    if fit.offset == "fit":
        noisiest = max(curve.noise.deviation for curve in curves)
        contact, zero = fit.offset_prior, fit.zero_prior or OFFSET_DEFAULTS.zero_prior * noisiest
    if not any(curve.has_contact_offset for curve in curves):
        contact = 0.0
    if contact is None:
        contact, freedom = compute_default_contact_offset_deviation(curves), 0
    if zero is None:
        zero, freedom = OFFSET_DEFAULTS.first_zero * largest, 0
    return ContactAndForceZeroJitter(contact, zero, freedom)
