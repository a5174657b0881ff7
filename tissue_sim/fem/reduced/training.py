"""Training of a reduced solid: full-order snapshots, modes and sampled elements.

The modes are the leading left singular vectors of the snapshot matrix (proper orthogonal decomposition; Sirovich,
Quart. Appl. Math. 45 (1987) 561). For a bonded tool, twelve linear elastic solutions extend the motions of the bonded
nodes (three displacements and nine entries of the rotation matrix) into the solid; the modes represent the remainder.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from tissue_sim.errors import ConvergenceError, InputError
from tissue_sim.fem.reduced.model import (
    ErrorFactors,
    PoseBox,
    ReducedModel,
    SelfWeightEquilibriumFields,
    TrainingDisplacementsAndWrenches,
)
from tissue_sim.fem.reduced.sampling import compute_sparse_weights
from tissue_sim.fem.reduced.settings import TRAINING
from tissue_sim.fem.reduced.symmetry import Symmetry, find_symmetries, split_into_involutions_and_cosets
from tissue_sim.fem.solid.discretisation import build_mesh, make_solver
from tissue_sim.fem.solid.frame import ToolFrame
from tissue_sim.fem.solid.solver import SolidSolver
from tissue_sim.fem.solver import Step, StepStatus
from tissue_sim.material.material import Material
from tissue_sim.mesh.solid import SolidMesh
from tissue_sim.model import Model
from tissue_sim.pose import Pose, interpolate_pose

#: Number of modes of a bonded tool: three displacements and the nine entries of the rotation matrix.
LIFTING = 12


def make_full_order_solver(model: Model, mesh: SolidMesh) -> SolidSolver:
    """Make the full-order solver of a model on a mesh."""
    return make_solver(model, mesh=mesh)


def get_rest_history_under_self_weight(solver: SolidSolver) -> tuple[np.ndarray, ...]:
    """Return copies of the material history at rest under self-weight; empty without self-weight."""
    return tuple(array.copy() for array in solver.tissue.state_arrays) if solver.tissue.specific_weight else ()


def simulate_snapshots(solver: SolidSolver, poses: Sequence[Pose], *, memory: Sequence[np.ndarray] = (),
                       tolerance: float = 1e-7) -> TrainingDisplacementsAndWrenches:
    """Simulate the full-order solid along poses of the tool, from rest without loading history.

    Args:
        solver: full-order solver.
        poses: poses of the tool.
        memory: material history at rest, see `get_rest_history_under_self_weight`.
        tolerance: relative residual of a step.

    Raises:
        ConvergenceError: a step did not converge with the smallest subdivision.
    """
    solver.reset_to_first_touch()
    for number, array in enumerate(solver.tissue.state_arrays):
        array[:] = memory[number] if memory else 0.0
    rest = solver.field_sample().displacement.ravel()
    displacements, wrenches, last_pose = [], [], poses[0]
    largest, doubts = 0.0, []
    for pose in poses:
        step = _step_with_subdivision(solver, last_pose, pose, tolerance)
        last_pose = pose
        displacements.append(solver.field_sample().displacement.ravel() - rest)
        wrenches.append(step.wrench)
        if (size := math.hypot(*step.wrench[:3])) > largest:
            largest, doubts = size, solver.warnings()
    return TrainingDisplacementsAndWrenches(np.array(displacements), np.array(wrenches), doubts)


def _step_with_subdivision(solver: SolidSolver, here: Pose, goal: Pose, tolerance: float) -> Step:
    """Step the full-order solver from pose `here` to `goal`, in smaller steps if needed; return the last step."""
    for cut in range(TRAINING.max_subdivisions + 1):
        count = 4**cut
        for k in range(count):
            step = solver.step(interpolate_pose(here, goal, (k + 1) / count), 0.0, tolerance=tolerance,
                               max_iterations=TRAINING.max_iterations)
            if step.status is not StepStatus.CONVERGED:
                break
        else:
            return step
        here = solver.pose
    raise ConvergenceError(f"the full-order solver did not converge at a depth of {solver.pose.depth * 1e3:.3g} mm: "
                           f"{step.status.message}. Use a smaller box", depth=solver.pose.depth)


def compute_lifting_modes(solver: SolidSolver) -> np.ndarray:
    """Compute the modes that a bonded tool prescribes: linear responses to 3 translations and 9 matrix entries.

    Returns:
        Displacements per amplitude, shape (freedoms, 12); (freedoms, 0) for a tool that can lift off. The free ones are
        0 if the tangent at rest is singular.
    """
    equations, held = solver.equations, solver.equations.held_positions_in_tool
    if not held.size:
        return np.zeros((solver.x.size, 0))
    motions = np.zeros((*held.shape, LIFTING))
    motions[:, :, :3] = np.eye(3)
    for i in range(3):
        for k in range(3):
            motions[:, i, 3 + 3 * i + k] = held[:, k]
    factor, modes = equations.reset_and_factorise_or_none(), np.zeros((solver.x.size, LIFTING))
    modes[equations.held_dofs] = motions.reshape(-1, LIFTING)
    if factor is not None:
        pushed = np.asarray(equations.matrix.all[:, equations.held_dofs] @ modes[equations.held_dofs])
        modes[equations.free] = -factor.solve(pushed[equations.free])
    return modes


def _compute_lifting_amplitudes(solver: SolidSolver, pose: Pose) -> np.ndarray:
    """Return the motion of the tool from its first touch to a pose: 3 displacements, m, and 9 matrix entries, (12,)."""
    return ToolFrame(pose, solver.datum).compute_origin_and_matrix_change_from(solver.equations.first_frame)


def compute_modes_and_singular_values(states: np.ndarray, group: Sequence[Symmetry],
                                      count: int) -> tuple[np.ndarray, np.ndarray]:
    """Compute the leading modes of displacements and their symmetric images (proper orthogonal decomposition).

    Args:
        states: displacements, m, shape (states, freedoms).
        group: symmetry group; each mode is even or odd under the involutions of its abelian subgroup
            (`split_into_involutions_and_cosets`).
        count: maximum number of modes.

    Returns:
        Modes above the noise, shape (freedoms, at most count), and all singular values, m, descending.
    """
    commuting, cosets = split_into_involutions_and_cosets(group)
    states = np.concatenate([states if one.is_identity else one.map_displacements(states) for one in cosets])
    parts = [states]
    for each in commuting:
        parts = [0.5 * (part + sign * each.map_displacements(part)) for part in parts for sign in (1.0, -1.0)]
    found = [_compute_singular_values_and_right_vectors(part, count) for part in parts]
    # The images of a state under the subgroup have equal norms, which scales the singular values.
    singular = np.sqrt(len(parts)) * np.concatenate([values for values, _ in found])
    vectors = np.concatenate([vectors for _, vectors in found])
    leading = np.concatenate([values[: len(vectors)] for values, vectors in found])
    # Symmetric modes of two parts have equal singular values; rounding makes their order reproducible.
    best = np.argsort(-np.round(np.log(np.maximum(leading, 1e-300)), 7), kind="stable")[:count]
    is_signal = leading[best] > TRAINING.singular_value_tolerance * leading[best[0]]
    return vectors[best[is_signal]].T, np.sort(singular)[::-1]


def _compute_singular_values_and_right_vectors(states: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return all singular values, descending, and at most `count` right singular vectors as rows, of values above 0."""
    # Method of snapshots: the Gram matrix of the states is much smaller than the covariance of the freedoms.
    values, vectors = np.linalg.eigh(states @ states.T)
    singular = np.sqrt(np.maximum(values[::-1], 0.0))
    count = min(count, int((singular > 1e-9 * singular[0]).sum()))
    vectors = vectors[:, ::-1][:, :count]
    # The first of the largest components is positive, so that rounding does not decide the sign.
    sizes = np.abs(vectors)
    first = (sizes >= 0.99 * sizes.max(axis=0)).argmax(axis=0)
    vectors = vectors * np.sign(vectors[first, np.arange(count)])
    return singular, (vectors / singular[:count]).T @ states


