"""What the tests cannot tell, and which further test would."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calibration.campaign.experiments import ROUND_SOLVER, SPACE_SOLVER
from calibration.campaign.parameter_space import ParameterSpace
from calibration.fit.fit import Direction, Suggestion
from calibration.fit.problem import Problem
from calibration.forward.contract import ForwardTest
from calibration.forward.meshes import meshes_of
from calibration.forward.motion import offset_derivative
from calibration.forward.simulated import SimulatedTest
from calibration.statistics.uncertainty import Uncertainty
from tissue_sim.differentiation import sensitivities
from tissue_sim.errors import ConvergenceError, InputError
from tissue_sim.experiment.experiment import Experiment
from tissue_sim.experiment.protocol import STUDY_SPEED, Protocol
from tissue_sim.experiment.tools.flat import Flat
from tissue_sim.experiment.tools.plate import Plate
from tissue_sim.model import Model
from tissue_sim.specimen.cylinder import Cylinder

#: A combination whose relative standard error is larger than this is poorly told.
WEAK = 0.2
#: What a suggested test is taken to be like: samples of a recording, and recordings.
_SAMPLES, _REPLICATES, _POINTS = 400, 3, 11
_HOLD_S, _STRAIN, _DEEPER, _NEEDLE = 60.0, 0.14, 1.6, 0.2
_MOST_SUGGESTIONS = 3
#: Noise, N, and jitter, m and N, of a rig such as the study's, for campaigns that recorded stress.
_RIG = 0.02, (0.03e-3, 0.01)
#: The study's specimen, for campaigns whose tests have none.
_SPECIMEN = Cylinder(0.040, 0.070)


def condition(spread: Uncertainty) -> float | None:
    """Largest over smallest eigenvalue of the scaled information; None where one is zero."""
    free = ~spread.on_bound
    if not free.any():
        return None
    values = np.linalg.eigvalsh(spread.information[np.ix_(free, free)])
    return float(values[-1] / values[0]) if values[0] > 0 else None


def weak_directions(space: ParameterSpace, spread: Uncertainty) -> list[Direction]:
    """Combinations of relative changes that the tests tell poorly, worst first."""
    free = np.flatnonzero(~spread.on_bound)
    values, vectors = np.linalg.eigh(spread.information[np.ix_(free, free)])
    found = []
    for value, vector in zip(values, vectors.T, strict=True):
        error = float(np.sqrt(spread.inflation / value)) if value > 0 else 1e9
        if error <= WEAK:
            break
        vector = vector * np.sign(vector[np.argmax(np.abs(vector))])
        found.append(Direction(shares={space.free[i]: float(share) for i, share in zip(free, vector, strict=True)},
                               relative_error=min(error, 1e9)))
    return found


def not_identifiable(space: ParameterSpace, spread: Uncertainty) -> list[str]:
    """Parameters whose standard error exceeds their size."""
    return [name for name, error, size in zip(space.free, spread.standard_errors, spread.sizes, strict=False)
            if not error <= size and not np.isnan(error)]


def suggest_tests(problem: Problem, theta: np.ndarray, spread: Uncertainty) -> list[Suggestion]:
    """Further tests that tell the weakest direction better, best first; each is simulated once.

    They are of the specimen that the weakest direction is about, and tell no other's numbers. A test counts as three
    recordings of 400 samples with the noise and jitter of the campaign.
    """
    free = np.flatnonzero(~spread.on_bound)
    rated = []
    information = spread.information[np.ix_(free, free)] / spread.inflation
    axis = np.linalg.eigh(information)[1][:, 0]
    mechanical = [curve.noise.deviation for curve in problem.measured if curve.test.specimen is not None]
    noise, jitter = _RIG if not mechanical else (
        float(np.median(mechanical)), (problem.jitter.contact, problem.jitter.zero))
    about = problem.space.varied[free[np.argmax(np.abs(axis))]]
    acting = [test for test in problem.tests if about.acts_in(test.name, None)] or list(problem.tests)
    of = next((test for test in acting if test.specimen is not None), acting[0])
    for words, experiment in _candidates(problem, theta, of):
        gained = _information(problem, theta, experiment, of.name, spread, noise, jitter)
        if gained is None:
            continue
        together = information + gained[np.ix_(free, free)]
        covariance = np.linalg.pinv(together, hermitian=True) * np.outer(spread.sizes[free], spread.sizes[free])
        errors = {problem.space.free[i]: float(np.sqrt(covariance[j, j])) for j, i in enumerate(free)}
        words += f", of {about.specimen}" if about.specimen is not None else ""
        rated.append((float(axis @ gained[np.ix_(free, free)] @ axis), Suggestion(test=words, standard_errors=errors)))
    rated.sort(key=lambda item: -item[0])
    # What tells the weak direction less than the tests that are there is no remedy.
    worth = float(axis @ information @ axis)
    return [suggestion for gain, suggestion in rated[:_MOST_SUGGESTIONS] if gain > worth]


def _candidates(problem: Problem, theta: np.ndarray, of: ForwardTest) -> Sequence[tuple[str, Experiment]]:
    """Tests in words, as experiments on the specimen of a test."""
    specimen = of.specimen or _SPECIMEN
    if specimen.is_prism and not (specimen.is_round or isinstance(of, SimulatedTest)):
        # Of a closed form the cross-section is all that counts.
        specimen = Cylinder(float(np.sqrt(specimen.area / np.pi)), specimen.height)
    ageing = problem.space.material(problem.space.values(theta), test=of.name).remembers
    found = []
    for strain in (_STRAIN, min(_DEEPER * _STRAIN, 0.3)):
        depth = strain * specimen.depth_at()
        millimetres = f"{depth * 1e3:.3g} mm"
        needle = Flat(radius=_NEEDLE * specimen.margin())
        for words, tool, friction in (
                (f"lubricated compression to {millimetres}", Plate(), "frictionless"),
                (f"bonded compression to {millimetres}", Plate(), "bonded"),
                (f"needle indentation (flat, radius {needle.radius * 1e3:.3g} mm) to {millimetres}", needle, "bonded")):
            for ending, protocol in _protocols(depth, ageing):
                found.append((words + ending, Experiment(specimen, protocol, tool, friction, friction)))
    return found


def _protocols(depth: float, ageing: bool) -> list[tuple[str, Protocol]]:
    if not ageing:
        return [("", Protocol.ramp(depth, _POINTS))]
    text = f"ramp {depth * 1e3:.6g}mm @{STUDY_SPEED * 1e3:.6g}mm/s; hold {_HOLD_S:g}s"
    return [(f" with a hold of {_HOLD_S:g} s", Protocol.parse(text, points=_POINTS)),
            (" with a hold and a return", Protocol.parse(text + "; unload", points=_POINTS)),
            (" ten times as fast, with a hold", Protocol.parse(
                text.replace(f"@{STUDY_SPEED * 1e3:.6g}", f"@{STUDY_SPEED * 1e4:.6g}"), points=_POINTS))]


def _information(problem: Problem, theta: np.ndarray, experiment: Experiment, test: str, spread: Uncertainty,
                 noise: float, jitter: tuple[float, float]) -> np.ndarray | None:
    """Scaled information of three recordings with the jitter marginalised, about the numbers that act in a test too;
    None where it stops."""
    space = problem.space
    try:
        own = [i for i, each in enumerate(space.varied) if each.of_material and each.recording is None
               and each.acts_in(test, None)]
        solver = ROUND_SOLVER if experiment.specimen.is_round else SPACE_SOLVER
        answer = sensitivities(Model(experiment, space.material(space.values(theta), test=test)),
                               [space.varied[i].path for i in own], solver=solver, resolution=meshes_of(solver).fast)
    except (ConvergenceError, InputError):
        return None
    recording = answer.recording
    weight = np.sqrt(_SAMPLES / recording.force.size) / noise
    rates = np.zeros((recording.force.size, len(space.free)))
    rates[:, own] = weight * answer.values * spread.sizes[own]
    contact, zero = jitter
    columns = weight * np.column_stack([contact * offset_derivative(recording), zero * np.ones_like(recording.force)])
    inner = np.linalg.inv(np.eye(2) + columns.T @ columns)
    return _REPLICATES * (rates.T @ rates - rates.T @ columns @ inner @ columns.T @ rates)
