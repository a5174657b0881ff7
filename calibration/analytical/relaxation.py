"""Relaxation from measured histories: a law and a Prony series fitted together, or a Prony series to a hold alone.

The model is the closed form of `tissue_sim.closed_form.histories`. It is linear in the moduli and, for given relaxation
times, in the shares that relax: non-negative least squares over a grid of times starts the nonlinear fit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares, nnls

from calibration.analytical.relaxation_model import HoldModel, LawModel
from calibration.statistics.statistics import r_squared, uncertainty
from tissue_sim.errors import ConvergenceError, InputError
from tissue_sim.laws import Law, find_law
from tissue_sim.material.material import Bulk, Material
from tissue_sim.material.viscoelasticity import MOST_TERMS, Prony, PronyTerm
from tissue_sim.recording.recording import Recording

#: Grid of relaxation times per decade that the starts are chosen from, and how many candidates are refined.
TIMES_PER_DECADE, MAX_STARTS = 3, 3
#: How far beyond the shortest step and the length of the record a relaxation time may run.
TIME_MARGIN = 10.0
#: Each g over what never relaxes is at most this; a term with less than the smallest is not used.
LARGEST_SHARE, SMALLEST_SHARE = 1e3, 1e-6
EVALUATIONS, TOLERANCE = 100, 1e-9
#: Residuals whose neighbours correlate more than this are a model error, not noise.
CORRELATED = 0.5


@dataclass(frozen=True, eq=False)
class RelaxationFit:
    """A Prony series with what it was fitted together with; moduli are instantaneous.

    Attributes:
        law: name of the law; None where only a hold of force was fitted.
        parameters: of the law in SI, or ``force`` (``nominal stress``): that of a sudden test to the same depth, N.
        prony: the series, shortest time first; None where nothing relaxes.
        names: parameters, then paths such as ``viscoelastic.terms[0].tau``: the order of the covariance.
        covariance: SI, shape (k, k). Infinite standard errors: `not_identifiable`.
        not_identifiable: names that the data do not determine.
        residual: model minus data, Pa (N), shape (n,).
        RMSE, R2: of all samples, Pa (N).
        AIC, BIC: n ln(RMSE^2) + 2 k, and + k ln n: smaller is better. They take neighbours as independent.
        correlation: of neighbouring residuals; 0 for noise, 1 for a smooth model error.
        status: ``"converged"``, ``"not_identifiable"``, ``"bound"`` or ``"not_converged"``.
        message: what to know of it, in words.
    """

    law: str | None
    parameters: Mapping[str, float]
    prony: Prony | None
    names: tuple[str, ...]
    covariance: np.ndarray
    not_identifiable: tuple[str, ...]
    residual: np.ndarray
    RMSE: float
    R2: float
    AIC: float
    BIC: float
    correlation: float
    status: str
    message: str

    @property
    def standard_errors(self) -> dict[str, float]:
        """Name -> standard error, SI; without those that the data do not determine."""
        errors = dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))
        return {name: error for name, error in errors.items() if name not in self.not_identifiable}

    def material(self, bulk: Bulk | None = None, **options) -> Material:
        """The material of the fit; `options` as `Material`'s.

        Raises:
            InputError: a hold of force alone was fitted.
        """
        if self.law is None:
            raise InputError("a hold of force gives no moduli; put its prony series beside a law: "
                             "Material(law, parameters, viscoelastic=fit.prony)", field="law")
        return Material(self.law, self.parameters, Bulk() if bulk is None else bulk, viscoelastic=self.prony, **options)


def fit_prony(recordings: Recording | Sequence[Recording], law: Law | str, terms: int = 1) -> RelaxationFit:
    """Fit a law and a Prony series together to homogeneous tests.

    Args:
        recordings: one or several with ``time``, ``nominal stress``, and ``stretch`` or ``shear strain``; all of it is
            fitted, ramps, holds and returns, unweighted.
        law: a law or its name.
        terms: 1 to 4.

    Raises:
        InputError: a channel missing, too few samples, or too many terms.
        ConvergenceError: no start gives a finite stress.

    Source: variable projection as a start, O'Leary and Rust, Comput. Optim. Appl. 54 (2013) 579; trust region
    reflective least squares.
    """
    law = find_law(law) if isinstance(law, str) else law
    recordings = [recordings] if isinstance(recordings, Recording) else list(recordings)
    return _fit(LawModel(law, recordings), terms)


def fit_hold(recording: Recording, terms: int = 1, ramp: float = 0.0) -> RelaxationFit:
    """Fit a Prony series to the force of a hold: g and tau only, for tools without a closed form.

    At constant depth the force of a linear solid is proportional to its relaxation modulus, whatever the tool (Lee and
    Radok, J. Appl. Mech. 27 (1960) 438): a spherical tip and shallow depth, as in atomic force microscopy, or small
    strain.

    Args:
        recording: ``time`` and ``force`` (or ``nominal stress``) of the hold, from its first sample on.
        terms: 1 to 4.
        ramp: how long the loading before it took, s; the elastic force is taken as linear in time within it.

    Raises:
        InputError: a channel missing, a displacement that moves more than 5 % of itself, too few samples.
    """
    return _fit(HoldModel(recording, ramp), terms)


def compare_terms(recordings: Recording | Sequence[Recording], law: Law | str,
                  most: int = MOST_TERMS) -> tuple[RelaxationFit, ...]:
    """`fit_prony` with 1 to `most` terms, smallest BIC first."""
    law = find_law(law) if isinstance(law, str) else law
    recordings = [recordings] if isinstance(recordings, Recording) else list(recordings)
    model = LawModel(law, recordings)
    fits, start = [], ()
    for terms in range(1, most + 1):
        fits.append(_fit(model, terms, start))
        start = () if fits[-1].prony is None else fits[-1].prony.tau
    return tuple(sorted(fits, key=lambda fit: fit.BIC))


def _fit(model: LawModel | HoldModel, terms: int, known: Sequence[float] = ()) -> RelaxationFit:
    if not 1 <= terms <= MOST_TERMS:
        raise InputError(f"{terms} terms; give 1 to {MOST_TERMS}", field="terms")
    m, unknowns = len(model.names), len(model.names) + 2 * terms
    if model.data.size <= unknowns:
        raise InputError(f"{model.data.size} samples cannot determine {unknowns} unknowns; give more samples or fewer "
                         "terms", field="recordings")
    shortest, longest = model.time_range
    window = np.log([shortest / TIME_MARGIN, longest * TIME_MARGIN])
    low = np.concatenate([np.where(model.moduli, -np.inf, -50.0), np.zeros(terms), np.full(terms, window[0])])
    high = np.concatenate([np.where(model.moduli, np.inf, 50.0), np.full(terms, LARGEST_SHARE),
                           np.full(terms, window[1])])
    scale = float(np.sqrt(np.mean(model.data**2))) or 1.0

    def predicted(u: np.ndarray) -> np.ndarray:
        elastic, relaxing = model.parts(u[:m], np.exp(u[m + terms:]))
        return elastic + relaxing @ u[m:m + terms]

    best = None
    for start in _starts(model, terms, shortest, longest, known):
        u = np.clip(start, low + 1e-9 * np.isfinite(low), high)
        if not np.isfinite(predicted(u)).all():
            continue
        result = least_squares(lambda u: (predicted(u) - model.data) / scale, u, bounds=(low, high), x_scale="jac",
                               ftol=TOLERANCE, xtol=TOLERANCE, gtol=TOLERANCE, max_nfev=EVALUATIONS)
        if best is None or result.cost < best.cost:
            best = result
    if best is None:
        raise ConvergenceError("no start gives a finite stress over the data; check the units of stress and strain")
    return _told(model, terms, best, scale, (low, high))


def _starts(model, terms: int, shortest: float, longest: float, known: Sequence[float]) -> list[np.ndarray]:
    """(Long-term parameters, g over what never relaxes, log tau), best first."""
    count = int(np.clip(TIMES_PER_DECADE * np.log10(longest / shortest), terms + 1, 16))
    grid = np.geomspace(shortest, longest, count)
    found = []
    for exponents in model.exponents():
        values, shares = exponents, np.zeros(count)
        for _ in range(3):
            # In turn: the moduli for these shares, the shares for these moduli.
            values = model.moduli_by_least_squares(values, grid, shares)
            if not np.isfinite(values).all():
                break
            elastic, relaxing = model.parts(values, grid)
            columns = np.column_stack([elastic, relaxing])
            if not np.isfinite(columns).all():
                break
            weights, misfit = nnls(columns, model.data)
            if not weights.any():
                break
            rest = max(weights[0], 1e-2 * weights.sum())
            values, shares = np.where(model.moduli, rest * values, values), weights[1:] / rest
        else:
            found.append((misfit, values, shares))
    found.sort(key=lambda item: item[0])
    starts = []
    for _, values, shares in found[:MAX_STARTS]:
        candidates = [_clusters(grid, shares, terms), _even(grid, shares, terms)]
        if len(known) == terms - 1:
            candidates.append(_filled(np.log(known), np.full(len(known), shares.sum() / terms), grid, terms))
        starts += [np.concatenate([values, r, log_tau]) for r, log_tau in candidates]
    return starts


def _clusters(grid, shares, terms) -> tuple[np.ndarray, np.ndarray]:
    """Neighbours on the grid of times that carry something, each group as one term; the largest `terms` of them."""
    active = np.flatnonzero(shares > 0)
    groups = np.split(active, np.flatnonzero(np.diff(active) > 1) + 1) if active.size else []
    groups = sorted(groups, key=lambda group: -shares[group].sum())[:terms]
    r = np.array([shares[group].sum() for group in groups])
    log_tau = np.array([np.average(np.log(grid[group]), weights=shares[group]) for group in groups])
    return _filled(log_tau, r, grid, terms)


def _even(grid, shares, terms) -> tuple[np.ndarray, np.ndarray]:
    """Times evenly over the window, with the shares of the grid around them."""
    nearest = np.arange(grid.size) * terms // grid.size
    log_tau = np.array([np.log(grid[nearest == i]).mean() for i in range(terms)])
    return np.array([max(shares[nearest == i].sum(), 1e-2) for i in range(terms)]), log_tau


def _filled(log_tau, r, grid, terms) -> tuple[np.ndarray, np.ndarray]:
    """More times, each in the middle of the largest gap."""
    log_tau, r = np.array(log_tau, dtype=float), np.array(r, dtype=float)
    while log_tau.size < terms:
        edges = np.sort(np.concatenate([np.log(grid[[0, -1]]), log_tau]))
        widest = int(np.argmax(np.diff(edges)))
        log_tau, r = np.append(log_tau, edges[widest:widest + 2].mean()), np.append(r, 1e-2)
    return r, log_tau


def _told(model, terms: int, best, scale: float, bounds) -> RelaxationFit:
    """The fit in instantaneous moduli, with what to know of it."""
    m = len(model.names)
    residual = scale * best.fun
    shares, log_tau = best.x[m:m + terms], best.x[m + terms:]
    order = np.argsort(log_tau)
    order = order[shares[order] > SMALLEST_SHARE]
    used = np.concatenate([np.arange(m), m + order, m + terms + order])
    u, k = best.x[used], used.size
    names = (*model.names, *(f"viscoelastic.terms[{i}].{key}" for i in range(order.size) for key in ("g", "tau")))
    final, slope = _instantaneous(u, model.moduli, order.size)
    n, squares = residual.size, float(residual @ residual)
    correlation = model.neighbour_correlation(residual)
    # A smooth model error repeats itself: fewer samples than there are tell anything new (Bayley and Hammersley 1946).
    repeats = (1.0 + max(correlation, 0.0)) / (1.0 - min(correlation, 0.999))
    noise = np.sqrt(squares / (n - k)) * np.sqrt(repeats) or np.finfo(float).tiny
    low, high = bounds[0][used], bounds[1][used]
    near = np.where(np.isfinite(high - low), 1e-4 * (high - low), 0.0)
    # A share of zero is a term that is not used, not a bound in the way.
    bound = (high - u <= near) | ((u - low <= near) & (low != 0.0))
    jacobian = scale * best.jac[:, used]
    spread = uncertainty(jacobian[:, ~bound], residual, model.index, noise, np.zeros((~bound).sum()))
    covariance, loose = np.zeros((k, k)), bound.copy()
    covariance[np.ix_(~bound, ~bound)] = spread.covariance
    loose[~bound] |= spread.singular
    covariance = slope @ covariance @ slope.T
    errors = np.sqrt(np.clip(np.diag(covariance), 0.0, None))
    mixed = (np.abs(slope) > 0) @ loose | (errors > np.abs(final))
    found = tuple(PronyTerm(float(g), float(tau)) for g, tau in final[m:].reshape(-1, 2))
    loose = tuple(name for name, lost in zip(names, mixed, strict=True) if lost)
    status, message = _verdict(model, best, found, terms, tuple(np.array(_unsorted(names, m))[bound]), loose,
                               correlation)
    parameters = dict(zip(model.names, final[:m].tolist(), strict=True))
    rmse = float(np.sqrt(squares / n))
    criterion = n * np.log(max(squares / n, np.finfo(float).tiny))
    return RelaxationFit(model.law_name, parameters, Prony(found) if found else None, names, covariance, loose,
                         residual, rmse, r_squared(model.data, residual), criterion + 2 * k,
                         criterion + k * np.log(n), correlation, status, message)


def _unsorted(names: tuple[str, ...], m: int) -> list[str]:
    """Names in the order of the optimiser's unknowns: all g after one another, then all tau."""
    return [*names[:m], *names[m::2], *names[m + 1::2]]


