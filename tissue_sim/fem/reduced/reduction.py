"""Model reduction of a solid: training paths, modes, sampled elements and verification, resumable after a stop.

The estimate of the error by missing compliance is calibrated on the training paths, and verified on test paths. A
reduced solid with friction has an estimate of the lateral error.
"""

from __future__ import annotations

import hashlib
import io
import math
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from tissue_sim.errors import InputError, located_and_converted_errors
from tissue_sim.fem.reduced import training
from tissue_sim.fem.reduced.model import (
    PoseBox,
    ReducedModel,
    calibrate_accepted_missing_forces,
    require_compatible_layers_and_regions,
    require_reducible,
)
from tissue_sim.fem.reduced.response import MissingComplianceErrorEstimator, reset_and_compute_compliance_table
from tissue_sim.fem.reduced.settings import VERIFICATION
from tissue_sim.fem.reduced.solver import ReducedSolver
from tissue_sim.fem.reduced.symmetry import find_symmetries
from tissue_sim.fem.reduced.training import (
    TrainingDisplacementsAndWrenches,
    make_boundary_training_paths,
    make_reversing_paths,
    make_training_path,
    simulate_snapshots,
)
from tissue_sim.fem.solid.solver import SolidSolver
from tissue_sim.fem.solver import Step, StepStatus
from tissue_sim.files import read_text, write_bytes
from tissue_sim.material.material import Material
from tissue_sim.model import Model
from tissue_sim.pose import Pose, interpolate_pose


def verify_and_get_report_and_factors(reduced: ReducedModel, solver: SolidSolver, strokes: Sequence[Sequence[Pose]],
                                      progress: Callable[[int, int], None] | None = None, *,
                                      materials: Sequence[Material] = (),
                                      memory: Sequence[np.ndarray] = ()) -> tuple[dict[str, Any], tuple[float, float]]:
    """Compare the reduced with the full-order solid on test paths, and calibrate the error estimate.

    Non-negative least squares fit the error factors to the error beyond the estimate by missing compliance. The factors
    are then enlarged until the estimate covers enough states, see `find_covering_factor`.

    Args:
        reduced: the reduced solid.
        solver: the full-order solver.
        strokes: poses of each test path.
        progress: called with the number of finished paths and the number of all paths.
        materials: materials that are used in turn; none: the present material.
        memory: material history at rest, see `get_rest_history_under_self_weight`.

    Returns:
        The report and the first two error factors of `ReducedModel`. The report contains ``force_rms_error`` and
        ``force_largest_error`` over the rms force with the same material, ``force_rms_N``, the rms force over all
        paths, ``not_converged``, the fraction of failed steps, and ``warnings`` of the full-order solver if any.
    """
    from scipy.optimize import nnls

    # A second solid with fewer modes adds states whose error is caused by modes rather than by sampled elements.
    more = (reduced.basis.shape[1] - reduced.lifting - reduced.watched) // VERIFICATION.modes_per_omitted_mode
    table = reduced.compliance
    plain = replace(reduced, error_factors=(1.0, 0.0, 0.0),
                    compliance=None if table is None else table.unlimited_acceptance_copy)
    small, fewer = (ReducedSolver(replace(plain, watched=reduced.watched + each), reduced.model.material)
                    for each in (0, more if reduced.watched else 0))
    missed, forces, estimates, explained, kinds, lost, steps = [], [], [], [], [], 0, 0
    others: list[tuple[float, float, float]] = []
    doubts: Sequence[str] = ()
    for done, poses in enumerate(strokes):
        for each in (solver, small, fewer) if materials else ():
            if each.material is not (material := materials[done % len(materials)]):
                each.set_material(material)
        whole = simulate_snapshots(solver, poses, memory=memory)
        true, doubts = whole.wrenches, whole.doubts or doubts
        for each in (small, fewer):
            each.reset_to_rest()
        here = poses[0]
        for pose, wrench in zip(poses, true, strict=True):
            for k in range(VERIFICATION.substeps):
                there = interpolate_pose(here, pose, (k + 1) / VERIFICATION.substeps)
                step, coarse = small.step(there), fewer.step(there)
                steps += 1
                lost += step.status is not StepStatus.CONVERGED
            here = pose
            missed.append(np.subtract(step.wrench[:3], wrench[:3]))
            forces.append(wrench[:3])
            kinds.append(done % max(1, len(materials)))
            estimates.append(step.force_error or 0.0)
            explained.append(0.0 if table is None or small.missing_force is None else max(
                0.0, small.missing_force.compute_missing_axial_force()
                - table.get_accepted_missing_force_at_tool_force(float(np.linalg.norm(step.wrench[:3])))))
            others.append((coarse.force_error or 0.0, float(np.linalg.norm(wrench[:3])),
                           float(np.linalg.norm(np.subtract(coarse.wrench[:3], wrench[:3])))))
        if progress:
            progress(done + 1, len(strokes))
    error, force = (np.linalg.norm(np.array(each), axis=1) for each in (missed, forces))
    # Relative to the rms force with the same material, so that soft and stiff materials have equal weight.
    of_kind = [np.sqrt(np.mean(force[np.array(kinds) == kind] ** 2)) for kind in range(max(kinds) + 1)]
    rms = np.array(of_kind)[kinds]
    largest = np.array([force[np.array(kinds) == kind].max() for kind in range(max(kinds) + 1)])[kinds]
    left = np.maximum(0.0, error - explained)
    known = np.concatenate([np.column_stack([estimates, force, left]), others]) / np.tile(rms, 2)[:, None]
    factors, _ = nnls(known[:, :2], known[:, 2])
    factors *= max(1.0, find_covering_factor(known[: len(error), :2] @ factors, left / rms,
                                             VERIFICATION.substantial_error * largest / rms))
    return {"force_rms_error": float(np.sqrt(np.mean((error / rms) ** 2))),
            "force_largest_error": float((error / rms).max()), "force_rms_N": float(np.sqrt(np.mean(force**2))),
            "not_converged": lost / steps, **({"warnings": list(doubts)} if doubts else {})}, (
        float(factors[0]), float(factors[1]))


