"""Offline simulation of a whole test: model in, recording out."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Protocol

import numpy as np

from tissue_sim.errors import ConvergenceError
from tissue_sim.experiment.experiment import Experiment, Model
from tissue_sim.experiment.tilt import tilted
from tissue_sim.fem.axisymmetric.discretisation import build_mesh, build_solver, sag
from tissue_sim.fem.axisymmetric.fields import Fields
from tissue_sim.fem.axisymmetric.newton import StepStatus
from tissue_sim.fem.axisymmetric.solver import AxisymmetricSolver, Step
from tissue_sim.laws import check_stability
from tissue_sim.material.puncture import PunctureHistory
from tissue_sim.mesh import Mesh
from tissue_sim.recording.recording import Recording

#: A step is cut until it is this small a part of the way between two samples.
_SMALLEST_CUT = 2.0**-10
#: The tool of a compliant rig is where it should be to this part of the travel.
_PLACED, _MOST_TRIALS = 1e-7, 20
_NOTHING = Step(StepStatus.CONVERGED, 0, 0.0, 0.0)


class Watch(Protocol):
    """Who follows a solver through a test."""

    def begin(self, solver: AxisymmetricSolver) -> None:
        """Before the first step."""

    def sample(self, solver: AxisymmetricSolver, factor: float) -> None:
        """After each sample; the test's force is `factor` times the solver's."""


def simulate(model: Model, *, resolution: str = "fast", mesh: Mesh | None = None, fields: bool = False,
             progress: Callable[[int, int], None] | None = None, watch: Watch | None = None) -> Recording:
    """Simulate a whole test quasi-statically.

    The protocol is the motion that the rig's stage reports; where the load train gives way the tool's true place is
    found together with its force. Between two samples the law's stress changes linearly in time.

    Args:
        model: experiment, material, rig.
        resolution: ``"fast"`` or ``"accurate"``, see `tissue_sim.fem.axisymmetric.discretisation`.
        mesh: a mesh of your own instead.
        fields: keep the converged fields of every sample in ``recording.fields``.
        progress: called with (samples done, samples in all); the first call comes before the kernels are compiled.
        watch: told of the solver.

    Returns:
        Recording at the times of the protocol, with its labels, as the model's rig reports it. ``metadata["solver"]``
        holds status, message, warnings, newton_iterations (linear solves), cuts, residual (the largest), wall_s,
        element, mesh and resolution; with contact also penetration_mm (the largest violation of a contact condition)
        and penetration_tolerance_mm; with friction slipping_points (the most at once); of a specimen that weighs also
        self_weight {density_kg_m3, gravity_m_s2, height_is, sag_mm, moulded_height_mm}.

    Raises:
        ConvergenceError: a step did not converge however small; its `recording` keeps the converged part.
        InputError: unknown resolution, or a bulk response or layers that do not fit.
        MissingBackendError: Taichi is not there.
    """
    started = time.perf_counter()
    protocol, rig = model.experiment.protocol, model.rig
    rig.readings(protocol.time)  # refused now or never
    own_mesh = mesh is not None
    mesh = mesh if own_mesh else build_mesh(model.experiment, resolution, layers=model.material.layers)
    solver = build_solver(model, mesh)
    if watch:
        watch.begin(solver)
    forces, depths, states, stresses = [], [], [], []
    report = {"newton_iterations": 0, "cuts": 0, "residual": 0.0, "element": mesh.element.name,
              "mesh": {"elements": len(mesh.connectivity), "freedoms": solver.free},
              "resolution": "own mesh" if own_mesh else resolution}
    if solver.contact is not None:
        report |= {"penetration_mm": 0.0, "penetration_tolerance_mm": solver.contact.tolerance * 1e3}
        if solver.surface.slips:
            report["slipping_points"] = 0
    if model.experiment.specimen.specific_weight:
        report["self_weight"] = _weight_report(model.experiment, solver)

    def record(status: str, message: str) -> Recording:
        done = len(forces)
        solved = {"status": status, "message": message, "warnings": [], **report,
                  "wall_s": time.perf_counter() - started}
        true = Recording({"time": protocol.time[:done], "displacement": protocol.displacement[:done], "force": forces},
                         labels={name: values[:done] for name, values in protocol.labels.items()},
                         metadata={"name": "simulation", "solver": solved},
                         fields=Fields.of(solver, states, stresses) if fields else None)
        return rig.read(tilted(true, model.experiment.tilt, np.array(depths)))

    if progress:
        progress(0, protocol.displacement.size)
    dropped, train = PunctureHistory(model.puncture), _LoadTrain(rig.compliance)
    places = rig.tool_motion(protocol.displacement)
    waits, first = _from_the_touch(places, protocol.time)
    for sample, (place, dt) in enumerate(zip(places.tolist(), waits.tolist(), strict=True)):
        # Before that the tool is in the air, and the specimen waits for it.
        steps = _sample(solver, place, dt, train, dropped) if sample >= first else [_NOTHING]
        for step in steps:
            report["newton_iterations"] += step.iterations
            report["cuts"] += step.status is not StepStatus.CONVERGED
        if step.status is not StepStatus.CONVERGED:
            message = (f"stopped at {solver.depth * 1e3:.4g} mm on the way to {place * 1e3:.4g} mm (sample "
                       f"{sample + 1}), the step cut to {_SMALLEST_CUT:.1g} of its length: {step.status.message}")
            if step.status is StepStatus.INDEFINITE:
                message += f"; the law alone is {check_stability(model.material.energy_law, model.material.values)}"
            partial = record("not_converged", message) if forces else None
            raise ConvergenceError(message, recording=partial, depth=solver.depth)
        report["residual"] = max(report["residual"], step.residual)
        if "penetration_mm" in report:
            report["penetration_mm"] = max(report["penetration_mm"], step.violation * 1e3)
        if "slipping_points" in report:
            report["slipping_points"] = max(report["slipping_points"], step.slipping)
        forces.append(dropped(solver.depth, step.force))
        depths.append(min(place, 0.0) if sample < first else solver.depth)
        train.note(solver.depth, forces[-1])
        if watch:
            watch.sample(solver, dropped.at(solver.depth, 1.0))
        if fields:
            states.append(solver.state)
            if solver.memory.works:
                stresses.append(solver.memory.total())
        if progress:
            progress(sample + 1, protocol.displacement.size)
    cuts = report["cuts"]
    return record("converged", f"converged at every sample{f', step cuts: {cuts}' if cuts else ''}")


def _weight_report(experiment: Experiment, solver: AxisymmetricSolver) -> dict:
    specimen = experiment.specimen
    height = -float(solver.mesh.nodes[:, 1].min())
    return {"density_kg_m3": specimen.density, "gravity_m_s2": specimen.gravity, "height_is": specimen.height_is,
            "sag_mm": sag(solver) * 1e3, "moulded_height_mm": height * 1e3}


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


def _sample(solver: AxisymmetricSolver, place: float, dt: float, train: _LoadTrain,
            dropped: PunctureHistory) -> Iterator[Step]:
    """Steps to one sample; yields each, the last one is that of the sample.

    Args:
        place: where the tool would be with a rigid load train, m.
        dt: time since the sample before, s.
        train: what gives way.
    """
    if not train.compliance:
        yield from _approach(solver, place, dt)
        return
    saved = solver.save()
    depth, growth = train.expect(place)
    before = None
    for trial in range(_MOST_TRIALS):
        if trial:
            solver.restore(saved)
        for step in _approach(solver, depth, dt):
            yield step
        if step.status is not StepStatus.CONVERGED:
            return
        excess = depth + train.compliance * dropped.at(depth, step.force) - place
        if abs(excess) <= _PLACED * max(abs(place), abs(depth), 1e-6):
            return
        # The secant; where tissue softens as it goes the load train still gives way by at least its own travel.
        if before is not None and depth != before[0]:
            growth = max((excess - before[1]) / (depth - before[0]), 1.0)
        before, depth = (depth, excess), depth - excess / growth
    yield Step(StepStatus.SLOW, 0, step.residual, step.force, step.violation)


def _approach(solver: AxisymmetricSolver, target: float, dt: float = 0.0) -> Iterator[Step]:
    """Steps to `target`, halved where they fail and doubled where they succeed; yields each `Step`.

    Time passes evenly along the way, `dt` (s) in all.
    """
    start, way = solver.depth, target - solver.depth
    done, length, order = 0.0, 1.0, 2
    while True:
        share = min(length, 1.0 - done)
        last = done + share >= 1.0 - 1e-9
        # Extrapolation leads astray where contact changes; the linear solution for the tool's way does not.
        step = solver.step(target if last else start + (done + share) * way, share * dt, predictor_order=order)
        yield step
        if step.status is StepStatus.CONVERGED:
            if last:
                return
            done, length, order = done + share, length * 2.0, 2
        else:
            # The same step without extrapolation first.
            length, order = (length, 0) if order else (length / 2.0, 2)
            if length < _SMALLEST_CUT:
                return
