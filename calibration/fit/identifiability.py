"""Identifiability: undetermined parameters, weakly determined directions, and further tests that determine them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.campaign.experiments import ROUND_SOLVER, SPACE_SOLVER
from calibration.campaign.parameter_space import ParameterSpace
from calibration.fit.fit import SuggestedTest, WeakDirection
from calibration.fit.problem import GeneralisedProblem
from calibration.forward.contract import ForwardTest
from calibration.forward.meshes import get_solver_fit_resolutions
from calibration.forward.motion import compute_force_derivative_by_offset
from calibration.forward.simulated import SimulatedTest
from calibration.statistics.uncertainty import ParameterUncertainty
from tissue_sim.differentiation import sensitivities
from tissue_sim.errors import ConvergenceError, InputError
from tissue_sim.experiment.experiment import Experiment
from tissue_sim.experiment.protocol import STUDY_SPEED, Protocol
from tissue_sim.experiment.tools.flat import Flat
from tissue_sim.experiment.tools.plate import Plate
from tissue_sim.model import Model
from tissue_sim.specimen.cylinder import Cylinder

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


_SETTINGS = SuggestedTestSettings()
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
    mechanical = [curve.noise.deviation for curve in problem.measured if curve.test.specimen is not None]
    noise, jitter = (_SETTINGS.noise, _SETTINGS.jitter) if not mechanical else (
        float(np.median(mechanical)), (problem.jitter.contact, problem.jitter.zero))
    about = problem.space.free_parameters[free[np.argmax(np.abs(axis))]]
    acting = [test for test in problem.tests if about.applies_to_recording(test.name, None)] or list(problem.tests)
    of = next((test for test in acting if test.specimen is not None), acting[0])
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
    return [suggestion for gain, suggestion in rated[:_SETTINGS.max_suggestions] if gain > existing]


def _build_candidate_tests(problem: GeneralisedProblem, theta: np.ndarray,
                           of: ForwardTest) -> Sequence[tuple[str, Experiment]]:
    """Return possible further tests on the specimen of a test: descriptions and experiments."""
    specimen = of.specimen or _SPECIMEN
    if specimen.is_prism and not (specimen.is_round or isinstance(of, SimulatedTest)):
        # A closed form depends on the cross-section only, so a cylinder with the same area is equivalent.
        specimen = Cylinder(float(np.sqrt(specimen.area / np.pi)), specimen.height)
    ageing = problem.space.build_material(problem.space.get_values_by_name(theta), test=of.name).is_history_dependent
    found = []
    for strain in (_SETTINGS.strain, min(_SETTINGS.depth_factor * _SETTINGS.strain, 0.3)):
        depth = strain * specimen.vertical_thickness()
        millimetres = f"{depth * 1e3:.3g} mm"
        needle = Flat(radius=_SETTINGS.needle_fraction * specimen.margin())
        for words, tool, friction in (
                (f"lubricated compression to {millimetres}", Plate(), "frictionless"),
                (f"bonded compression to {millimetres}", Plate(), "bonded"),
                (f"needle indentation (flat, radius {needle.radius * 1e3:.3g} mm) to {millimetres}", needle, "bonded")):
            for ending, protocol in _build_candidate_motions(depth, ageing):
                found.append((words + ending, Experiment(specimen, protocol, tool, friction, friction)))
    return found


def _build_candidate_motions(depth: float, ageing: bool) -> list[tuple[str, Protocol]]:
    """Return motions to a depth, m, with the end of their description; with holds for a material with memory."""
    points, hold = _SETTINGS.points, _SETTINGS.hold
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
    weight = np.sqrt(_SETTINGS.samples / recording.force.size) / noise
    rates = np.zeros((recording.force.size, len(space.free)))
    rates[:, own] = weight * answer.values * spread.sizes[own]
    contact, zero = jitter
    columns = weight * np.column_stack([contact * compute_force_derivative_by_offset(recording),
                                        zero * np.ones_like(recording.force)])
    inner = np.linalg.inv(np.eye(2) + columns.T @ columns)
    return _SETTINGS.replicates * (rates.T @ rates - rates.T @ columns @ inner @ columns.T @ rates)