def find_covering_factor(estimates: np.ndarray, errors: np.ndarray, substantial: np.ndarray) -> float:
    """Return the smallest factor c with which c estimate + negligible error covers enough of the errors.

    The fraction `VerificationSettings.coverage` of all states is covered, and every state with a substantial error.

    Args:
        estimates: estimated errors over the rms force, shape (states,). States with an estimate of zero are left out.
        errors: true errors over the rms force, shape (states,).
        substantial: errors over the rms force above which each state is covered, shape (states,).

    Returns:
        The factor; 0 without a positive estimate, or if the negligible error covers enough states.
    """
    known = estimates > 0.0
    if not known.any():
        return 0.0
    ratios = (errors[known] - VERIFICATION.negligible_error) / estimates[known]
    required = ratios[errors[known] > substantial[known]]
    return float(max(0.0, np.quantile(ratios, VERIFICATION.coverage), required.max(initial=0.0)))


def simulate_reduced_path(small: ReducedSolver, poses: Sequence[Pose]) -> Iterator[Step]:
    """Simulate a reduced solid from rest along poses of the tool, and yield the step that ends at each pose."""
    small.reset_to_rest()
    for last_pose, pose in zip([poses[0], *poses], poses, strict=False):
        for k in range(VERIFICATION.substeps):
            step = small.step(interpolate_pose(last_pose, pose, (k + 1) / VERIFICATION.substeps))
        yield step


def with_calibrated_compliance_table(reduced: ReducedModel, solver: SolidSolver, poses: Sequence[Sequence[Pose]],
                                     snapshots: Sequence[TrainingDisplacementsAndWrenches],
                                     materials: Sequence[Material]) -> ReducedModel:
    """Return a copy of a reduced solid with the calibrated compliance table of its contact nodes.

    The reduced solid is simulated along the training paths. Its missing force and its true force error give the
    missing forces that are accepted, see `calibrate_accepted_missing_forces`. A reduced solid with a bonded tool is
    returned unchanged.

    Args:
        reduced: the reduced solid.
        solver: full-order solver with the material of the model; it is at rest afterwards.
        poses: poses of each training path.
        snapshots: full-order states on each training path.
        materials: material on each training path.
    """
    if reduced.lifting:
        return reduced
    nodes = np.sort(solver.contact.nodes[solver.contact.moves])
    table = reset_and_compute_compliance_table(reduced, solver, nodes)
    small = ReducedSolver(replace(reduced, compliance=table), reduced.model.material)
    missing_force = MissingComplianceErrorEstimator(table, small.contact)
    forces, missing, errors = [], [], []
    for path, full_order, material in zip(poses, snapshots, materials, strict=True):
        if material is not small.material:
            small.set_material(material)
        for step, wrench in zip(simulate_reduced_path(small, path), full_order.wrenches, strict=True):
            if step.status is StepStatus.CONVERGED and small.contact.has_touching_nodes:
                force = np.array(step.wrench[:3])
                forces.append(float(np.linalg.norm(force)))
                missing.append(missing_force.compute_missing_axial_force())
                errors.append(float(np.linalg.norm(force - wrench[:3])))
    return replace(reduced, compliance=calibrate_accepted_missing_forces(table, forces, missing, errors))


