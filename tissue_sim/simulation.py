"""Offline simulation of a whole test: model in, recording out."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from tissue_sim.errors import ConvergenceError, InputError, nearest
from tissue_sim.experiment import Experiment, Model
from tissue_sim.fem.axisymmetric import AxisymmetricSolver, Step
from tissue_sim.fem.elements import Q9P1, Element
from tissue_sim.fem.fields import Fields
from tissue_sim.fem.newton import StepStatus
from tissue_sim.laws import check_stability
from tissue_sim.mesh import Mesh, cylinder_mesh
from tissue_sim.recording import Recording

#: Resolution -> elements and grading along r and z of a cylinder as slender as the study's (radius 40, height 70 mm).
#: Bonded compression to 10 mm errs by 0.28 % (fast) and 0.03 % (accurate) at most.
RESOLUTIONS = {"fast": ((6, 8), (10.0, 4.0)), "accurate": ((16, 20), (50.0, 10.0))}
_STUDY_SLENDERNESS = 70.0 / 40.0
#: A step is cut until it is this small a part of the way between two samples.
_SMALLEST_CUT = 2.0**-10


def build_mesh(experiment: Experiment, resolution: str = "fast", element: Element = Q9P1) -> Mesh:
    """The mesh that a named resolution stands for.

    Raises:
        InputError: unknown resolution.
    """
    if resolution not in RESOLUTIONS:
        raise InputError(f"unknown resolution {resolution!r}{nearest(resolution, RESOLUTIONS)}", field="resolution")
    specimen = experiment.specimen
    if experiment.homogeneous:
        # Every mesh is exact.
        return cylinder_mesh(specimen.radius, specimen.height, (2, 2), element)
    (along_r, along_z), grading = RESOLUTIONS[resolution]
    # As many elements in other shapes, with no fewer than half and no more than four times as many along a side.
    stretch = np.sqrt(specimen.height / specimen.radius / _STUDY_SLENDERNESS)
    counts = [round(float(np.clip(count * share, count / 2, 4 * count)))
              for count, share in ((along_r, 1 / stretch), (along_z, stretch))]
    return cylinder_mesh(specimen.radius, specimen.height, counts, element, grading=grading)


def build_solver(model: Model, mesh: Mesh) -> AxisymmetricSolver:
    """The boundary-value problem of an experiment on a mesh."""
    held = {"bonded": "rz", "frictionless": "z"}
    experiment = model.experiment
    return AxisymmetricSolver(mesh, model.material, supports={"base": held[experiment.friction_base]},
                              tool={"top": held[experiment.friction]})


def simulate(model: Model, *, resolution: str = "fast", mesh: Mesh | None = None, fields: bool = False,
             progress: Callable[[int, int], None] | None = None) -> Recording:
    """Simulate a whole test quasi-statically.

    Args:
        model: experiment, material, rig.
        resolution: ``"fast"`` or ``"accurate"``, see `RESOLUTIONS`.
        mesh: a mesh of your own instead.
        fields: keep the converged fields of every sample in ``recording.fields``.
        progress: called with (samples done, samples in all); the first call comes before the kernels are compiled.

    Returns:
        Recording at the times of the protocol, as the model's rig reports it. ``metadata["solver"]`` holds status,
        message, warnings, newton_iterations (linear solves), cuts, residual (the largest), wall_s, element, mesh and
        resolution.

    Raises:
        ConvergenceError: a step did not converge however small; its `recording` keeps the converged part.
        InputError: unknown resolution, or a bulk response out of range.
        MissingBackendError: Taichi is not there.
    """
    started = time.perf_counter()
    protocol = model.experiment.protocol
    own_mesh = mesh is not None
    mesh = mesh if own_mesh else build_mesh(model.experiment, resolution)
    solver = build_solver(model, mesh)
    forces, states, warnings = [], [], {}
    report = {"newton_iterations": 0, "cuts": 0, "residual": 0.0, "element": mesh.element.name,
              "mesh": {"elements": len(mesh.connectivity), "freedoms": solver.free},
              "resolution": "own mesh" if own_mesh else resolution}

    def record(status: str, message: str) -> Recording:
        done = len(forces)
        told = "; ".join([message, *warnings.values()])
        solved = {"status": status, "message": told, "warnings": list(warnings.values()), **report,
                  "wall_s": time.perf_counter() - started}
        ideal = Recording({"time": protocol.time[:done], "displacement": protocol.displacement[:done], "force": forces},
                          metadata={"name": "simulation", "solver": solved},
                          fields=Fields.of(solver, states) if fields else None)
        return model.rig.measure(ideal)

    if progress:
        progress(0, protocol.displacement.size)
    for sample, depth in enumerate(protocol.displacement):
        for step in _approach(solver, float(depth)):
            report["newton_iterations"] += step.iterations
            report["cuts"] += step.status is not StepStatus.CONVERGED
        if step.status is not StepStatus.CONVERGED:
            message = (f"stopped at {solver.depth * 1e3:.4g} mm on the way to {depth * 1e3:.4g} mm (sample "
                       f"{sample + 1}), the step cut to {_SMALLEST_CUT:.1g} of its length: {step.status.message}")
            if step.status is StepStatus.INDEFINITE and not warnings:
                message += f"; the law alone is {check_stability(model.material.energy_law, model.material.values)}"
            partial = record("not_converged", message) if forces else None
            told = partial.metadata["solver"]["message"] if partial else message
            raise ConvergenceError(told, recording=partial, depth=solver.depth)
        report["residual"] = max(report["residual"], step.residual)
        forces.append(step.force)
        for kind, words in _limits(model.experiment, solver, step.force):
            warnings.setdefault(kind, f"from {depth * 1e3:.3g} mm on {words}")
        if fields:
            states.append(solver.state)
        if progress:
            progress(sample + 1, protocol.displacement.size)
    cuts = report["cuts"]
    return record("converged", f"converged at every sample{f', step cuts: {cuts}' if cuts else ''}")


def _limits(experiment: Experiment, solver: AxisymmetricSolver, force: float):
    """What the model cannot do and this state would need, as (kind, sentence)."""
    mesh = solver.mesh
    side = mesh.sets["side"]
    z = mesh.nodes[side, 1] + solver.x[2 * side + 1]
    base, top = mesh.nodes[:, 1].min(), -solver.depth
    slack = -1e-4 * base
    if z.max() > top + slack or z.min() < base - slack:
        yield "bulge", ("the bulging side passes a plate, which would hold it back: the force is too low there")
    if solver.depth < 0 and force < 0 and "frictionless" in (experiment.friction, experiment.friction_base):
        yield "pull", "a frictionless plate pulls, which it cannot: it would have lifted off"


def _approach(solver: AxisymmetricSolver, target: float):
    """Steps to `target`, halved where they fail and doubled where they succeed; yields each `Step`."""
    way = target - solver.depth
    length = way
    while True:
        rest = target - solver.depth
        trial = target if abs(rest) <= abs(length) * (1 + 1e-9) else solver.depth + length
        step: Step = solver.step(trial)
        yield step
        if step.status is StepStatus.CONVERGED:
            if trial == target:
                return
            length *= 2.0
        else:
            length /= 2.0
            if abs(length) < _SMALLEST_CUT * abs(way) or way == 0.0:
                return
