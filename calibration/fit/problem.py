"""The least-squares problem: all tests at once, whitened, with what differs from recording to recording eliminated."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from calibration.campaign.measured import MeasuredCurve
from calibration.campaign.parameter_space import ParameterSpace
from calibration.fit.variables import Scaled, Variables
from calibration.forward.contract import ForwardTest, InfeasibleError
from calibration.forward.simulation_cache import SimulationCache
from calibration.statistics.jitter import Jitter, WhitenedReplicate
from calibration.statistics.sensor_noise import whiten
from tissue_sim.errors import InputError

#: Offsets are found by this many linear steps at most, to this share of their standard deviation; the force is almost
#: a straight line over their size.
_OFFSET_STEPS, _OFFSET_SETTLED = 10, 3e-4
#: Beyond so many standard deviations of the contact offset the force goes on straight: nothing was simulated there, and
#: from a start far from the minimum a curve would lead astray.
FARTHEST = 4.0
#: Relative distance of two offsets whose derivatives are compared.
_CLOSE = 1e-3
#: Offsets that are tried first: to so many standard deviations on either side, a quarter of one apart.
_SCANNED, _SCAN_POINTS = 3.0, 25
#: Smooth shapes of the error that the accurate mesh is left with: constant and linear along the way.
MESH_MODES = 2


@dataclass(frozen=True, eq=False)
class Evaluation:
    """All recordings at one set of parameters, with the nuisances that fit best there.

    Nuisances are in units of their standard deviation: contact offset and zero of each recording, then the modes of
    the error of each mesh, m in all. N samples, p parameters.

    Attributes:
        theta: shape (p,). residual: whitened model minus data at these nuisances, shape (N,).
        rates: whitened derivatives with the parameters, (N, p). columns: with the nuisances, (N, m).
        nuisances: shape (m,).
        prior_residual: of the parameters with a prior, shape (q,). prior_rates: (q, p).
        force: model in N at all samples, with offsets and zeros but without the modes of the mesh, shape (N,).
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
    def error(self) -> float:
        """Sum of squares that is minimised: samples, nuisances and priors."""
        return float(self.residual @ self.residual + self.nuisances @ self.nuisances
                     + self.prior_residual @ self.prior_residual)

    @property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of the covariance of the samples, less that of the noise alone."""
        m = self.columns.shape[1]
        return float(np.linalg.slogdet(np.eye(m) + self.columns.T @ self.columns)[1])

    @property
    def projected(self) -> tuple[np.ndarray, np.ndarray]:
        """Residual and Jacobian of the outer problem: nuisances follow the parameters, shapes (M,) and (M, p).

        Source: Kaufman, BIT 15 (1975) 49, variable projection with the simplified Jacobian.
        """
        follow = self._following(self.rates)
        return (np.concatenate([self.residual, self.nuisances, self.prior_residual]),
                np.concatenate([self.rates + self.columns @ follow, follow, self.prior_rates]))

    def _following(self, columns: np.ndarray) -> np.ndarray:
        """How the nuisances move to make up for a change of the model, shape (m, ...)."""
        if not self.columns.shape[1]:
            return np.zeros((0, *columns.shape[1:]))
        factor = cho_factor(np.eye(self.columns.shape[1]) + self.columns.T @ self.columns)
        return -cho_solve(factor, self.columns.T @ columns)

    @property
    def design(self) -> tuple[np.ndarray, np.ndarray]:
        """Residual and Jacobian of the problem with all unknowns, parameters first: shapes (M,) and (M, p + m)."""
        p, m = self.rates.shape[1], self.columns.shape[1]
        rows = [np.hstack([self.rates, self.columns]), np.hstack([np.zeros((m, p)), np.eye(m)]),
                np.hstack([self.prior_rates, np.zeros((self.prior_rates.shape[0], m))])]
        return np.concatenate([self.residual, self.nuisances, self.prior_residual]), np.concatenate(rows)


@dataclass(eq=False)
class LeastSquares(ABC):
    """All fitted tests of a campaign with one law, as residuals of unknowns: the free parameters, then others, if any.

    Attributes:
        space: parameters. tests: those that count. solves: what has been simulated.
        places: test and number of each recording. rows: of its samples. data: measured force, N, shape (N,).
        bounds: lowest and highest values of the unknowns, shapes (k,).
        prior_mean, prior_deviation: shapes (k,); deviation inf where there is no prior.
    """

    space: ParameterSpace
    tests: tuple[ForwardTest, ...]
    solves: SimulationCache
    _last: Evaluation | None = field(default=None, init=False, repr=False)

    def __post_init__(self):
        self.places = [(t, r) for t, test in enumerate(self.tests) for r in range(len(test.measured))]
        ends = np.cumsum([0, *(curve.force.size for curve in self.measured)]).tolist()
        self.rows = list(map(slice, ends[:-1], ends[1:]))
        self.samples = ends[-1]
        self.data = np.concatenate([curve.force for curve in self.measured])
        self.bounds = self.space.low, self.space.high
        self.prior_mean, self.prior_deviation = self.space.prior_mean, self.space.prior_deviation

    @property
    def measured(self) -> list[MeasuredCurve]:
        """The recordings, in the order of the rows."""
        return [self.tests[t].measured[r] for t, r in self.places]

    def sizes(self, theta: np.ndarray) -> np.ndarray:
        """How large a change of each unknown is a whole one, shape (k,)."""
        return self.space.sizes(self.space.values(theta))

    def variables(self, theta: np.ndarray) -> Variables:
        """What is varied from `theta` on: the unknowns in units of their sizes there."""
        sizes, (low, high) = self.sizes(theta), self.bounds
        return Scaled(sizes, (low / sizes, high / sizes))

    def evaluate(self, theta: np.ndarray) -> Evaluation:
        """Everything at these unknowns, shape (k,); the same ones again cost nothing.

        Raises:
            InfeasibleError: no such material, no convergence, or no finite force.
        """
        theta = np.array(theta, dtype=float)
        if self._last is None or not np.array_equal(self._last.theta, theta):
            residual, rates, columns, nuisances, force = self._weighted(theta)
            prior = np.flatnonzero(np.isfinite(self.prior_deviation))
            deviation = self.prior_deviation[prior]
            prior_rates = np.zeros((prior.size, theta.size))
            prior_rates[np.arange(prior.size), prior] = 1.0 / deviation
            self._last = Evaluation(theta, residual, rates, columns, nuisances,
                                    (theta[prior] - self.prior_mean[prior]) / deviation, prior_rates, force)
        return self._last

    @abstractmethod
    def _weighted(self, theta: np.ndarray) -> tuple[np.ndarray, ...]:
        """Residual, rates, columns, nuisances and force of an `Evaluation`."""

    def within(self, share: float) -> LeastSquares:
        """The problem with the first samples of each test, to a share of its largest displacement to either side."""
        def cut(curve: MeasuredCurve, reach: float) -> MeasuredCurve:
            kept = np.flatnonzero(np.abs(curve.displacement) <= reach)
            return replace(curve, displacement=curve.displacement[kept], force=curve.force[kept],
                           time=None if curve.time is None else curve.time[kept],
                           segment=None if curve.segment is None else curve.segment[kept],
                           interpolation=None if curve.interpolation is None else curve.interpolation[kept])

        tests = []
        for test in self.tests:
            reach = share * max(float(np.abs(curve.displacement).max()) for curve in test.measured)
            tests.append(replace(test, measured=tuple(cut(curve, reach) for curve in test.measured)))
        return replace(self, tests=tuple(tests))

    @abstractmethod
    def without(self, number: int, theta: np.ndarray) -> tuple[LeastSquares, np.ndarray]:
        """The problem without one of its tests, and those of the unknowns that it still has."""


@dataclass(eq=False)
class Problem(LeastSquares):
    """Generalised least squares, with what differs from recording to recording eliminated.

    Attributes:
        jitter: standard deviations of contact offset and zero.
        mesh_error: standard deviation of each test's mesh error, relative to the model's force. Tests on one mesh have
            one error.
    """

    jitter: Jitter
    mesh_error: tuple[float, ...]

    def __post_init__(self):
        super().__post_init__()
        self.forget()

    def forget(self) -> None:
        """Count the nuisance columns of each recording and each test again: corrections or jitter are others."""
        self._last, count = None, len(self.places)
        self.kinds = [name for name in ("contact", "zero") if getattr(self.jitter, name) > 0]
        self.offset_columns = [slice(i * len(self.kinds), (i + 1) * len(self.kinds)) for i in range(count)]
        self.shared, end = [], count * len(self.kinds)
        meshes: dict[str, slice] = {}
        for test, size in zip(self.tests, self.mesh_error, strict=True):
            columns = meshes.get(test.mesh) or slice(end, end + MESH_MODES * (size > 0))
            if size > 0 and test.mesh:
                meshes[test.mesh] = columns
            end = max(end, columns.stop)
            self.shared.append(columns if size > 0 else slice(end, end))
        self.nuisances = end

    def without(self, number: int, theta: np.ndarray) -> tuple[Problem, np.ndarray]:
        """As `LeastSquares.without`."""
        kept = [i for i in range(len(self.tests)) if i != number]
        return Problem(self.space, tuple(self.tests[i] for i in kept), self.solves, self.jitter,
                       tuple(self.mesh_error[i] for i in kept)), theta

    def _weighted(self, theta: np.ndarray) -> tuple[np.ndarray, ...]:
        try:
            self.space.material(self.space.values(theta))
        except InputError as error:
            raise InfeasibleError(str(error)) from None
        answers = [test.solve(self.space, theta, self.solves) for test in self.tests]
        nuisances, (residual, rates, columns, force) = self._best_nuisances(answers)
        return residual, rates, columns, nuisances, force

    def bare(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Whitened residual (N,) and rates (N, p) without any nuisance.

        Raises:
            InfeasibleError: as `evaluate`.
        """
        answers = [test.solve(self.space, theta, self.solves) for test in self.tests]
        return self._linearise(answers, np.zeros(self.nuisances))[:2]

    def _best_nuisances(self, answers: list) -> tuple[np.ndarray, tuple]:
        """The nuisances that fit best, shape (m,), and the problem linearised there.

        From a scan each time, so that the sum of squares is a function of the parameters alone.
        """
        trial, reach, share = self._scanned(answers), np.inf, 1.0
        best, found, change = trial, (), trial
        for _ in range(_OFFSET_STEPS):
            linearised = self._linearise(answers, trial)
            residual, columns = linearised[0], linearised[2]
            error = residual @ residual + trial @ trial
            if found and error > reach:
                share *= 0.5
                trial = best + share * change
                continue
            best, reach, found, share = trial, error, linearised, 1.0
            if not trial.size:
                break
            change = -cho_solve(cho_factor(np.eye(trial.size) + columns.T @ columns), columns.T @ residual + trial)
            if np.abs(change).max() < _OFFSET_SETTLED:
                break
            trial = trial + change
        return best, found

    def _scanned(self, answers: list) -> np.ndarray:
        """Nuisances to begin with, shape (m,): the best contact offset of each recording on a grid, and its zero.

        Each sample that the touch passes may make a minimum of its own, in which a descent from zero would stop.
        """
        trial = np.zeros(self.nuisances)
        if "contact" not in self.kinds:
            return trial
        places = np.linspace(-_SCANNED, _SCANNED, _SCAN_POINTS)
        for columns, (t, r) in zip(self.offset_columns, self.places, strict=True):
            test, measured = self.tests[t], self.tests[t].measured[r]
            if not hasattr(test, "scan"):
                continue
            gaps = test.forces_at_offsets(answers[t], r, places * self.jitter.contact) - measured.force[:, None]
            white = whiten(np.column_stack([gaps, np.full(measured.force.size, self.jitter.zero)]), measured.time,
                           measured.noise)
            gaps, zero = white[:, :-1], white[:, -1]
            # The zero that goes best with each offset is linear.
            zeros = -(zero @ gaps) / (1.0 + zero @ zero)
            squares = np.einsum("ng,ng->g", gaps, gaps) - (1.0 + zero @ zero) * zeros**2 + places**2
            best = int(np.argmin(squares))
            found = {"contact": places[best], "zero": zeros[best]}
            trial[columns] = [found[kind] for kind in self.kinds]
        return trial

    def _linearise(self, answers: list, nuisances: np.ndarray):
        """Whitened residual (N,), rates (N, p) and columns (N, m) at these nuisances, and force in N (N,)."""
        residual = np.empty(self.samples)
        rates = np.empty((self.samples, len(self.space.free)))
        columns = np.zeros((self.samples, self.nuisances))
        force = np.empty(self.samples)
        sizes = [getattr(self.jitter, name) for name in self.kinds]
        for rows, places, (t, r) in zip(self.rows, self.offset_columns, self.places, strict=True):
            test, measured = self.tests[t], self.tests[t].measured[r]
            values = dict(zip(self.kinds, nuisances[places] * sizes, strict=True))
            offset, farthest = values.get("contact", 0.0), FARTHEST * self.jitter.contact
            near = float(np.clip(offset, -farthest, farthest))
            model, model_rates, contact_rate = test.evaluate(answers[t], r, near)
            if offset != near:
                # The derivatives go on straight too, or they would not be those of the force.
                other = test.evaluate(answers[t], r, (1 - _CLOSE) * near)[1]
                model_rates = model_rates + (offset - near) * (model_rates - other) / (_CLOSE * near)
                model = model + (offset - near) * contact_rate
            modes, weights = self._mesh_columns(t, measured, model), nuisances[self.shared[t]]
            # An error in proportion to the force changes its derivatives too.
            factor = 1.0 + self._mesh_columns(t, measured, np.ones_like(model)) @ weights
            nuisance_columns = {"contact": factor * contact_rate, "zero": np.ones_like(model)}
            force[rows] = model + values.get("zero", 0.0)
            gap = force[rows] - measured.force + modes @ weights
            white = whiten(np.column_stack([gap, factor[:, None] * model_rates, *(
                size * nuisance_columns[name] for name, size in zip(self.kinds, sizes, strict=True)), modes]),
                measured.time, measured.noise)
            p = rates.shape[1]
            residual[rows], rates[rows] = white[:, 0], white[:, 1:p + 1]
            columns[rows, places] = white[:, p + 1:p + 1 + len(self.kinds)]
            columns[rows, self.shared[t]] = white[:, p + 1 + len(self.kinds):]
        if not np.isfinite(residual).all():
            raise InfeasibleError("the model gives a force that is not a number")
        return residual, rates, columns, force

    def _mesh_columns(self, number: int, measured: MeasuredCurve, force: np.ndarray) -> np.ndarray:
        """Modes of the mesh error, N, each of one standard deviation, shape (n, modes).

        Of the model's force: as a share of the measured one an error would shrink the noise with the force, and pull
        all moduli down by the number of samples times the variance of the error.

        Args:
            number: of the test. measured: the recording. force: of the model, N, shape (n,).

        Source: D'Agostini, Nucl. Instrum. Methods A 346 (1994) 306.
        """
        if not self.mesh_error[number]:
            return np.zeros((force.size, 0))
        along = 2.0 * measured.displacement / np.abs(measured.displacement).max() - 1.0
        return self.mesh_error[number] * np.column_stack([force, along * force])

    def replicates(self, theta: np.ndarray) -> list[list[WhitenedReplicate]]:
        """What `calibration.statistics.jitter` needs of each test, at these parameters, shape (p,)."""
        answers = [test.solve(self.space, theta, self.solves) for test in self.tests]
        found: list[list[WhitenedReplicate]] = [[] for _ in self.tests]
        for t, r in self.places:
            measured = self.tests[t].measured[r]
            model, rates, contact = self.tests[t].evaluate(answers[t], r, 0.0)
            white = whiten(np.column_stack([model - measured.force, contact, np.ones_like(model), rates,
                                            self._mesh_columns(t, measured, model)]), measured.time, measured.noise)
            p = rates.shape[1]
            found[t].append(WhitenedReplicate(white[:, 0], white[:, 1], white[:, 2], white[:, 3:3 + p],
                                              white[:, 3 + p:]))
        return found
