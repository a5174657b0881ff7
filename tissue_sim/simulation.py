"""Offline simulation of a whole test: model in, recording out."""

from __future__ import annotations

import time
from collections.abc import Callable

from tissue_sim.discretisation import build_mesh, build_solver, sag
from tissue_sim.errors import ConvergenceError
from tissue_sim.experiment import Experiment, Model
from tissue_sim.fem.axisymmetric import AxisymmetricSolver, Step
from tissue_sim.fem.fields import Fields
from tissue_sim.fem.newton import StepStatus
from tissue_sim.laws import check_stability
from tissue_sim.mesh import Mesh
from tissue_sim.recording import Recording

#: A step is cut until it is this small a part of the way between two samples.
_SMALLEST_CUT = 2.0**-10


def simulate(model: Model, *, resolution: str = "fast", mesh: Mesh | None = None, fields: bool = False,
             progress: Callable[[int, int], None] | None = None) -> Recording:
    """Simulate a whole test quasi-statically.

    Args:
        model: experiment, material, rig.
        resolution: ``"fast"`` or ``"accurate"``, see `tissue_sim.discretisation`.
        mesh: a mesh of your own instead.
        fields: keep the converged fields of every sample in ``recording.fields``.
        progress: called with (samples done, samples in all); the first call comes before the kernels are compiled.

    Returns:
        Recording at the times of the protocol, as the model's rig reports it. ``metadata["solver"]`` holds status,
        message, warnings, newton_iterations (linear solves), cuts, residual (the largest), wall_s, element, mesh and
        resolution; of a needle also penetration_mm (the deepest) and penetration_tolerance_mm; of a specimen that
        weighs also self_weight {density_kg_m3, gravity_m_s2, height_is, sag_mm, moulded_height_mm}.

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
    if solver.contact is not None:
        report |= {"penetration_mm": 0.0, "penetration_tolerance_mm": solver.contact.tolerance * 1e3}
    specimen = model.experiment.specimen
    if specimen.specific_weight:
        height = -float(solver.mesh.nodes[:, 1].min())
        report["self_weight"] = {"density_kg_m3": specimen.density, "gravity_m_s2": specimen.gravity,
                                 "height_is": specimen.height_is, "sag_mm": sag(solver) * 1e3,
                                 "moulded_height_mm": height * 1e3}

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
        if solver.contact is not None:
            report["penetration_mm"] = max(report["penetration_mm"], step.penetration * 1e3)
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
    plate = experiment.tool.shape == "plate"
    base, top = mesh.nodes[:, 1].min(), solver.start[2 * mesh.sets["top"] + 1].max() - solver.depth
    slack = -1e-4 * base
    if (plate and z.max() > top + slack) or z.min() < base - slack:
        yield "bulge", "the bulging side passes a plate, which would hold it back: the force is too low there"
    if plate and solver.depth < 0 and force < 0 and "frictionless" in (experiment.friction, experiment.friction_base):
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
