"""Offline simulation of a whole test: from a model to a recording, with an estimated error of the force.

The error is estimated from the same test on another mesh and in other time steps. Two effects have a reduced form:
partial slip of a bonded face is an interpolation between the bonded and the frictionless test, and the force of a
tilted face is the force of an upright face, averaged over strips of the tilted face.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol

import numpy as np

from tissue_sim.errors import ConvergenceError, InputError
from tissue_sim.experiment.experiment import Experiment
from tissue_sim.fem.solver import SOLVERS, Solver, Step, StepStatus
from tissue_sim.fem.stepping import STEPS_TO_POSE
from tissue_sim.laws import find_stability_range
from tissue_sim.model import Model
from tissue_sim.pose import Screw
from tissue_sim.recording.curve_units import FORCE_UNITS, UNITS_OF_LOAD, CurveUnits
from tissue_sim.recording.recording import Recording
from tissue_sim.rig.loading_curve import FirstLoadingCurveWithHistory
from tissue_sim.tool_drive import ToolDrive


@dataclass(frozen=True)
class ForceErrorWarningSettings:
    """Settings of the warning of an inaccurate force.

    Attributes:
        warning_fraction: error over the largest force above which a warning is given, 1.
        range_fraction: the warning names the range of samples where the error exceeds this fraction of its maximum, 1.
    """

    warning_fraction: float = 0.025
    range_fraction: float = 0.5


#: Settings of all simulations.
FORCE_ERROR = ForceErrorWarningSettings()


@dataclass(frozen=True)
class RelativeForceErrorEstimate:
    """Estimated error of the force of a simulated test, relative to the largest force, and where the error is large.

    Attributes:
        fraction: largest error as a fraction of the largest force.
        first, last: numbers of the samples between which the error exceeds half of its maximum.
        compared: number of the last compared sample; after it the error is unknown.
        shorter: whether the comparison test has steps a quarter as long; otherwise its steps are twice as long.
    """

    fraction: float
    first: int
    last: int
    compared: int
    shorter: bool = False

    def warning_or_none(self, displacement: np.ndarray, remedy: str, units: CurveUnits = FORCE_UNITS) -> str | None:
        """Return the warning of a large error or of an error that is unknown from a sample on; None: no warning.

        Args:
            displacement: of all samples, m, shape (n,); or angle, rad.
            remedy: what the user can do about a large error.
            units: units of the motion and the load.
        """
        if self.compared < displacement.size - 1:
            return (f"the error of the {units.load_name} is unknown after sample {self.compared + 1} of "
                    f"{displacement.size} ({units.format_motion(displacement[self.compared], 3)}), because the "
                    "simulations on another mesh did not converge; the error of the earlier samples is about "
                    f"{100 * self.fraction:.2g} % of the largest {units.load_name}; use more samples")
        if self.fraction <= FORCE_ERROR.warning_fraction:
            return None
        there = displacement[self.first: self.last + 1]
        places = units.format_motion(there[-1], 3) if self.first == self.last else (
            f"{units.motion_factor * there.min():.3g} to {units.format_motion(there.max(), 3)}")
        seen = "in steps a quarter as long it differs by three quarters of that" if self.shorter else \
            "in other steps it differs by as much"
        return (f"the {units.load_name} may err by about {100 * self.fraction:.2g} % of its largest at {places}: on "
                f"another mesh and {seen}; {remedy}")


def select_fractional_samples_for_longer_steps(displacement: np.ndarray) -> np.ndarray:
    """Select the samples of a motion at which a comparison test with longer steps is computed.

    These are every second sample, so that the steps are twice as long; the first and the last; those at which the
    motion turns, stops or starts; and after each turn the middle and the end of the first step: an error in the slip
    that begins there is gone one sample later, and a longer step would miss it.

    Args:
        displacement: m, shape (n,).

    Returns:
        Sample numbers, ascending; a half is in the middle between two samples.
    """
    direction = np.sign(np.diff(displacement))
    kept, turned = [0.0], False
    for sample in range(1, displacement.size):
        last = sample == displacement.size - 1
        turns = not last and bool(direction[sample] != direction[sample - 1])
        if turned:
            kept.append(sample - 0.5)
        if turned or turns or last or sample - kept[-1] >= 2:
            kept.append(float(sample))
        turned = turns and bool(direction[sample] != 0)
    return np.array(kept)


def estimate_error_from_two_forces_or_none(force: np.ndarray, samples: np.ndarray, other: np.ndarray, fraction: float,
                                           *, shorter: bool = False) -> RelativeForceErrorEstimate | None:
    """Estimate the error of the force of a test from its difference to another simulation of the test.

    Args:
        force: of the test, N, shape (n,).
        samples: numbers of the samples that the other test has too.
        other: force of the other test at these samples, N; shorter than `samples` if that test ended early.
        fraction: error of this test as a fraction of the difference.
        shorter: whether the steps of the other test are shorter.

    Returns:
        The error; None if there are no common samples, or if the force is zero.
    """
    samples, largest = samples[: other.size], float(abs(force).max(initial=0.0))
    if not samples.size or largest == 0.0:
        return None
    error = fraction * abs(force[samples] - other) / largest
    worst = first = last = int(np.argmax(error))
    is_large = error > FORCE_ERROR.range_fraction * error[worst]
    while first > 0 and is_large[first - 1]:
        first -= 1
    while last + 1 < samples.size and is_large[last + 1]:
        last += 1
    return RelativeForceErrorEstimate(float(error[worst]), int(samples[first]), int(samples[last]), int(samples[-1]),
                                      shorter)


def blend_bonded_and_frictionless_recordings(held: Recording, free: Recording, share: float) -> Recording:
    """Combine the recordings of bonded and frictionless faces to that of faces that slip in part.

    F = (1 - share) F_bonded + share F_frictionless: each part of the face carries the force that the whole face would
    carry with the same interface.

    Args:
        held: recording with bonded faces.
        free: recording with frictionless faces, at the same samples.
        share: fraction of the faces that slips, 0 to 1.
    """
    one, other = (each.metadata.get("solver", {}) for each in (held, free))
    errors = [report.get("force_error") for report in (one, other)]
    report = one | {"force_error": None if None in errors else max(errors),
                    "warnings": list(dict.fromkeys([*one.get("warnings", ()), *other.get("warnings", ())]))}
    held = replace(held, metadata={**held.metadata, "solver": report})
    names = (name for name in held.channels if name not in ("time", "displacement") and name in free.channels)
    return held.with_channels(**{name: (1.0 - share) * held.channels[name] + share * free.channels[name]
                                 for name in names})


#: Number of strips.
_POINTS = 32


def compute_tilted_recording(recording: Recording, tilt: float, depth: np.ndarray) -> Recording:
    """Compute the recording of a test with a tilted face from the recording with an upright face.

    The tool touches on its lower side first. A strip of the face at the distance x from the axis, in radii, is
    tilt (1 - x)/2 behind the side that touches first, so that

        F(d) = integral of F0(max(d - tilt (1 - x)/2, 0)) 2/pi sqrt(1 - x^2) dx over -1 to 1.

    The strips are independent, and the history of each is that of the upright face. For a force in proportion to the
    depth the result is a toe region of about the tilt, and then a constant lag of half the tilt.

    Args:
        recording: recording of the upright face.
        tilt: height difference across the face, m; 0 returns the recording itself.
        depth: displacement of the tool from the touch, m, shape (n,); the reported displacement may have another zero.
    """
    if not tilt:
        return recording
    curve = FirstLoadingCurveWithHistory(recording.with_channels(displacement=depth))
    samples = np.arange(recording.force.size, dtype=float)
    force = sum(share * curve.solve_force_on_compliant_rig(_compute_depth_after_lag(depth, lag), 0.0, samples)
                for lag, share in split_tilted_face_into_strips(tilt))
    return recording.with_channels(force=force)


def split_tilted_face_into_strips(tilt: float) -> list[tuple[float, float]]:
    """Return lag behind the side that touches first, m, and fraction of the area, for each strip of a tilted face."""
    # Gauss-Chebyshev quadrature of the second kind, whose weight is the width of the disc.
    angle = np.arange(1, _POINTS + 1) * np.pi / (_POINTS + 1)
    shares = 2.0 / (_POINTS + 1) * np.sin(angle) ** 2
    return list(zip((0.5 * tilt * (1.0 - np.cos(angle))).tolist(), shares.tolist(), strict=True))


def _compute_depth_after_lag(displacement: np.ndarray, lag: float) -> np.ndarray:
    """Return the depth, m, of a strip that touches the tissue later; above the touch all strips are in the air."""
    return np.where(displacement > 0, np.maximum(displacement - lag, 0.0), displacement)


@dataclass(frozen=True)
class SimulationSettings:
    """Settings of the steps of a whole test.

    Attributes:
        rough_tolerance: relative residual of the second solution for the error estimate, 1.
        most_to_compare: largest ratio of the linear solves of the second solution to those of the first, 1.
        always_to_compare: number of linear solves that the second solution may use in any case.
        contact_radius_ratio: largest ratio, or its inverse, of the reached contact radius to that of the mesh; beyond
            it a new mesh is made.
        most_meshes: maximum number of meshes in the search for the depth.
        smallest_depth_ratio: smallest ratio of the depth of a mesh to that of the mesh before.
        bisections: number of bisections in the estimate of the first depth.
    """

    rough_tolerance: float = 1e-3
    most_to_compare: int = 4
    always_to_compare: int = 400
    contact_radius_ratio: float = 1.5
    most_meshes: int = 4
    smallest_depth_ratio: float = 0.1
    bisections: int = 50


_SETTINGS = SimulationSettings()
#: Remedy in the warning of a large error; `_REMEDIES` for single resolutions.
_REMEDY = 'more samples show it'
_REMEDIES = {"fast": 'the resolution "accurate" or more samples show it'}
#: Channels of a wrench with other components than a force along z.
_WRENCH = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")


class SolverObserver(Protocol):
    """Observer of a solver during a test."""

    def before_first_step(self, solver: Solver) -> None:
        """Prepare for the test; called once before the first step of `solver`."""

    def after_sample(self, solver: Solver, factor: float) -> None:
        """Called after each sample; the force of the test is `factor` times that of the solver."""


def simulate(model: Model, *, resolution: str = "fast", mesh: Any = None, fields: bool = False,
             progress: Callable[[int, int], None] | None = None, watch: SolverObserver | None = None,
             solver: str = "axisymmetric", topology: Model | None = None, estimate_error: bool = True) -> Recording:
    """Simulate a whole test quasi-statically.

    A protocol of displacements is the motion that the rig's stage reports; with a compliant load train the displacement
    of the tool is found together with its force. A prescribed force is the force that the load cell reads; the
    displacement of each sample is found by a secant method with the tolerance
    `tissue_sim.tool_drive.ToolSearchSettings.force_tolerance`. For faces that slip in part the bonded and the
    frictionless test are simulated, each with its own load train; fields are those of the bonded one. The law's stress
    is linear between samples.

    The error of the force, at the displacements of the recording, is estimated from a second solution on another mesh
    with every second sample, if the solver has such a mesh; more than `ForceErrorWarningSettings.warning_fraction` of
    the largest force gives a warning. The estimate doubles the time with ``"fast"`` and adds about a fifth with
    ``"accurate"``.

    Args:
        model: experiment, material, rig.
        resolution: ``"fast"``, ``"accurate"``, or another name of the solver.
        mesh: mesh to use instead.
        fields: keep the converged fields of every sample in ``recording.fields``.
        progress: called with (samples done, all samples), first before the kernels are compiled.
        watch: observer of the solver.
        solver: name in `tissue_sim.fem.solver.SOLVERS`.
        topology: model of another geometry whose mesh (or `mesh`, which belongs to it) is used with moved nodes, so
            that a change of geometry does not change the elements.
        estimate_error: whether the error of the force is estimated; never on a given mesh.

    Returns:
        Recording at the times of the protocol, with its labels, as the rig reports it. The displacement is that along
        the tool's direction of motion, and the force is the component opposite to this direction, as a load cell on the
        stage measures it; for a grip that rotates, the channels are angle and torque. If the wrench has other
        components than a force along z, the channels Fx to Tz contain it in the frame of the scene.
        ``metadata["solver"]`` contains status, message, warnings, force_error (over the largest force; None if
        unknown), newton_iterations (linear solves), cuts, residual (the largest), dissipated_J (by artificial damping),
        wall_s, element, mesh and resolution; with a prescribed force largest_tool_displacement_mm; with contact
        penetration_mm (the largest violation of a contact condition) and penetration_tolerance_mm; with friction
        slipping_points (the largest number); with self-weight self_weight {density_kg_m3, gravity_m_s2, height_is,
        sag_mm, moulded_height_mm}; of a gripped specimen ends, "bonded to rigid grips": unlike in the closed form of
        such a test the deformation is not homogeneous.

    Raises:
        ConvergenceError: the smallest step did not converge, or no displacement gives a prescribed force; `recording`
            contains the converged part.
        InputError: an unknown solver or resolution, a bulk response or layers that the solver does not support, or a
            prescribed force with partial slip, a tilted face, or an effect of the rig without a model in force control.
        MissingBackendError: Taichi is not installed.
    """
    started = time.perf_counter()
    protocol, rig = model.experiment.protocol, model.rig
    rig.count_readings(protocol.time)  # raises its errors before the simulation
    if protocol.uses_force_control:
        _require_support_of_force_control(model)
        model = _expect_reached_depth(model, resolution=resolution, mesh=mesh, solver=solver, topology=topology)
    if share := model.experiment.slip:
        held, free = (
            simulate(replace(model, experiment=experiment, rig=rig.with_motion_effects_only), resolution=resolution,
                     mesh=mesh, fields=fields, progress=follow, watch=watched, solver=solver, topology=topology,
                     estimate_error=estimate_error)
            for experiment, follow, watched in ((replace(model.experiment, slip=None), progress, watch),
                                                (model.experiment.with_slipping_faces_frictionless(), None, None)))
        return rig.read(blend_bonded_and_frictionless_recordings(held, free, share))
    tissue = SOLVERS.find(solver, "solver")(model, resolution=resolution, mesh=mesh, topology=topology)
    if watch:
        watch.before_first_step(tissue)
    wrenches, travels, samples = list[Screw](), list[float](), list[Any]()
    report = _make_report_without_steps(tissue, model.experiment)
    report["resolution"] = resolution if mesh is None else "own mesh"

    def make_recording(status: str, message: str) -> Recording:
        done, wrench, (motion, load) = len(wrenches), np.array(wrenches).reshape(-1, 6), model.experiment.channels
        solved = {"status": status, "message": message, **report}
        solved.setdefault("wall_s", time.perf_counter() - started)
        channels = {"time": drive.protocol.time[:done], motion: np.array(drive.reported),
                    load: np.array([model.experiment.compute_force_against_motion(one) for one in wrenches])}
        if wrench[:, [0, 1, 3, 4, 5]].any():
            channels |= zip(_WRENCH, wrench.T, strict=True)
        true = Recording(channels, labels={name: values[:done] for name, values in drive.protocol.labels.items()},
                         metadata={"name": "simulation", "solver": solved},
                         fields=tissue.fields(samples) if fields else None)
        return rig.read(compute_tilted_recording(true, model.experiment.tilt, np.array(travels)))

    if progress:
        progress(0, protocol.time.size)
    drive, largest = ToolDrive(tissue, model), 0.0
    for sample, (goal, dt, steps) in enumerate(drive.iterate_goals_durations_and_steps()):
        for step in steps:
            report["newton_iterations"] += step.iterations
            report["cuts"] += step.status is not StepStatus.CONVERGED
            report["dissipated_J"] += step.dissipated
        if step.status is not StepStatus.CONVERGED:
            reached = model.experiment.compute_displacement_on_path(tissue.pose, near=drive.travel)
            message = _describe_failure(drive, model, step, reached, f"{goal} (sample {sample + 1})")
            solved = make_recording("not_converged", message) if wrenches else None
            raise ConvergenceError(message, recording=solved, depth=tissue.pose.depth)
        _store_larger_values_in_report(report, step)
        wrenches.append(drive.register_sample_and_scale_wrench(step.wrench, dt))
        vector = wrenches[-1][3:] if protocol.prescribes_angle else wrenches[-1][:3]
        if (size := math.hypot(*vector)) >= largest:
            largest, report["warnings"] = size, list(tissue.warnings())
        travels.append(drive.travel)
        if protocol.uses_force_control:
            report["largest_tool_displacement_mm"] = 1e3 * max(travels)
        if watch:
            watch.after_sample(tissue, drive.combined_force_factor)
        if fields:
            samples.append(tissue.field_sample())
        if progress:
            progress(sample + 1, drive.protocol.time.size)
    report["wall_s"] = time.perf_counter() - started  # without the error estimate
    if estimate_error and mesh is None:
        forces = np.array([model.experiment.compute_force_against_motion(one) for one in wrenches])
        _store_force_error_in_report(report, tissue, drive, model, forces, solver, resolution, topology)
    cuts = f", step cuts: {report['cuts']}" if report["cuts"] else ""
    return make_recording("converged", f"converged at every sample{cuts}")


def _make_report_without_steps(tissue: Solver, experiment: Experiment) -> dict[str, Any]:
    """Return ``metadata["solver"]`` before the first step; see `simulate`."""
    report = {"warnings": [], "force_error": None, "newton_iterations": 0, "cuts": 0, "residual": 0.0,
              "dissipated_J": 0.0, **tissue.get_recording_metadata()}
    if experiment.grip is not None:
        report["ends"] = "bonded to rigid grips"
    if "self_weight" in report:
        specimen = experiment.specimen
        report["self_weight"] = {"density_kg_m3": specimen.density, "gravity_m_s2": specimen.gravity,
                                 "height_is": specimen.height_is, **report["self_weight"]}
    return report


def _describe_failure(drive: ToolDrive, model: Model, step: Step, depth: float, goal: str) -> str:
    """Return the message of a test whose last step did not converge.

    Args:
        drive: motion of the tool.
        model: model of the test.
        step: last step.
        depth: displacement, m, or angle, rad, that was reached.
        goal: description of the sample that was not reached.
    """
    cause = drive.failure or f"the step cut to {STEPS_TO_POSE.smallest_cut:.1g} of its length: {step.status.message}"
    message = f"stopped at {model.experiment.format_displacement(depth)} on the way to {goal}, {cause}"
    stability = find_stability_range(model.material.energy_law, model.material.values)
    if step.status is StepStatus.INDEFINITE or not stability.is_stable_in_whole_range:
        message += f"; the law alone is {stability}"
    return message


def _store_force_error_in_report(report: dict, tissue: Solver, drive: ToolDrive, model: Model, force: np.ndarray,
                                 solver: str, resolution: str, topology: Model | None) -> None:
    """Store the estimated error of the force, and the warning of a large error, in `report`, in place.

    The arguments are those of `_estimate_force_error`.
    """
    most = max(_SETTINGS.always_to_compare, _SETTINGS.most_to_compare * report["newton_iterations"])
    found = _estimate_force_error(tissue, drive, model, force, solver, resolution, topology, most)
    if found is None:
        return
    if found.compared == force.size - 1:
        report["force_error"] = found.fraction
    warning = found.warning_or_none(np.array(drive.reported), _REMEDIES.get(resolution, _REMEDY),
                                    UNITS_OF_LOAD[model.experiment.channels[1]])
    if warning is not None:
        report["warnings"] = [warning, *report["warnings"]]


def _estimate_force_error(tissue: Solver, driven: ToolDrive, model: Model, force: np.ndarray, solver: str,
                          resolution: str, topology: Model | None,
                          most_solves: int) -> RelativeForceErrorEstimate | None:
    """Estimate the error of a force from a second solution along the same displacements on another mesh.

    The steps of the second solution are twice as long. If the error is worth a warning, or if the second solution ends
    early, a third solution in quarter steps on the other mesh is used. The solver of the first solution is `tissue`,
    its motion is `driven`, its force at each sample is `force`, N, shape (n,). The second and the third solution have
    at most `most_solves` linear solves each. The other arguments are those of `simulate`.

    Returns:
        None if the solver has no other mesh, or if no other solution reaches a sample.
    """
    estimate, protocol = tissue.error_estimation_rule(resolution), driven.make_followed_protocol()
    if estimate is None:
        return None

    def simulate_forces(samples: np.ndarray) -> np.ndarray:
        """Return the forces at fractional sample numbers, N, from a second solution, up to its first failed step."""
        other, solves = [], 0
        resampled = replace(model.experiment, protocol=protocol.resample_at_fractional_samples(samples))
        along = replace(model, experiment=resampled)
        try:
            drive = ToolDrive(SOLVERS.find(solver, "solver")(along, resolution=estimate.resolution, topology=topology),
                              along, tolerance=_SETTINGS.rough_tolerance)
        except ConvergenceError:
            return np.zeros(0)
        for _, dt, steps in drive.iterate_goals_durations_and_steps():
            for step in steps:
                solves += step.iterations
            if step.status is not StepStatus.CONVERGED or solves > most_solves:
                break
            wrench = drive.register_sample_and_scale_wrench(step.wrench, dt)
            other.append(model.experiment.compute_force_against_motion(wrench))
        return np.array(other)

    samples = select_fractional_samples_for_longer_steps(driven.compute_prescribed_motion())
    other = simulate_forces(samples)
    common = np.flatnonzero(samples[:other.size] % 1.0 == 0.0)
    found = estimate_error_from_two_forces_or_none(force, samples[common].astype(int), other[common], estimate.fraction)
    if found is not None and found.compared == force.size - 1 and found.fraction <= FORCE_ERROR.warning_fraction:
        return found
    # A step in which contact begins again may err by many times more than a step half as long. Errors in proportion to
    # the step length are 4/3 times the difference to steps a quarter as long; other errors are at most as large.
    other = simulate_forces(0.25 * np.arange(4 * protocol.time.size - 3))[::4]
    again = estimate_error_from_two_forces_or_none(force, np.arange(force.size), other, 4.0 / 3.0 * estimate.fraction,
                                                   shorter=True)
    known = [each for each in (found, again) if each is not None]
    return min(known, key=lambda each: (-each.compared, each.fraction), default=None)


def _require_support_of_force_control(model: Model) -> None:
    """Refuse effects that have no model in a test with a prescribed force.

    Raises:
        InputError: partial slip, a tilted face, or an effect of the rig.
    """
    for name in ("slip", "tilt"):
        if value := getattr(model.experiment, name):
            raise InputError(f"must be 0 with a prescribed force; got {value:g}. Leave it out, or prescribe the "
                             "displacement", field=f"experiment.{name}")
    model.rig.require_support_of_force_control()


def _expect_reached_depth(model: Model, **options: Any) -> Model:
    """Return the model of a force-controlled test whose mesh suits the depth that the tool reaches.

    The contact radius of a rounded tool grows with its depth. The depth is first estimated by Hertz's formula, and then
    taken from a simulation whose contact radius is near that of its mesh. A stated `Protocol.expected_depth` is kept.
    On a given mesh without contact laws and drainage the estimate suffices, because nothing else depends on the radius.

    Args:
        model: model with a force-controlled protocol.
        options: arguments of `simulate`.

    Raises:
        ConvergenceError: see `simulate`.
    """
    experiment, depth = model.experiment, _estimate_depth_under_largest_force(model)
    contact = partial(experiment.tool.contact_radius, specimen_radius=experiment.specimen.margin())
    if experiment.protocol.expected_depth is not None or contact(depth) == contact(0.5 * depth):
        return model
    uses_radius = bool(experiment.acting_laws) or model.material.poroelasticity is not None
    for _ in range(_SETTINGS.most_meshes if uses_radius or options["mesh"] is None else 0):
        expected = replace(experiment, protocol=replace(experiment.protocol, expected_depth=depth))
        model = replace(model, experiment=expected)
        reached = simulate(model, estimate_error=False, **options).metadata["solver"]["largest_tool_displacement_mm"]
        ratio = contact(depth) / contact(depth := max(1e-3 * reached, _SETTINGS.smallest_depth_ratio * depth))
        if max(ratio, 1.0 / ratio) <= _SETTINGS.contact_radius_ratio:
            break
    return replace(model, experiment=replace(experiment, protocol=replace(experiment.protocol, expected_depth=depth)))


def _estimate_depth_under_largest_force(model: Model) -> float:
    """Estimate the displacement of the tool under the largest known force of a protocol, m.

    F = 16/3 mu a(d) d is Hertz's formula for an incompressible half-space with the contact radius a(d).
    """
    experiment, forces = model.experiment, model.experiment.protocol.force
    force = float(np.max(np.abs(forces[~np.isnan(forces)]), initial=0.0))
    low, high = 0.0, 0.5 * experiment.thickness
    for _ in range(_SETTINGS.bisections):
        depth = 0.5 * (low + high)
        radius = experiment.tool.contact_radius(depth, experiment.specimen.margin())
        low, high = (depth, high) if 16.0 / 3.0 * model.material.mu0 * radius * depth < force else (low, depth)
    return max(high, experiment.protocol.depth)


def _store_larger_values_in_report(report: dict, step: Step) -> None:
    """Replace the maxima over all samples in `report`, in place, by larger values of one step."""
    for name, value in (("residual", step.residual), ("penetration_mm", step.violation * 1e3),
                        ("slipping_points", step.slipping)):
        if name in report:
            report[name] = max(report[name], value)