def calibrate_lateral_error_to_force_ratio(reduced: ReducedModel, solver: SolidSolver, paths: Sequence[Sequence[Pose]],
                                           materials: Sequence[Material], *,
                                           memory: Sequence[np.ndarray] = ()) -> float:
    """Compute the ratio of the lateral force error and the largest lateral force since the first touch.

    With friction, the force depends on the path. On paths with a reversal, the lateral error stays about constant while
    the lateral force decreases; the error modes and the missing compliance (`MissingComplianceErrorEstimator`) estimate
    the error at the present contact forces only and become small. The largest lateral force since the first touch
    scales with the error on such paths. An indentation along the axis has almost no lateral force, so that its estimate
    hardly changes.

    The product of the factor and the largest lateral force, plus the negligible error, covers the lateral errors on
    the paths as `find_covering_factor` states. It is added to the estimate at the present contact forces.

    Args:
        reduced: the reduced solid.
        solver: full-order solver.
        paths: poses of the tool on paths with a reversal of the lateral motion.
        materials: materials that are used in turn.
        memory: material history at rest, see `get_rest_history_under_self_weight`.

    Returns:
        The factor; 0 for a bonded tool, without friction, and without a lateral force.
    """
    small = ReducedSolver(reduced, reduced.model.material)
    if reduced.lifting or not small.contact.has_friction or not reduced.box.sideways:
        return 0.0
    axis = np.array(reduced.model.experiment.tool_pose(0.0).rotation_matrix)[:, 2]
    largest, errors, substantial = [], [], []
    for number, path in enumerate(paths):
        for each in (solver, small):
            if each.material is not (material := materials[number % len(materials)]):
                each.set_material(material)
        forces = simulate_snapshots(solver, path, memory=memory).wrenches[:, :3]
        norms = np.linalg.norm(forces, axis=1)
        rms = np.sqrt(np.mean(norms**2))
        for step, force in zip(simulate_reduced_path(small, path), forces, strict=True):
            error = np.subtract(step.wrench[:3], force)
            lateral = float(small.contact.largest_lateral[0])
            if step.status is StepStatus.CONVERGED and lateral > VERIFICATION.negligible_error * rms:
                largest.append(lateral / rms)
                errors.append(float(np.linalg.norm(error - (error @ axis) * axis)) / rms)
                substantial.append(VERIFICATION.substantial_error * norms.max() / rms)
    return find_covering_factor(np.array(largest), np.array(errors), np.array(substantial))


#: Number of training paths without symmetry, for a bonded tool (True) and a tool that can lift off (False).
STROKES = {True: 24, False: 60}
#: Number of unknown modes, for a bonded tool (True) and a tool that can lift off (False).
MODES = {True: 24, False: 64}
#: Upper limit of the bulk modulus over mu0, for a tool that always touches the same nodes (True) and for a tool that
#: slides (False). The modes of sliding contact change the volume of the tissue more.
BULK_RATIO = {True: 300.0, False: 50.0}
#: Smallest and largest permitted value of `bulk_ratio`; above the largest value steps do not converge.
BULK_RATIOS = (1.0, 1000.0)
#: Largest factor by which symmetry reduces the number of training paths, for a bonded tool (True) and a tool that can
#: lift off (False). The response with friction depends on the path, so that images help less.
_SYMMETRY_SAVING = {True: 4, False: 2}


class ReductionProgressCallback(Protocol):
    """Callback that receives the progress of a reduction."""

    def __call__(self, stage: str, done: int, of: int, *, note: str = "") -> None:
        """Report that `done` of `of` parts of a stage are finished; `note`: text for the user."""