def _instantaneous(u: np.ndarray, moduli: np.ndarray, terms: int) -> tuple[np.ndarray, np.ndarray]:
    """(Instantaneous parameters, g and tau of each term) and their derivatives with respect to the unknowns."""
    m = moduli.size
    r, tau = u[m:m + terms], np.exp(u[m + terms:])
    factor = 1.0 + r.sum()
    final, slope = np.empty(m + 2 * terms), np.zeros((m + 2 * terms, m + 2 * terms))
    final[:m] = np.where(moduli, factor * u[:m], u[:m])
    slope[np.arange(m), np.arange(m)] = np.where(moduli, factor, 1.0)
    slope[:m, m:m + terms] = np.where(moduli, u[:m], 0.0)[:, None]
    for i in range(terms):
        final[m + 2 * i], final[m + 2 * i + 1] = r[i] / factor, tau[i]
        slope[m + 2 * i, m:m + terms] = -r[i] / factor**2
        slope[m + 2 * i, m + i] += 1.0 / factor
        slope[m + 2 * i + 1, m + terms + i] = tau[i]
    return final, slope


def _verdict(model, best, found: Sequence[PronyTerm], terms: int, bound, loose, correlation: float) -> tuple[str, str]:
    shortest, longest = model.time_range
    notes = []
    if len(found) < terms:
        notes.append(f"{terms - len(found)} of {terms} terms carry nothing and were left out")
    notes += [f"tau {term.tau:.3g} s is {'shorter than the steps' if term.tau < shortest else 'longer than the record'}"
              f" ({shortest:.3g} to {longest:.3g} s)" for term in found if not shortest <= term.tau <= longest]
    if loose:
        notes.append(f"the data do not determine {', '.join(loose)}")
    if correlation > CORRELATED:
        notes.append(f"the residuals are smooth (neighbours correlate by {correlation:.2f}): they are a model error, "
                     "not noise, and the criteria favour too many terms")
    if best.status <= 0:
        return "not_converged", "; ".join([f"stopped after {best.nfev} evaluations", *notes])
    if bound:
        return "bound", "; ".join([f"{', '.join(bound)} ended on a bound", *notes])
    return "not_identifiable" if loose else "converged", "; ".join(notes) or "converged"