class SamplingDisplacementPoseForce(NamedTuple):
    """Full-order state that is used to choose the sampled elements.

    Attributes:
        displacement: nodal displacements, m, shape (freedoms,).
        pose: pose of the tool.
        force: norm of the force on the tool, N.
        material: material of the solid.
    """

    displacement: np.ndarray
    pose: Pose
    force: float
    material: Material


def iterate_sampling_states_of_changing_symmetry(taken: Sequence[TrainingDisplacementsAndWrenches],
                                                 poses: Sequence[Sequence[Pose]], materials: Sequence[Material],
                                                 group: Sequence[Symmetry],
                                                 start: Pose) -> Iterator[SamplingDisplacementPoseForce]:
    """Yield evenly spaced training states, each mapped by the next symmetry in turn, to choose sampled elements.

    Args:
        taken: full-order states on each training path.
        poses: poses of the tool on each training path.
        materials: material on each training path.
        group: symmetry group.
        start: first pose of the tool.
    """
    states = np.concatenate([each.displacements for each in taken])
    forces = np.linalg.norm(np.concatenate([each.wrenches[:, :3] for each in taken]), axis=1)
    of_stroke = np.repeat(np.arange(len(taken)), [len(each.wrenches) for each in taken])
    ways = [pose for each in poses for pose in each]
    # The smallest force is relative to the largest force with the same material, so that soft materials count.
    kinds = {id(material): number for number, material in enumerate(materials)}
    kind = np.array([kinds[id(material)] for material in materials])[of_stroke]
    largest = np.zeros(len(materials))
    np.maximum.at(largest, kind, forces)
    strong = np.flatnonzero(forces >= TRAINING.min_force * largest[kind])
    count = min(TRAINING.sampling_states, strong.size * len(group))
    for place, state in enumerate(strong[np.linspace(0, strong.size - 1, count).astype(int)]):
        image = group[place % len(group)]
        yield SamplingDisplacementPoseForce(image.map_displacements(states[state : state + 1])[0],
                                            image.map_pose(ways[state], start),
                                            float(forces[state]), materials[of_stroke[state]])


