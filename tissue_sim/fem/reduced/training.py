"""Training of a reduced solid: paths of the tool, full-order snapshots, modes and sampled elements.

The modes are the leading left singular vectors of the snapshot matrix (proper orthogonal decomposition; Sirovich,
Quart. Appl. Math. 45 (1987) 561). For a bonded tool, twelve linear elastic solutions extend the motions of the bonded
nodes (three displacements and nine entries of the rotation matrix) into the solid; the modes represent the remainder.

Hyper-reduction is energy-conserving sampling and weighting (ECSW): the reduced forces Phi' f = sum over all elements of
Phi_e' f_e are approximated by a weighted sum over few elements, sum of w_e Phi_e' f_e with w_e >= 0, which keeps the
stiffness symmetric and the energy consistent (Farhat, Avery, Chapman and Cortial, Int. J. Numer. Meth. Engng 98 (2014)
625). The sparse weights are a non-negative least-squares solution by the active-set method of Lawson and Hanson with
early termination (Chapman et al., Int. J. Numer. Meth. Engng 109 (2017) 1623).

On the path of a tool that can lift off, the tool indents the tissue, is dragged and rotated to a second pose and lifts
off. A bonded tool moves through two poses and returns to its start. The poses of path n are point n of the Sobol
sequence (Joe and Kuo, SIAM J. Sci. Comput. 30 (2008) 2635; in SciPy), so that the paths are reproducible.

Points of the Sobol sequence do not lie on the boundary of the box. The boundary paths do: one at each corner and one at
the midpoint of each edge, at the full depth of the box.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
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
from tissue_sim.fem.reduced.settings import TRAINING, TrainingPathDepthAndStepSettings
from tissue_sim.fem.reduced.symmetry import Symmetry, find_symmetries, split_into_involutions_and_cosets
from tissue_sim.fem.solid.contact import ToolFrame
from tissue_sim.fem.solid.discretisation import build_mesh, make_solver
from tissue_sim.fem.solid.solver import SolidSolver
from tissue_sim.fem.solver import Step, StepStatus
from tissue_sim.material.material import Material
from tissue_sim.mesh.solid import SolidMesh
from tissue_sim.model import Model
from tissue_sim.pose import Pose, compute_rigid_motion, interpolate_pose, rotate_pose_about_its_position

#: Maximum number of passes of the inner loop per element that enters the active set.
_MAX_INNER_PASSES = 1000


def compute_sparse_weights(contributions: np.ndarray, tolerance: float, most: int | None = None,
                           progress: Callable[[int, float], None] | None = None) -> np.ndarray:
    """Compute sparse non-negative weights w that satisfy |G w - G 1| <= tolerance |G 1|.

    Args:
        contributions: matrix G, contribution of each element to each reduced force, shape (forces, elements).
        tolerance: relative error of the weighted sum.
        most: maximum number of elements with a positive weight; None: no limit.
        progress: called with the number of chosen elements and the relative error after each iteration.

    Returns:
        Weights, mostly 0, shape (elements,).
    """
    count = contributions.shape[1]
    most = count if most is None else min(most, count)
    goal = contributions.sum(axis=1)
    scale = float(np.linalg.norm(goal))
    if scale == 0.0:
        return np.ones(count)
    # The normal equations lose half of the digits; the tolerance is far above this loss.
    gram, right = contributions.T @ contributions, contributions.T @ goal
    weights, chosen = np.zeros(count), np.zeros(count, dtype=bool)
    while True:
        slope = right - gram @ weights
        error = float(np.sqrt(max(scale**2 - weights @ (right + slope), 0.0))) / scale
        if progress:
            progress(int(chosen.sum()), error)
        slope[chosen] = -np.inf
        best = int(np.argmax(slope))
        if error <= tolerance or chosen.sum() >= most or not slope[best] > 0.0:
            return weights
        chosen[best] = True
        for _ in range(_MAX_INNER_PASSES):
            active = np.flatnonzero(chosen)
            block = gram[np.ix_(active, active)]
            solution = np.linalg.lstsq(block, right[active], rcond=1e-12)[0] if len(active) < 3 else (
                np.linalg.solve(block + 1e-12 * np.trace(block) / len(active) * np.eye(len(active)), right[active]))
            if (solution > 0.0).all():
                weights[:] = 0.0
                weights[active] = solution
                break
            # Go towards the solution until the first weight reaches zero; its element leaves the active set.
            now, falls = weights[active], solution <= 0.0
            step = float(np.min(now[falls] / np.maximum(now[falls] - solution[falls], 1e-300)))
            weights[active] = now + step * (solution - now)
            leaving = active[weights[active] <= 1e-14 * weights.max(initial=1e-300)]
            weights[leaving], chosen[leaving] = 0.0, False
            if not leaving.size:
                break


#: Dimension of the Sobol sequence: two poses, each of position (3) and rotation (3).
_DIMENSION = 12
_PATHS = TrainingPathDepthAndStepSettings()


def make_training_path(number: int, box: PoseBox, start: Pose, *, holds: bool, reach: float) -> list[Pose]:
    """Return the poses of a training path, at most one step apart.

    Args:
        number: number of the path in the Sobol sequence, from 0.
        box: box of poses relative to `start`.
        start: first pose of the tool.
        holds: whether the tool is bonded to the tissue from the start.
        reach: contact radius, m.
    """
    from scipy.stats import qmc

    coordinates = qmc.Sobol(_DIMENSION, scramble=False).fast_forward(number + 1).random(1)[0]
    first, second = (_map_coordinates_to_box_pose(part, box, start, holds)
                     for part in (coordinates[:6], coordinates[6:]))
    if holds:
        corners = [start, first, second, start]
    else:
        above = _move_vertically_to_depth(first, start, 0.0)
        corners = [_move_vertically_to_depth(first, start, -0.1 * box.depth), above, first, second,
                   _move_vertically_to_depth(second, start, 0.0)]
    return _interpolate_path(corners, reach)


def make_boundary_training_paths(box: PoseBox, start: Pose, *, holds: bool, reach: float,
                                 images: Sequence[np.ndarray] = (), fraction: float = 1.0) -> list[list[Pose]]:
    """Return the poses of the training paths along the boundary of a box, in order of corners and edges.

    At a corner the tool indents to the full depth, tilts outward by the largest rotation of the box and is dragged
    along an edge. At the midpoint of an edge the tool indents, tilts outward and is dragged to the centre of the box.

    Args:
        box: box of poses relative to `start`.
        start: first pose of the tool.
        holds: whether the tool is bonded to the tissue from the start.
        reach: contact radius, m.
        images: matrices of the symmetries, shape (3, 3) each. Only the first of several symmetric paths is returned.
        fraction: factor on the sizes of the box; below 1 the paths stay inside the box.
    """
    small = PoseBox(fraction * box.sideways, fraction * box.depth, fraction * box.turn)
    paths = []
    for corner, goal in _iterate_boundary_points_and_goals(box.sideways + box.turn > 0.0, images):
        lean = (-small.turn * corner[1] / math.hypot(*corner), small.turn * corner[0] / math.hypot(*corner), 0.0) \
            if any(corner) else (0.0, 0.0, 0.0)
        upright, end = (_make_deepest_pose(small, start, point) for point in (corner, goal))
        leaning = rotate_pose_about_its_position(upright, lean)
        corners = [start, upright, leaning, end, start] if holds else [
            _move_vertically_to_depth(upright, start, -0.1 * box.depth), _move_vertically_to_depth(upright, start, 0.0),
            upright, leaning,
            end, _move_vertically_to_depth(end, start, 0.0)]
        paths.append(_interpolate_path(corners, reach))
    return paths


def make_reversing_paths(box: PoseBox, start: Pose, *, reach: float, images: Sequence[np.ndarray] = (),
                         fraction: float = 1.0) -> list[list[Pose]]:
    """Return paths on which the tool moves obliquely to the boundary of a box and back along the same line.

    The lateral motion reverses in contact, which reverses the friction. The paths lead from above the start to the full
    depth at each corner and at the midpoint of each edge; the arguments are those of `make_boundary_training_paths`.
    """
    small = PoseBox(fraction * box.sideways, fraction * box.depth)
    return [_interpolate_path([_move_vertically_to_depth(start, start, -0.1 * box.depth), start,
                               _make_deepest_pose(small, start, point), start], reach)
            for point, _ in _iterate_boundary_points_and_goals(box.sideways > 0.0, images)]


def _iterate_boundary_points_and_goals(is_wide: bool, images: Sequence[np.ndarray]
                                       ) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
    """Yield pairs of an indentation point, a corner or edge midpoint of a square, and the goal of the drag there.

    Coordinates are -1, 0 or 1. A box without width has only its centre.
    """
    if not is_wide:
        yield (0, 0), (0, 0)
        return
    seen: set[tuple[int, int]] = set()
    for x, y in ((1, 1), (-1, 1), (-1, -1), (1, -1), (1, 0), (0, 1), (-1, 0), (0, -1)):
        if (x, y) not in seen:
            seen |= {(round(a), round(b)) for a, b, _ in (matrix @ (x, y, 0.0) for matrix in images)}
            yield (x, y), ((x, 0) if x * y else (0, 0))


def _make_deepest_pose(box: PoseBox, start: Pose, point: tuple[int, int]) -> Pose:
    """Return the upright pose at the full depth of the box; `point`: lateral position over `box.sideways`."""
    x, y, z = start.position
    return Pose((x + box.sideways * point[0], y + box.sideways * point[1], z - box.depth), start.orientation)


def _interpolate_path(corners: Sequence[Pose], reach: float) -> list[Pose]:
    """Return poses along straight motions between corner poses.

    The largest distance of two poses is `TrainingPathDepthAndStepSettings.step`.
    """
    poses = [corners[0]]
    for one, other in pairwise(corners):
        x, y, z, *turn = compute_rigid_motion(one, other)
        count = math.ceil((math.hypot(x, y, z) + reach * math.hypot(*turn)) / (_PATHS.step * reach) - 1e-9)
        poses += [interpolate_pose(one, other, (k + 1) / count) for k in range(count)]
    return poses


def _map_coordinates_to_box_pose(coordinates: np.ndarray, box: PoseBox, start: Pose, holds: bool) -> Pose:
    """Return the pose of the box with these normalised coordinates, 0 to 1, shape (6,)."""
    x, y, z, angle, a, b = coordinates
    least = 0.0 if holds else _PATHS.min_depth
    depth = box.depth * (least + (1.0 - least) * z)
    x0, y0, z0 = start.position
    position = (x0 + box.sideways * (2.0 * x - 1.0), y0 + box.sideways * (2.0 * y - 1.0), z0 - depth)
    # The rotation axis is uniform on the sphere; `angle` scales the rotation about it.
    height, around = 2.0 * a - 1.0, 2.0 * math.pi * b
    flat = math.sqrt(max(0.0, 1.0 - height * height))
    size = box.turn * angle
    vector = (size * flat * math.cos(around), size * flat * math.sin(around), size * height)
    return rotate_pose_about_its_position(Pose(position, start.orientation), vector)


def _move_vertically_to_depth(pose: Pose, start: Pose, depth: float) -> Pose:
    """Return a copy of a pose moved vertically to another depth below `start`, m."""
    x, y, _ = pose.position
    return Pose((x, y, start.position[2] - depth), pose.orientation)


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
