"""Identifiability: undetermined parameters, weakly determined directions, and further tests that determine them.

The determination of the shear modulus by the tests, and its dependence on bounds that were not stated, decides about a
fit, since one parameter of a law may be undetermined where the modulus is known: C20 on the data of a neo-Hookean
solid, or C10 and C01 in simple shear, where their sum acts.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np

from calibration.campaign.parameter_space import ParameterSpace
from calibration.campaign.tables import ROUND_SOLVER, SPACE_SOLVER
from calibration.fit.estimate import Estimate
from calibration.fit.fit import SuggestedTest, WeakDirection
from calibration.fit.problem import GeneralisedProblem
from calibration.forward.contract import ForwardTest
from calibration.forward.meshes import get_solver_fit_resolutions
from calibration.forward.motion import compute_force_derivative_by_offset
from calibration.forward.simulated import SimulatedTest
from calibration.statistics.uncertainty import COVARIANCE, ParameterUncertainty
from tissue_sim.differentiation import sensitivities
from tissue_sim.errors import ConvergenceError, InputError
from tissue_sim.experiment.experiment import Experiment
from tissue_sim.experiment.protocol import STUDY_SPEED, Protocol
from tissue_sim.experiment.tools.shapes import Flat, Plate
from tissue_sim.model import Model
from tissue_sim.specimen.cylinder import Cylinder


@dataclass(frozen=True)
class ModulusPrecisionSettings:
    """Limits of the clauses `determined` and `bounds`.

    Attributes:
        relative_error: largest standard error of the shear modulus, relative to it: the 95 % interval then reaches from
            half the value to 1.5 times it.
        change: largest relative change of the shear modulus by the release of a bound that was not stated.
        significance: least decrease of the sum of squares by that release, in units of the variance of the residuals:
            the 95 % quantile of chi-square with one degree of freedom.
        relative_step: step of central differences of the shear modulus, relative to the size of a parameter.
        rounding: relative change of the modulus along a direction without information up to which the change counts as
            rounding.
    """

    relative_error: float = 0.25
    change: float = 0.05
    significance: float = 3.84
    relative_step: float = 1e-6
    rounding: float = 1e-6


PRECISION = ModulusPrecisionSettings()


@dataclass(frozen=True)
class ShearModulusPrecision:
    """Precision of the shear modulus mu0 (the instantaneous one, if the material has a memory).

    Attributes:
        relative_error: standard error of mu0 divided by mu0, with parameters on bounds fixed; inf if the samples
            contain no information on mu0.
        held: names of the parameters on bounds that were not stated, if mu0 depends on these bounds.
        change: relative change of mu0 in the first Newton step without these bounds.
    """

    relative_error: float
    held: tuple[str, ...] = ()
    change: float = 0.0

    @property
    def is_precise_enough(self) -> bool:
        """Whether the standard error of mu0 is within the limit."""
        return self.relative_error <= PRECISION.relative_error


def assess_modulus_error_and_bound_dependence(estimate: Estimate, spread: ParameterUncertainty,
                                              modulus: Callable[[np.ndarray], float],
                                              stated: Collection[str]) -> ShearModulusPrecision:
    """Compute the standard error of the shear modulus, and its dependence on bounds.

    Args:
        estimate: minimum of the sum of squares.
        spread: uncertainty of the estimate.
        modulus: shear modulus, Pa, of the free parameters, shape (p,).
        stated: names of the parameters whose bounds the campaign states; these bounds count as known.
    """
    space = estimate.problem.space
    count = len(space.free)
    theta = estimate.theta[:count]
    sizes = space.compute_typical_parameter_sizes(space.get_values_by_name(theta))
    slope = np.zeros(estimate.theta.size)
    slope[:count] = _differentiate_shear_modulus(modulus, theta, sizes) / abs(modulus(theta))
    residual, jacobian = estimate.evaluation.projected_residual_and_jacobian
    slope = slope[: jacobian.shape[1]]
    held = spread.on_bound[: jacobian.shape[1]]
    _, flat = _solve_step_and_undetermined_modulus_change(jacobian[:, ~held], np.zeros(residual.size), slope[~held])
    variance = float(slope[:count] @ spread.covariance[:count, :count] @ slope[:count])
    error = np.inf if flat > PRECISION.rounding else float(np.sqrt(max(variance, 0.0)))
    suspects = [i for i in range(count) if held[i] and space.free[i] not in stated]
    if not suspects:
        return ShearModulusPrecision(error)
    released = ~held
    released[suspects] = True
    columns = jacobian[:, released]
    step, flat = _solve_step_and_undetermined_modulus_change(columns, residual, slope[released])
    change = float("inf") if flat > PRECISION.rounding else float(slope[released] @ step)
    decrease = float(residual @ residual - np.sum((residual + columns @ step)**2))
    depends = abs(change) > PRECISION.change and decrease > PRECISION.significance * max(spread.ratio, 1.0)**2
    return ShearModulusPrecision(error, tuple(space.free[i] for i in suspects) if depends else (), change)


def _differentiate_shear_modulus(modulus: Callable[[np.ndarray], float], theta: np.ndarray,
                                 sizes: np.ndarray) -> np.ndarray:
    """Return the gradient of the modulus with respect to the parameters by central differences, shape (p,)."""
    steps = np.diag(PRECISION.relative_step * sizes)
    return np.array([(modulus(theta + step) - modulus(theta - step)) / (2.0 * step.max()) for step in steps])


def _solve_step_and_undetermined_modulus_change(jacobian: np.ndarray, residual: np.ndarray,
                                                slope: np.ndarray) -> tuple[np.ndarray, float]:
    """Solve the linearised least-squares problem.

    Args:
        jacobian: derivatives of the residual with respect to the parameters, shape (n, p).
        residual: residual, shape (n,).
        slope: relative derivative of the modulus with respect to the parameters, shape (p,).

    Returns:
        Gauss-Newton step, shape (p,), and the largest relative change of the modulus along a direction without
        information, for a change of each parameter in inverse proportion to the norm of its column.
    """
    norms = np.linalg.norm(jacobian, axis=0)
    scale = np.where(norms > 0, norms, 1.0)
    if not jacobian.shape[1]:
        return np.zeros(0), 0.0
    _, values, rows = np.linalg.svd(jacobian / scale, full_matrices=False)
    known = values**2 > values.max(initial=0.0)**2 / COVARIANCE.singular_condition
    root = rows[known] / values[known, None]
    step = -(root.T @ (root @ ((jacobian / scale).T @ residual))) / scale
    flat = np.abs(rows[~known] @ (slope / scale)) / max(np.linalg.norm(slope / scale), 1e-300)
    return step, float(flat.max(initial=0.0))


#: Relative standard error above which a direction counts as weakly determined.
WEAK = 0.2


@dataclass(frozen=True)
class SuggestedTestSettings:
    """Assumptions on further tests.

    Attributes:
        samples: samples per recording.
        replicates: recordings per test.
        points: points of the simulation.
        hold: duration of a hold, s.
        strain: largest nominal strain.
        depth_factor: factor of the strain of deeper tests.
        needle_fraction: radius of the needle relative to the radius of the specimen.
        max_suggestions: largest number of suggestions.
        noise: noise of the sensor for campaigns that recorded stress, N: that of the reference study.
        jitter: jitter of contact, m, and zero, N, for such campaigns.
    """

    samples: int = 400
    replicates: int = 3
    points: int = 11
    hold: float = 60.0
    strain: float = 0.14
    depth_factor: float = 1.6
    needle_fraction: float = 0.2
    max_suggestions: int = 3
    noise: float = 0.02
    jitter: tuple[float, float] = (0.03e-3, 0.01)


_SUGGESTIONS = SuggestedTestSettings()
#: Specimen of the reference study, for campaigns without specimens.
_SPECIMEN = Cylinder(0.040, 0.070)


def compute_information_condition_or_none(spread: ParameterUncertainty) -> float | None:
    """Return the condition number of the scaled Fisher information; None if it is singular."""
    free = ~spread.on_bound
    if not free.any():
        return None
    values = np.linalg.eigvalsh(spread.information[np.ix_(free, free)])
    return float(values[-1] / values[0]) if values[0] > 0 else None


def find_weak_directions(space: ParameterSpace, spread: ParameterUncertainty) -> list[WeakDirection]:
    """Return the eigenvectors of the scaled information with a relative standard error above `WEAK`, worst first."""
    free = np.flatnonzero(~spread.on_bound)
    values, vectors = np.linalg.eigh(spread.information[np.ix_(free, free)])
    found = []
    for value, vector in zip(values, vectors.T, strict=True):
        error = float(np.sqrt(spread.inflation / value)) if value > 0 else 1e9
        if error <= WEAK:
            break
        vector = vector * np.sign(vector[np.argmax(np.abs(vector))])
        found.append(WeakDirection(shares={space.free[i]: float(share) for i, share in zip(free, vector, strict=True)},
                                   relative_error=min(error, 1e9)))
    return found


def find_undetermined_parameters(space: ParameterSpace, spread: ParameterUncertainty) -> list[str]:
    """Return the names of parameters whose standard error exceeds their size."""
    return [name for name, error, size in zip(space.free, spread.standard_errors, spread.sizes, strict=False)
            if not error <= size and not np.isnan(error)]


def suggest_further_tests(problem: GeneralisedProblem, theta: np.ndarray,
                          spread: ParameterUncertainty) -> list[SuggestedTest]:
    """Suggest further tests that determine the weakest direction better, best first.

    Each test is simulated once on the specimen of the weakest direction. Its information is that of
    `SuggestedTestSettings.replicates` recordings with the noise and jitter of the campaign.

    Args:
        problem: problem of the fit.
        theta: free parameters at the minimum, SI, shape (p,).
        spread: uncertainty at the minimum.
    """
    free = np.flatnonzero(~spread.on_bound)
    rated = []
    information = spread.information[np.ix_(free, free)] / spread.inflation
    axis = np.linalg.eigh(information)[1][:, 0]
    mechanical = [curve.noise.deviation for curve in problem.measured if not curve.test.states_stress]
    noise, jitter = (_SUGGESTIONS.noise, _SUGGESTIONS.jitter) if not mechanical else (
        float(np.median(mechanical)), (problem.jitter.contact, problem.jitter.zero))
    about = problem.space.free_parameters[free[np.argmax(np.abs(axis))]]
    acting = [test for test in problem.tests if about.applies_to_recording(test.name, None)] or list(problem.tests)
    of = next((test for test in acting if not test.measured[0].test.states_stress), acting[0])
    for words, experiment in _build_candidate_tests(problem, theta, of):
        gained = _compute_scaled_test_information_or_none(problem, theta, experiment, of.name, spread, noise, jitter)
        if gained is None:
            continue
        together = information + gained[np.ix_(free, free)]
        covariance = np.linalg.pinv(together, hermitian=True) * np.outer(spread.sizes[free], spread.sizes[free])
        errors = {problem.space.free[i]: float(np.sqrt(covariance[j, j])) for j, i in enumerate(free)}
        words += f", of {about.specimen}" if about.specimen is not None else ""
        rated.append((float(axis @ gained[np.ix_(free, free)] @ axis),
                      SuggestedTest(test=words, standard_errors=errors)))
    rated.sort(key=lambda item: -item[0])
    # A test is suggested only if it gives more information on the weak direction than the existing tests.
    existing = float(axis @ information @ axis)
    return [suggestion for gain, suggestion in rated[:_SUGGESTIONS.max_suggestions] if gain > existing]


def _build_candidate_tests(problem: GeneralisedProblem, theta: np.ndarray,
                           of: ForwardTest) -> Sequence[tuple[str, Experiment]]:
    """Return possible further tests on the specimen of a test: descriptions and experiments."""
    specimen = of.specimen or _SPECIMEN
    if specimen.is_prism and not (specimen.is_round or isinstance(of, SimulatedTest)):
        # A closed form depends on the cross-section only, so a cylinder with the same area is equivalent.
        specimen = Cylinder(float(np.sqrt(specimen.area / np.pi)), specimen.height)
    ageing = problem.space.build_material(problem.space.get_values_by_name(theta), test=of.name).is_history_dependent
    found = []
    for strain in (_SUGGESTIONS.strain, min(_SUGGESTIONS.depth_factor * _SUGGESTIONS.strain, 0.3)):
        depth = strain * specimen.vertical_thickness()
        millimetres = f"{depth * 1e3:.3g} mm"
        needle = Flat(radius=_SUGGESTIONS.needle_fraction * specimen.margin())
        for words, tool, friction in (
                (f"lubricated compression to {millimetres}", Plate(), "frictionless"),
                (f"bonded compression to {millimetres}", Plate(), "bonded"),
                (f"needle indentation (flat, radius {needle.radius * 1e3:.3g} mm) to {millimetres}", needle, "bonded")):
            for ending, protocol in _build_candidate_motions(depth, ageing):
                found.append((words + ending, Experiment(specimen, protocol, tool, friction, friction)))
    return found


def _build_candidate_motions(depth: float, ageing: bool) -> list[tuple[str, Protocol]]:
    """Return motions to a depth, m, with the end of their description; with holds for a material with memory."""
    points, hold = _SUGGESTIONS.points, _SUGGESTIONS.hold
    if not ageing:
        return [("", Protocol.ramp(depth, points))]
    text = f"ramp {depth * 1e3:.6g}mm @{STUDY_SPEED * 1e3:.6g}mm/s; hold {hold:g}s"
    return [(f" with a hold of {hold:g} s", Protocol.parse(text, points=points)),
            (" with a hold and unloading", Protocol.parse(text + "; unload", points=points)),
            (" ten times as fast, with a hold", Protocol.parse(
                text.replace(f"@{STUDY_SPEED * 1e3:.6g}", f"@{STUDY_SPEED * 1e4:.6g}"), points=points))]


def _compute_scaled_test_information_or_none(problem: GeneralisedProblem, theta: np.ndarray, experiment: Experiment,
                                             test: str, spread: ParameterUncertainty,
                                             noise: float, jitter: tuple[float, float]) -> np.ndarray | None:
    """Return the scaled information of a further test with the jitter marginalised, shape (p, p).

    Args:
        problem: problem of the fit.
        theta: free parameters, SI, shape (p,).
        experiment: further test.
        test: name of the existing test whose parameters act in the further test.
        spread: uncertainty at the minimum.
        noise: noise of the sensor, N.
        jitter: jitter of contact, m, and zero, N.

    Returns:
        Information; None if the simulation fails.
    """
    space = problem.space
    try:
        own = [i for i, each in enumerate(space.free_parameters) if each.is_material_parameter
               and each.recording is None
               and each.applies_to_recording(test, None)]
        solver = ROUND_SOLVER if experiment.specimen.is_round else SPACE_SOLVER
        answer = sensitivities(Model(experiment, space.build_material(space.get_values_by_name(theta), test=test)),
                               [space.free_parameters[i].path for i in own], solver=solver,
                               resolution=get_solver_fit_resolutions(solver).fast)
    except (ConvergenceError, InputError):
        return None
    recording = answer.recording
    weight = np.sqrt(_SUGGESTIONS.samples / recording.force.size) / noise
    rates = np.zeros((recording.force.size, len(space.free)))
    rates[:, own] = weight * answer.values * spread.sizes[own]
    contact, zero = jitter
    columns = weight * np.column_stack([contact * compute_force_derivative_by_offset(recording),
                                        zero * np.ones_like(recording.force)])
    inner = np.linalg.inv(np.eye(2) + columns.T @ columns)
    return _SUGGESTIONS.replicates * (rates.T @ rates - rates.T @ columns @ inner @ columns.T @ rates)