def reduce_solid(model: Model, box: PoseBox, *, resolution: str = "realtime", strokes: int | None = None,
                 modes: int | None = None, sampling: float = training.TRAINING.sampling_error,
                 bulk_ratio: float | None = None, softness: float = training.TRAINING.softness,
                 also: Sequence[Material] = (), tried: int = VERIFICATION.test_paths,
                 folder: Path | None = None,
                 progress: ReductionProgressCallback | None = None) -> ReducedModel:
    """Reduce a solid for real-time simulation of a tool that stays in a box of poses.

    Args:
        model: experiment and material.
        box: box of poses relative to the first pose of the experiment's approach.
        resolution: named resolution of the full-order mesh.
        strokes: number of training paths, for all materials together; None: chosen from the symmetry of the solid. Each
            path also contributes its symmetric images.
        modes: number of unknown modes; None: chosen by the kind of contact.
        sampling: relative error of the modal forces of the sampled elements.
        bulk_ratio: upper limit of the bulk modulus over mu0; None: chosen by the kind of contact. A value below that of
            the tissue makes forces too small; a value above what the modes can represent makes them too large.
        softness: thickness of the contact layer over the contact radius, see `ReducedModel`.
        also: further materials for which the reduced solid must be accurate; the training paths use the materials in
            turn. Their layers and regions must equal those of the model.
        tried: number of test paths that are not used for training; at least one for each material.
        folder: folder of the finished training paths. A folder with paths of the same model is resumed.
            `remove_training_path_files` removes the files after the reduced solid is saved.
        progress: called in the stages ``"strokes"``, ``"elements"`` and ``"trial"``.

    Raises:
        InputError: a reduced solid does not support the model, `bulk_ratio` is outside `BULK_RATIOS`, or the folder
            belongs to another model.
        ConvergenceError: the full-order solver did not converge on a training path.
    """
    experiment = model.experiment
    holds = experiment.friction == "bonded"
    slides = not holds and box.sideways + box.turn > 0.0
    bulk_ratio = BULK_RATIO[not slides] if bulk_ratio is None else bulk_ratio
    low, high = BULK_RATIOS
    if not low <= bulk_ratio <= high:
        raise InputError(f"must be {low:g} to {high:g}; got {bulk_ratio:g}",
                         field="bulk_ratio")
    tell: Callable[..., None] = progress or (lambda *_, **__: None)
    require_reducible(model)
    mesh = training.build_training_mesh(model, box, resolution)
    solver = training.make_full_order_solver(model, mesh)
    memory = training.get_rest_history_under_self_weight(solver)
    if also and experiment.specimen.specific_weight:
        raise InputError("must be empty for a solid with self-weight, which has one material only. Leave the further "
                         "materials or gravity out", field="also")
    materials = (model.material, *also)
    for number, each in enumerate(also):
        with located_and_converted_errors(field=f"also[{number}]"):
            require_compatible_layers_and_regions(each, model.material, mesh)
            solver.set_material(each)
    solver.set_material(model.material)
    # Checked before the folder is labelled: a wrong label would refuse the corrected request.
    if strokes is not None and strokes < len(materials):
        raise InputError(f"must be at least the number of materials, {len(materials)}; got {strokes}. Use more "
                         "training paths", field="strokes")
    # The contents of a file may change under the same name, so the label contains digests.
    digests = f" {experiment.specimen.digest_of_files}" if experiment.specimen.from_file else ""
    if experiment.tool.from_file:
        digests += f" {hashlib.sha256(experiment.tool.profile.vertices.tobytes()).hexdigest()}"
    label = f"{model!r} {box!r} {resolution} {len(mesh.nodes)}{digests} from {solver.datum:.12g} m"
    store = _TrainingPathStore(folder, f"{label} {tuple(also)!r}" if also else label)
    start, reach = experiment.tool_pose(0.0), experiment.contact_radius
    group = find_symmetries(solver, start)
    usual = len(materials) * math.ceil(STROKES[holds] / min(len(group), _SYMMETRY_SAVING[holds]))
    strokes, modes, tried = strokes or usual, modes or MODES[holds], max(tried, len(materials))
    images = [each.matrix for each in group]
    poses = [make_training_path(number, box, start, holds=holds, reach=reach) for number in range(strokes)]
    poses += make_boundary_training_paths(box, start, holds=holds, reach=reach, images=images)
    taken, count = [], len(poses)
    on_boundary = training.TRAINING.first_boundary_path
    numbers = [*range(strokes), *range(on_boundary, on_boundary + count - strokes)]
    # The materials take turns, on paths inside the box and along its boundary.
    of_stroke = [materials[number % len(materials)] for number in numbers]
    tell("strokes", 0, count)
    for number, path, material in zip(numbers, poses, of_stroke, strict=True):
        done = store.read_snapshots_or_none(number)
        if done is None or len(done.wrenches) != len(path):
            solver.set_material(material)
            done = training.simulate_snapshots(solver, path, memory=memory)
            store.write_snapshots(number, done)
        taken.append(done)
        tell("strokes", len(taken), count)
    elements_of_all = len(mesh.connectivity)
    reduced = training.build_reduced_model(
        model, mesh, box, taken, poses, count=modes, tolerance=sampling, softness=softness,
        bulk_ratio=bulk_ratio, group=group, materials=of_stroke,
        progress=lambda elements, error: tell("elements", elements, elements_of_all,
                                              note=f"error {100 * error:.2g} %"))
    solver.set_material(model.material)
    reduced = with_calibrated_compliance_table(reduced, solver, poses, taken, of_stroke)
    first = VERIFICATION.first_test_path
    unseen = [make_training_path(first + number, box, start, holds=holds, reach=reach) for number in range(tried)]
    along = make_boundary_training_paths(box, start, holds=holds, reach=reach, images=images,
                                         fraction=VERIFICATION.boundary_fraction)
    unseen += along[:: max(1, len(along) // 2)]  # a corner and an edge
    report, factors = verify_and_get_report_and_factors(reduced, solver, unseen, lambda done,
                                                        of: tell("trial", done, of), materials=materials, memory=memory)
    back = make_reversing_paths(box, start, reach=reach, images=images,
                                fraction=VERIFICATION.boundary_fraction)
    lateral = calibrate_lateral_error_to_force_ratio(reduced, solver, back[:: max(1, len(back) // 2)], materials,
                                                     memory=memory)
    return training.with_report_and_error_factors(reduced, (*factors, lateral), strokes=strokes,
                                                  boundary_strokes=count - strokes, materials=len(materials),
                                                  tried=tried, **report)


class _TrainingPathStore:
    """Store of the finished training paths of one model in a folder, one file per path.

    Args:
        folder: the folder; None: nothing is stored.
        model: text that identifies the model.

    Raises:
        InputError: the folder belongs to another model.
    """

    def __init__(self, folder: Path | None, model: str):
        self._folder = folder
        if folder is None:
            return
        label = folder / "model.txt"
        if label.exists() and read_text(label, "the model of strokes") != model:
            raise InputError("contains training paths of another model. Remove the folder, or choose another output",
                             file=folder)
        write_bytes(label, model.encode())

    def read_snapshots_or_none(self, number: int) -> training.TrainingDisplacementsAndWrenches | None:
        """Return the snapshots of a path; None if they are not stored or the file is damaged."""
        path = self._make_snapshot_file_path_or_none(number)
        if path is None or not path.exists():
            return None
        try:
            with np.load(path, allow_pickle=False) as stored:
                return training.TrainingDisplacementsAndWrenches(stored["displacements"], stored["wrenches"])
        except (ValueError, KeyError, OSError, EOFError, zipfile.BadZipFile, zlib.error):
            return None  # an unreadable file is computed again

    def write_snapshots(self, number: int, snapshots: training.TrainingDisplacementsAndWrenches) -> None:
        """Write the snapshots of a path to its file, if there is a folder."""
        path = self._make_snapshot_file_path_or_none(number)
        if path is not None:
            stream = io.BytesIO()
            np.savez(stream, displacements=snapshots.displacements, wrenches=snapshots.wrenches)
            write_bytes(path, stream.getvalue())

    def _make_snapshot_file_path_or_none(self, number: int) -> Path | None:
        """Return the path of the file of a training path; None without a folder."""
        return None if self._folder is None else self._folder / f"stroke_{number:04d}.npz"


def remove_training_path_files(folder: Path) -> None:
    """Remove the training-path files of `reduce_solid` from a folder, and the folder if it is then empty."""
    for path in [*folder.glob("stroke_*.npz"), folder / "model.txt"]:
        path.unlink(missing_ok=True)
    if folder.exists() and not any(folder.iterdir()):
        folder.rmdir()