def choose_sampled_elements(solver: SolidSolver, basis: np.ndarray, lifting: int, watched: int,
                            looked_at: Iterable[SamplingDisplacementPoseForce], tolerance: float, bulk_ratio: float,
                            progress: Callable[[int, float], None] | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Choose elements and weights that reproduce the modal forces at the given states (`compute_sparse_weights`).

    Args:
        solver: the full-order solver; its material is restored afterwards.
        basis: displacements of all modes, shape (freedoms, modes).
        lifting: number of prescribed modes, the first ones.
        watched: number of error modes, the last ones.
        looked_at: states of `iterate_sampling_states_of_changing_symmetry`; they are projected on the modes other than
            the error modes.
        tolerance: relative error of the modal forces.
        bulk_ratio: upper limit of the bulk modulus over the shear modulus.
        progress: called with the number of elements and their relative error so far.

    Returns:
        Numbers of the elements and their weights, shape (n,) each.
    """
    mesh = solver.mesh
    scale = np.linalg.norm(basis, axis=0)
    scale[scale < 1e-12 * scale.max()] = 1.0  # some rotations do not move a flat face
    rows = (basis / scale).reshape(-1, 3, basis.shape[1])[mesh.connectivity].reshape(
        len(mesh.connectivity), -1, basis.shape[1])
    lifted, rest = basis[:, :lifting], basis[:, lifting : basis.shape[1] - watched]
    # The forces at rest balance the self-weight and are not sampled.
    borne = (solver.equations.compute_element_forces_at_displacement(0.0 * solver.x, bulk_ratio)
             if solver.tissue.specific_weight else 0.0)
    contributions, before = [], solver.material
    for state, pose, force, material in looked_at:
        if material is not solver.material:
            solver.set_material(material)
        moved = lifted @ _compute_lifting_amplitudes(solver, pose)[:lifting]
        on_nodes = solver.equations.compute_element_forces_at_displacement(
            moved + rest @ (rest.T @ (state - moved)), bulk_ratio)
        contributions.append(np.einsum("eir,ei->re", rows, on_nodes - borne) / force)
    solver.set_material(before)
    weights = compute_sparse_weights(np.concatenate(contributions), tolerance, progress=progress)
    elements = np.flatnonzero(weights)
    return elements, weights[elements]


def build_reduced_model(model: Model, mesh: SolidMesh, box: PoseBox, taken: Sequence[TrainingDisplacementsAndWrenches],
                        poses: Sequence[Sequence[Pose]], *, count: int, tolerance: float, softness: float,
                        bulk_ratio: float, materials: Sequence[Material] = (), group: Sequence[Symmetry] = (),
                        progress: Callable[[int, float], None] | None = None) -> ReducedModel:
    """Compute modes and sampled elements from snapshots and return the reduced solid.

    Args:
        model: experiment and material.
        mesh: mesh of the full-order solid.
        box: box of poses.
        taken: full-order states on each training path.
        poses: poses of the tool on each training path.
        count: number of unknown modes.
        tolerance: relative error of the modal forces of the sampled elements.
        softness: see `ReducedModel`.
        bulk_ratio: see `ReducedModel`.
        materials: material on each training path; none: the material of the model.
        group: symmetry group including the identity; none: the group is computed.
        progress: called with the number of elements and their relative error so far.
    """
    solver, start = make_full_order_solver(model, mesh), model.experiment.tool_pose(0.0)
    group = group or find_symmetries(solver, start)
    states = np.concatenate([each.displacements for each in taken])
    ways = [pose for each in poses for pose in each]
    lifted = compute_lifting_modes(solver)
    lifting = lifted.shape[1]
    amplitudes = np.array([_compute_lifting_amplitudes(solver, pose)
                           for pose in ways])[:, :lifting]
    # The prescribed part commutes with the symmetries, so the images of the remainder need no new subtraction.
    found, singular = compute_modes_and_singular_values(states - amplitudes @ lifted.T, group,
                                                        count + TRAINING.error_modes)
    basis = np.hstack([lifted, found])
    watched = max(0, found.shape[1] - count)
    looked_at = iterate_sampling_states_of_changing_symmetry(taken, poses, materials or [model.material] * len(taken),
                                                             group, start)
    elements, shares = choose_sampled_elements(solver, basis, lifting, watched, looked_at, tolerance,
                                               max(bulk_ratio, TRAINING.min_sampling_bulk_ratio), progress)
    kept = found.shape[1] - watched
    report = {"freedoms": int(states.shape[1]), "modes": kept, "elements": int(elements.size),
              "elements_of_all": len(mesh.connectivity), "snapshots": int(states.shape[0]),
              "symmetries": len(group),
              "energy_left_out": float((singular[kept:] ** 2).sum() / (singular**2).sum())}
    return ReducedModel(model, solver.mesh, basis, lifting, elements, shares, box, softness, bulk_ratio, report,
                        watched, rest=_make_rest_state_or_none(solver))


def _make_rest_state_or_none(solver: SolidSolver) -> SelfWeightEquilibriumFields | None:
    """Return the equilibrium under self-weight; None without self-weight."""
    if not solver.tissue.specific_weight:
        return None
    solver.reset_to_first_touch()
    standing = solver.field_sample()
    return SelfWeightEquilibriumFields(standing.displacement.ravel(), standing.pressures)


def with_report_and_error_factors(reduced: ReducedModel, factors: ErrorFactors, **more: Any) -> ReducedModel:
    """Return a copy with additional entries of the report and with the factors of the error estimate."""
    return replace(reduced, report={**reduced.report, **more}, error_factors=factors)


def build_training_mesh(model: Model, box: PoseBox, resolution: str) -> SolidMesh:
    """Generate the mesh of a named resolution, refined wherever the tool can touch.

    Raises:
        InputError: the box allows a tool that can lift off to leave the top of the specimen.
    """
    experiment, aside = model.experiment, box.sideways
    if experiment.friction == "bonded":
        return build_mesh(experiment, resolution, model.material.layers)
    specimen, (x, y, _) = experiment.specimen, experiment.tool_pose(0.0).position
    for corner in itertools.product((x - aside, x + aside), (y - aside, y + aside)):
        if specimen.margin(*corner) < 0.0:
            at = " and ".join(f"{1e3 * coordinate:.3g}" for coordinate in corner)
            raise InputError(f"the tool would leave the top of the specimen ({specimen.in_words}) at {at} mm. Use a "
                             "smaller box", field="box.sideways")
    # The refined region must fit into the top.
    largest_distance = TRAINING.fine_fraction * specimen.margin(x, y) - experiment.contact_radius
    return build_mesh(experiment, resolution, model.material.layers, distance=max(0.0, min(aside, largest_distance)))
