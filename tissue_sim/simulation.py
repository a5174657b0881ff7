"""Offline simulation of a whole test: model in, recording out."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from tissue_sim.errors import ConvergenceError
from tissue_sim.fem.solver import SOLVERS, Solver, Step, StepStatus
from tissue_sim.force_error import WORTH_A_WARNING, ForceError, force_error, other_steps
from tissue_sim.laws import check_stability
from tissue_sim.material.effect import ReducedForce
from tissue_sim.model import Model
from tissue_sim.pose import Pose, Screw, between, scaled
from tissue_sim.recording.recording import Recording
from tissue_sim.slip import slipped
from tissue_sim.tilt import tilted

#: A step is cut until it is this small a part of the way between two samples; from the first part on that fails without
#: an extrapolation, the tissue is also let creep there.
_SMALLEST_CUT, _CREEPS = 2.0**-10, 2.0**-3
#: Linear solves that a step may take, and one that creeps.
_MOST_SOLVES, _MOST_OF_CREEP = 40, 24
#: Unbalanced over balanced forces of an equilibrium that another one is compared with.
_ROUGH = 1e-3
#: Linear solves of such a test over those of the other, and how many it may take in any case.
_MOST_TO_COMPARE, _ALWAYS_TO_COMPARE = 4, 400
#: The tool of a compliant rig is where it should be to this part of the travel; to the next one it is almost there.
_PLACED, _NEARLY, _MANY_TRIALS, _MOST_TRIALS = 1e-7, 1e-3, 8, 20
#: What shows whether a force errs as a warning says.
_REMEDY = 'more samples show it'
_REMEDIES = {"fast": 'the resolution "accurate" or more samples show it'}
_NOTHING = Step.axial(StepStatus.CONVERGED, 0, 0.0, 0.0)
#: Channels of a wrench that has more than a force along z.
_WRENCH = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")


class Watch(Protocol):
    """Who follows a solver through a test."""

    def begin(self, solver: Solver) -> None:
        """Before the first step."""

    def sample(self, solver: Solver, factor: float) -> None:
        """After each sample; the test's force is `factor` times the solver's."""


def simulate(model: Model, *, resolution: str = "fast", mesh: Any = None, fields: bool = False,
             progress: Callable[[int, int], None] | None = None, watch: Watch | None = None,
             solver: str = "axisymmetric", topology: Model | None = None,
             estimate_error: bool = True) -> Recording:
    """Simulate a whole test quasi-statically.

    The protocol is the motion that the rig's stage reports; where the load train gives way the tool's true place is
    found together with its force. Of faces that slip in part the bonded and the frictionless test are simulated, each
    behind a load train of its own; fields are those of the bonded one. Between two samples the law's stress changes
    linearly in time.

    How far the force errs is estimated from a second test on another mesh with every second sample, where the solver
    knows a mesh to compare with; more than `force_error.WORTH_A_WARNING` of the largest force is a warning. On
    ``"fast"`` that doubles the time, on ``"accurate"`` it adds about a fifth.

    Args:
        model: experiment, material, rig.
        resolution: ``"fast"`` or ``"accurate"``, or another name that the solver knows.
        mesh: a mesh of your own instead.
        fields: keep the converged fields of every sample in ``recording.fields``.
        progress: called with (samples done, samples in all); the first call comes before the kernels are compiled.
        watch: told of the solver.
        solver: name in `tissue_sim.fem.solver.SOLVERS`.
        topology: a model of another geometry: its mesh (or the one that is given, as one of it) is taken, with the
            nodes moved, so that a change of geometry does not change the elements.
        estimate_error: of the force; not on a mesh of your own, and not for who simulates again and again.

    Returns:
        Recording at the times of the protocol, with its labels, as the model's rig reports it. Its displacement counts
        along the tool's way, and its force is the share against that way, as a load cell on the tool's stage feels it;
        where the wrench on the tool is more than a force along z, there are also the channels Fx to Tz in the frame of
        the scene. ``metadata["solver"]`` holds status, message, warnings, force_error (estimated, over the largest
        force; None: not known), newton_iterations (linear solves), cuts, residual (the largest), dissipated_J (by a
        drag, where the tissue was let creep to its next equilibrium), wall_s, element, mesh and resolution;
        with contact also penetration_mm (the largest violation of a contact condition) and penetration_tolerance_mm;
        with friction slipping_points (the most at once); of a specimen that weighs also self_weight {density_kg_m3,
        gravity_m_s2, height_is, sag_mm, moulded_height_mm}.

    Raises:
        ConvergenceError: a step did not converge however small; its `recording` keeps the converged part.
        InputError: unknown solver or resolution, or a bulk response or layers that do not fit.
        MissingBackendError: Taichi is not there.
    """
    started = time.perf_counter()
    protocol, rig = model.experiment.protocol, model.rig
    rig.readings(protocol.time)  # refused now or never
    if share := model.experiment.slip:
        held, free = (
            simulate(replace(model, experiment=experiment, rig=rig.motion_only), resolution=resolution, mesh=mesh,
                     fields=fields, progress=follow, watch=watched, solver=solver, topology=topology,
                     estimate_error=estimate_error)
            for experiment, follow, watched in ((replace(model.experiment, slip=None), progress, watch),
                                                (model.experiment.with_free_faces(), None, None)))
        return rig.read(slipped(held, free, share))
    tissue = SOLVERS.find(solver, "solver")(model, resolution=resolution, mesh=mesh, topology=topology)
    if watch:
        watch.begin(tissue)
    wrenches: list[Screw] = []
    travels: list[float] = []
    samples: list[Any] = []
    report = {"warnings": [], "force_error": None, "newton_iterations": 0, "cuts": 0, "residual": 0.0,
              "dissipated_J": 0.0, **tissue.report(), "resolution": "own mesh" if mesh is not None else resolution}
    if "self_weight" in report:
        specimen = model.experiment.specimen
        report["self_weight"] = {"density_kg_m3": specimen.density, "gravity_m_s2": specimen.gravity,
                                 "height_is": specimen.height_is, **report["self_weight"]}

    def record(status: str, message: str) -> Recording:
        done, wrench = len(wrenches), np.array(wrenches).reshape(-1, 6)
        solved = {"status": status, "message": message, **report}
        solved.setdefault("wall_s", time.perf_counter() - started)
        channels = {"time": protocol.time[:done], "displacement": protocol.displacement[:done],
                    "force": np.array([model.experiment.resistance(one) for one in wrenches])}
        if wrench[:, [0, 1, 3, 4, 5]].any():
            channels |= zip(_WRENCH, wrench.T, strict=True)
        true = Recording(channels, labels={name: values[:done] for name, values in protocol.labels.items()},
                         metadata={"name": "simulation", "solver": solved},
                         fields=tissue.fields(samples) if fields else None)
        return rig.read(tilted(true, model.experiment.tilt, np.array(travels)))

    if progress:
        progress(0, protocol.displacement.size)
    drive, largest = _Drive(tissue, model), 0.0
    for sample, (place, dt, steps) in enumerate(drive.along(np.arange(protocol.time.size))):
        for step in steps:
            report["newton_iterations"] += step.iterations
            report["cuts"] += step.status is not StepStatus.CONVERGED
            report["dissipated_J"] += step.dissipated
        if step.status is not StepStatus.CONVERGED:
            depth = tissue.pose.depth
            message = (f"stopped at {depth * 1e3:.4g} mm on the way to {place * 1e3:.4g} mm (sample "
                       f"{sample + 1}), the step cut to {_SMALLEST_CUT:.1g} of its length: {step.status.message}")
            stability = check_stability(model.material.energy_law, model.material.values)
            if step.status is StepStatus.INDEFINITE or not stability.stable:
                message += f"; the law alone is {stability}"
            raise ConvergenceError(message, recording=record("not_converged", message) if wrenches else None,
                                   depth=depth)
        _note_largest(report, step)
        wrenches.append(drive.arrive(step.wrench, dt))
        if (size := math.hypot(*wrenches[-1][:3])) >= largest:
            largest, report["warnings"] = size, list(tissue.warnings())
        travels.append(drive.travel)
        if watch:
            watch.sample(tissue, drive.share)
        if fields:
            samples.append(tissue.sample())
        if progress:
            progress(sample + 1, protocol.displacement.size)
    report["wall_s"] = time.perf_counter() - started  # of the test alone
    if estimate_error and mesh is None:
        found = _compare(tissue, model, np.array([model.experiment.resistance(one) for one in wrenches]), solver,
                         resolution, topology, max(_ALWAYS_TO_COMPARE, _MOST_TO_COMPARE * report["newton_iterations"]))
        if found is not None:
            report["force_error"] = found.share
            if found.share > WORTH_A_WARNING:
                report["warnings"] = [found.in_words(protocol.displacement, _REMEDIES.get(resolution, _REMEDY)),
                                      *report["warnings"]]
    cuts = report["cuts"]
    return record("converged", f"converged at every sample{f', step cuts: {cuts}' if cuts else ''}")


def _compare(tissue: Solver, model: Model, force: np.ndarray, solver: str, resolution: str, topology: Model | None,
             most_solves: int) -> ForceError | None:
    """By how much a force (N, of each sample) errs, from the same test in other steps on another mesh; where that is
    worth a warning, from one with steps half as long there too. None where the solver knows no other mesh, or
    the tool does not get through to a sample there."""
    estimate, protocol = tissue.error_estimate(resolution), model.experiment.protocol
    if estimate is None:
        return None

    def forces(places: np.ndarray) -> np.ndarray:
        other, solves = [], 0
        along = replace(model, experiment=replace(model.experiment, protocol=protocol.at(places)))
        try:
            drive = _Drive(SOLVERS.find(solver, "solver")(along, resolution=estimate.resolution, topology=topology),
                           along, tolerance=_ROUGH)
        except ConvergenceError:
            return np.zeros(0)
        for _, dt, steps in drive.along(np.arange(places.size)):
            for step in steps:
                solves += step.iterations
            if step.status is not StepStatus.CONVERGED or solves > most_solves:
                break
            other.append(model.experiment.resistance(drive.arrive(step.wrench, dt)))
        return np.array(other)

    places = other_steps(protocol.displacement)
    other = forces(places)
    common = np.flatnonzero(places[:other.size] % 1.0 == 0.0)
    found = force_error(force, places[common].astype(int), other[common], estimate.fraction)
    if found is None or found.share <= WORTH_A_WARNING:
        return found
    # A step in which contact begins anew may err by many times more than one half as long. An error that is in
    # proportion to the length, and that of the mesh, are no more than twice what steps half as long differ by.
    other = forces(0.5 * np.arange(2 * protocol.time.size - 1))[::2]
    again = force_error(force, np.arange(force.size), other, 2.0 * estimate.fraction, shorter=True)
    return again if again is not None and other.size == force.size and again.share < found.share else found


def _note_largest(report: dict, step: Step) -> None:
    """What a report says of the largest of all samples."""
    for name, value in (("residual", step.residual), ("penetration_mm", step.violation * 1e3),
                        ("slipping_points", step.slipping)):
        if name in report:
            report[name] = max(report[name], value)


def _from_the_touch(places: np.ndarray, time: np.ndarray) -> tuple[np.ndarray, int]:
    """Time on the way to each place of the tool, s, and the first sample at which it touches the specimen.

    The way to that one counts from the touch on.
    """
    waits, touching = np.diff(time, prepend=time[0]), np.flatnonzero(places >= 0.0)
    first = int(touching[0]) if touching.size else places.size
    if 0 < first < places.size:
        waits[first] *= places[first] / (places[first] - places[first - 1])
    return waits, first


class _LoadTrain:
    """A load train that gives way, compliance in m/N: the tool is at d with d + compliance F(d) = place."""

    def __init__(self, compliance: float):
        self.compliance = compliance
        self._known: list[tuple[float, float]] = []

    def note(self, depth: float, force: float) -> None:
        """Where the tool stood at a sample, and its force."""
        self._known = [*self._known[-1:], (depth, force)]

    def expect(self, place: float) -> tuple[float, float]:
        """Where it will stand, and how fast d + compliance F grows there, from the last two samples."""
        (d0, f0), (d1, f1) = self._known if len(self._known) == 2 else ((0.0, 0.0), (0.0, 0.0))
        growth = 1.0 + self.compliance * max(0.0, (f1 - f0) / (d1 - d0)) if d1 != d0 else 1.0
        return d1 + (place - d1 - self.compliance * f1) / growth, growth


class _Drive:
    """Takes the tool along the experiment's motion: through a load train that may give way, in steps that converge.

    Args:
        options: of each step of the solver, such as its tolerance.

    Attributes:
        travel: of the tool along its motion at the last sample, m.
    """

    def __init__(self, solver: Solver, model: Model, **options: Any):
        self._solver, self._model, self._experiment, self._options = solver, model, model.experiment, options
        self._train = _LoadTrain(model.rig.compliance)
        self._reduced = ReducedForce(model.material.reduced_effects(plate=model.experiment.tool.is_plate))
        self.travel = 0.0

    @property
    def share(self) -> float:
        """What effects in reduced form leave of a force on the tool where it has come to."""
        return self._reduced.share(self._solver.pose.depth)

    def arrive(self, wrench: Screw, dt: float) -> Screw:
        """The tool has come to a sample with this wrench, dt s after the one before; returns what is left of it."""
        share = self._reduced.commit(self._solver.pose.depth, dt)
        wrench = scaled(share, wrench)
        self._train.note(self.travel, self._experiment.resistance(wrench))
        return wrench

    def along(self, samples: np.ndarray) -> Iterator[tuple[float, float, Iterable[Step]]]:
        """For each of these samples of the protocol: place, m, time since the one before, s, and the steps to it."""
        protocol = self._experiment.protocol
        places = self._model.rig.tool_motion(protocol.displacement)[samples]
        waits, first = _from_the_touch(places, protocol.time[samples])
        for number, (place, dt) in enumerate(zip(places.tolist(), waits.tolist(), strict=True)):
            if number < first:
                # The tool is in the air, and the specimen waits for it.
                self.travel = min(place, 0.0)
            yield place, dt, self.to(place, dt) if number >= first else [_NOTHING]

    def to(self, place: float, dt: float) -> Iterator[Step]:
        """Steps to one sample; yields each, the last one is that of the sample.

        Args:
            place: where the tool would be with a rigid load train, m.
            dt: time since the sample before, s.
        """
        solver, train = self._solver, self._train
        if not train.compliance:
            self.travel = place
            yield from _approach(solver, self._pose(place), dt, **self._options)
            return
        saved = solver.save()
        depth, growth = train.expect(place)
        before = None
        for trial in range(_MOST_TRIALS):
            # Where steps are cut friction remembers another way each time, and the secant finds no place: from almost
            # there the tool goes on from where it is.
            near = trial >= _MANY_TRIALS and before is not None and (
                abs(before[1]) <= _NEARLY * max(abs(place), abs(depth), 1e-6))
            if trial and not near:
                solver.restore(saved)
            self.travel = depth
            for step in _approach(solver, self._pose(depth), 0.0 if near else dt, **self._options):
                yield step
            if step.status is not StepStatus.CONVERGED:
                return
            share = self._reduced.share(solver.pose.depth, dt)
            excess = depth + train.compliance * share * self._experiment.resistance(step.wrench) - place
            if abs(excess) <= _PLACED * max(abs(place), abs(depth), 1e-6):
                return
            # The secant; where tissue softens as it goes the load train still gives way by at least its own travel.
            if before is not None and depth != before[0]:
                growth = max((excess - before[1]) / (depth - before[0]), 1.0)
            before, depth = (depth, excess), depth - excess / growth
        yield replace(step, status=StepStatus.SLOW, iterations=0)

    def _pose(self, travel: float) -> Pose:
        return self._solver.project_pose(self._experiment.tool_pose(travel))


def _approach(solver: Solver, target: Pose, dt: float = 0.0, **options: Any) -> Iterator[Step]:
    """Steps to a pose along a rigid motion, halved where they fail and doubled where they succeed; yields each `Step`.

    Time passes evenly along the way, `dt` (s) in all. `options`: of each of the solver's steps.
    """
    start = solver.pose
    most = min(2, solver.highest_order)
    done, length, order = 0.0, 1.0, most
    while True:
        share = min(length, 1.0 - done)
        last = done + share >= 1.0 - 1e-9
        # Extrapolation leads astray where contact changes; the linear solution for the tool's way does not.
        goal = target if last else between(start, target, done + share)
        step = solver.step(goal, share * dt, max_iterations=_MOST_SOLVES, predictor_order=order, **options)
        yield step
        if step.status is not StepStatus.CONVERGED and not order and length <= _CREEPS:
            for step in solver.creep(goal, share * dt, max_iterations=_MOST_OF_CREEP, **options):
                yield step
        if step.status is StepStatus.CONVERGED:
            if last:
                return
            done, length, order = done + share, length * 2.0, most
        else:
            # The same step without extrapolation first.
            length, order = (length, 0) if order else (length / 2.0, most)
            if length < _SMALLEST_CUT:
                return
