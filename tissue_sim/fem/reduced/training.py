"""Making a reduced solid: what the whole one does, the modes in it, and the elements that stand for all.

Modes are the left singular vectors of displacements (proper orthogonal decomposition; Sirovich, Quart. Appl. Math. 45
(1987) 561). What a tool holds is lifted into the solid by the elastic solutions for its twelve motions (three ways, and
the nine entries of a rotation), so that the modes need not know them.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from tissue_sim.errors import ConvergenceError, InputError
from tissue_sim.fem.reduced.model import PoseBox, ReducedModel, Rest
from tissue_sim.fem.reduced.sampling import sparse_weights
from tissue_sim.fem.reduced.solver import ReducedSolver
from tissue_sim.fem.reduced.strokes import stroke
from tissue_sim.fem.reduced.symmetry import Symmetry, parities, symmetries
from tissue_sim.fem.solid.discretisation import build_mesh, make_solver
from tissue_sim.fem.solid.elastic import element_forces, held_places, lifted_amplitudes, linear_response
from tissue_sim.fem.solid.solver import SolidSolver
from tissue_sim.fem.solver import StepStatus
from tissue_sim.material.material import Material
from tissue_sim.mesh.solid import SolidMesh
from tissue_sim.model import Model
from tissue_sim.pose import Pose, between

#: Motions of what a tool holds: three ways, and the nine entries of a rotation.
LIFTING = 12
#: Linear solves of a step of the whole solid, and parts that it is cut into where it does not come through.
_MOST_SOLVES, _CUTS = 40, 3
#: States whose forces are less than this share of the largest are left out where elements are chosen, and so many of
#: the others are looked at.
_LEAST_FORCE, _LOOKED_AT = 0.02, 240
#: Elements are sampled with a bulk modulus over mu0 of at least this: with a softer one more are taken (195 in place of
#: 169), and the force is no better.
_SAMPLED_AT = 100.0
#: Of the way to the edge of the top, how far elements are as fine as under the tool, at most.
_ROOM = 0.9
#: States are solved to 1e-7 of their forces: modes below this share of the strongest are noise, which nothing resists.
_NOISE = 1e-6
#: Motions that are watched beside the modes, for the estimate of the error; an even number of them.
WATCHED = 4
#: Steps of the reduced solid on the way of one of the whole.
_FINER = 8
#: Strokes on which a reduced solid is tried are those from here on.
UNSEEN = 5000


@dataclass(frozen=True, eq=False)
class Snapshots:
    """What the whole solid did on a stroke.

    Attributes:
        displacements: of all freedoms at each pose, from where nobody touches it, m, shape (poses, freedoms).
        wrenches: on the tool, N and N m, shape (poses, 6).
        doubts: see `Solver.warnings`, where the force is largest; not kept in files.
    """

    displacements: np.ndarray
    wrenches: np.ndarray
    doubts: Sequence[str] = ()


def whole_solver(model: Model, mesh: SolidMesh) -> SolidSolver:
    """The solver of the whole solid."""
    return make_solver(model, mesh=mesh)


def settled_memory(solver: SolidSolver) -> tuple[np.ndarray, ...]:
    """What a solid that weighs remembers where nobody has touched it; none of one that does not."""
    return tuple(array.copy() for array in solver.tissue.kept) if solver.tissue.specific_weight else ()


def snapshots(solver: SolidSolver, poses: Sequence[Pose], *, memory: Sequence[np.ndarray] = (),
              tolerance: float = 1e-7) -> Snapshots:
    """Take the whole solid along poses, from a specimen that nobody has touched.

    Args:
        memory: see `settled_memory`.

    Raises:
        ConvergenceError: a step did not converge however small.
    """
    solver.lift_off()
    for number, array in enumerate(solver.tissue.kept):
        array[:] = memory[number] if memory else 0.0
    rest = solver.sample().displacement.ravel()
    displacements, wrenches, here = [], [], poses[0]
    largest, doubts = 0.0, []
    for pose in poses:
        for part in _parts(solver, here, pose, tolerance):
            step = part
        here = pose
        displacements.append(solver.sample().displacement.ravel() - rest)
        wrenches.append(step.wrench)
        if (size := math.hypot(*step.wrench[:3])) > largest:
            largest, doubts = size, solver.warnings()
    return Snapshots(np.array(displacements), np.array(wrenches), doubts)


def _parts(solver: SolidSolver, here: Pose, goal: Pose, tolerance: float) -> Iterator:
    """The steps to a pose, in parts where one does not come through."""
    for cut in range(_CUTS + 1):
        count = 4**cut
        for k in range(count):
            step = solver.step(between(here, goal, (k + 1) / count), 0.0, tolerance=tolerance,
                               max_iterations=_MOST_SOLVES)
            if step.status is not StepStatus.CONVERGED:
                break
        else:
            yield step
            return
        here = solver.pose
    raise ConvergenceError(f"the whole solid found no equilibrium {solver.pose.depth * 1e3:.3g} mm deep: "
                           f"{step.status.message}; make the box smaller", depth=solver.pose.depth)


def lifted_modes(solver: SolidSolver) -> np.ndarray:
    """What the motions of the tool do to the resting solid whose nodes it holds, shape (freedoms, 12), or (freedoms, 0)
    of a tool that holds none."""
    held = held_places(solver)
    if not held.size:
        return np.zeros((solver.x.size, 0))
    motions = np.zeros((*held.shape, LIFTING))
    motions[:, :, :3] = np.eye(3)
    for i in range(3):
        for k in range(3):
            motions[:, i, 3 + 3 * i + k] = held[:, k]
    return linear_response(solver, motions.reshape(-1, LIFTING))


def modes(states: np.ndarray, group: Sequence[Symmetry], count: int) -> tuple[np.ndarray, np.ndarray]:
    """The most important modes of displacements and their images.

    Args:
        states: displacements, m, shape (states, freedoms).
        group: symmetries; each mode is even or odd under those that are their own inverses and commute.
        count: of modes, at most.

    Returns:
        Modes, shape (freedoms, count) or fewer where the rest is noise, and all singular values, m, descending.
    """
    commuting, cosets = parities(group)
    states = np.concatenate([states if one.is_identity else one.displacements(states) for one in cosets])
    parts = [states]
    for each in commuting:
        parts = [0.5 * (part + sign * each.displacements(part)) for part in parts for sign in (1.0, -1.0)]
    found = [_singular(part, count) for part in parts]
    # Each state has an image of the same energy for each combination of signs.
    singular = np.sqrt(len(parts)) * np.concatenate([values for values, _ in found])
    vectors = np.concatenate([vectors for _, vectors in found])
    leading = np.concatenate([values[: len(vectors)] for values, vectors in found])
    # Images of one mode in two of the parts are equally strong; rounding must not choose which comes first.
    best = np.argsort(-np.round(np.log(np.maximum(leading, 1e-300)), 7), kind="stable")[:count]
    return vectors[best[leading[best] > _NOISE * leading[best[0]]]].T, np.sort(singular)[::-1]


def _singular(states: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Singular values of states, descending, and at most `count` right singular vectors as rows, of those above 0."""
    # Of few long rows the small matrix of their products has the same singular values.
    values, vectors = np.linalg.eigh(states @ states.T)
    singular = np.sqrt(np.maximum(values[::-1], 0.0))
    count = min(count, int((singular > 1e-9 * singular[0]).sum()))
    vectors = vectors[:, ::-1][:, :count]
    # Nor must rounding choose their signs: the first of the largest components is positive.
    sizes = np.abs(vectors)
    first = (sizes >= 0.99 * sizes.max(axis=0)).argmax(axis=0)
    vectors = vectors * np.sign(vectors[first, np.arange(count)])
    return singular, (vectors / singular[:count]).T @ states


class Sample(NamedTuple):
    """A state at which elements are looked at.

    Attributes:
        displacement: m, shape (freedoms,). pose: of the tool. force: on it, N. material: of which the solid was.
    """

    displacement: np.ndarray
    pose: Pose
    force: float
    material: Material


def samples(taken: Sequence[Snapshots], poses: Sequence[Sequence[Pose]], materials: Sequence[Material],
            group: Sequence[Symmetry], start: Pose) -> Iterator[Sample]:
    """States at which elements are looked at: spread over all, by symmetries in turn.

    Args:
        taken: what the solid did on each stroke. poses: of each. materials: of which it was on each.
        group: symmetries. start: of the tool.
    """
    states = np.concatenate([each.displacements for each in taken])
    forces = np.linalg.norm(np.concatenate([each.wrenches[:, :3] for each in taken]), axis=1)
    of_stroke = np.repeat(np.arange(len(taken)), [len(each.wrenches) for each in taken])
    ways = [pose for each in poses for pose in each]
    # Of soft materials among stiff ones, too.
    kinds = {id(material): number for number, material in enumerate(materials)}
    kind = np.array([kinds[id(material)] for material in materials])[of_stroke]
    largest = np.zeros(len(materials))
    np.maximum.at(largest, kind, forces)
    strong = np.flatnonzero(forces >= _LEAST_FORCE * largest[kind])
    count = min(_LOOKED_AT, strong.size * len(group))
    for place, state in enumerate(strong[np.linspace(0, strong.size - 1, count).astype(int)]):
        image = group[place % len(group)]
        yield Sample(image.displacements(states[state : state + 1])[0], image.pose(ways[state], start),
                     float(forces[state]), materials[of_stroke[state]])


def sample_elements(solver: SolidSolver, basis: np.ndarray, lifting: int, watched: int,
                    looked_at: Iterable[Sample], tolerance: float, bulk_ratio: float,
                    progress: Callable[[int, float], None] | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Elements that stand for all, and for how many each: their forces on the modes, the last `watched` ones, too, at
    the states that the others hold, with a bulk modulus of at most so many times the shear modulus.

    Args:
        looked_at: see `samples`.

    Returns:
        Numbers and shares, shape (n,).
    """
    mesh = solver.mesh
    scale = np.linalg.norm(basis, axis=0)
    scale[scale < 1e-12 * scale.max()] = 1.0  # a flat face has no height that a rotation could move
    rows = (basis / scale).reshape(-1, 3, basis.shape[1])[mesh.connectivity].reshape(
        len(mesh.connectivity), -1, basis.shape[1])
    lifted, rest = basis[:, :lifting], basis[:, lifting : basis.shape[1] - watched]
    # What the weight bears is not the modes' business.
    borne = element_forces(solver, 0.0 * solver.x, bulk_ratio) if solver.tissue.specific_weight else 0.0
    contributions, before = [], solver.material
    for state, pose, force, material in looked_at:
        if material is not solver.material:
            solver.set_material(material)
        moved = lifted @ lifted_amplitudes(solver, pose)[:lifting]
        on_nodes = element_forces(solver, moved + rest @ (rest.T @ (state - moved)), bulk_ratio)
        contributions.append(np.einsum("eir,ei->re", rows, on_nodes - borne) / force)
    solver.set_material(before)
    weights = sparse_weights(np.concatenate(contributions), tolerance, progress=progress)
    elements = np.flatnonzero(weights)
    return elements, weights[elements]


#: One of so many modes is left out of a second reduced solid on which the estimate of the error is calibrated.
_FEWER = 4


def verify(reduced: ReducedModel, solver: SolidSolver, numbers: Sequence[int],
           progress: Callable[[int, int], None] | None = None, *, materials: Sequence[Material] = (),
           memory: Sequence[np.ndarray] = ()) -> tuple[dict[str, Any], tuple[float, float]]:
    """How far the reduced solid is from the whole one on strokes that it was not made of, of these materials in turn,
    or of its own; `memory` as in `snapshots`.

    Returns:
        ``force_rms_error`` and ``force_largest_error`` over the rms force of the whole with the same material, the rms
        force of all, ``force_rms_N``, and
        ``not_converged``, the share of steps that were not, and where the whole solid has some ``warnings`` (see
        `Solver.warnings`); and ``error_factors`` that fit, see `ReducedModel`.
    """
    from scipy.optimize import nnls

    experiment = reduced.model.experiment
    # With fewer modes too, so that more of the error is that of modes than of elements.
    more = (reduced.basis.shape[1] - reduced.lifting - reduced.watched) // _FEWER
    small, fewer = (ReducedSolver(replace(reduced, watched=reduced.watched + each, error_factors=(1.0, 0.0)),
                                  reduced.model.material) for each in (0, more if reduced.watched else 0))
    missed, forces, estimates, kinds, lost, steps = [], [], [], [], 0, 0
    others: list[tuple[float, float, float]] = []
    doubts: Sequence[str] = ()
    for done, number in enumerate(numbers):
        for each in (solver, small, fewer) if materials else ():
            if each.material is not (material := materials[done % len(materials)]):
                each.set_material(material)
        poses = stroke(number, reduced.box, experiment.tool_pose(0.0), holds=reduced.lifting > 0,
                       reach=experiment.contact_radius)
        whole = snapshots(solver, poses, memory=memory)
        true, doubts = whole.wrenches, whole.doubts or doubts
        for each in (small, fewer):
            each.forget()
        here = poses[0]
        for pose, wrench in zip(poses, true, strict=True):
            for k in range(_FINER):
                there = between(here, pose, (k + 1) / _FINER)
                step, coarse = small.step(there), fewer.step(there)
                steps += 1
                lost += step.status is not StepStatus.CONVERGED
            here = pose
            missed.append(np.subtract(step.wrench[:3], wrench[:3]))
            forces.append(wrench[:3])
            kinds.append(done % max(1, len(materials)))
            estimates.append(step.force_error or 0.0)
            others.append((coarse.force_error or 0.0, float(np.linalg.norm(wrench[:3])),
                           float(np.linalg.norm(np.subtract(coarse.wrench[:3], wrench[:3])))))
        if progress:
            progress(done + 1, len(numbers))
    error, force = (np.linalg.norm(np.array(each), axis=1) for each in (missed, forces))
    # Over the rms force with the same material, so that a soft one counts like a stiff one.
    of_kind = [np.sqrt(np.mean(force[np.array(kinds) == kind] ** 2)) for kind in range(max(kinds) + 1)]
    rms = np.array(of_kind)[kinds]
    known = np.concatenate([np.column_stack([estimates, force, error]), others]) / np.tile(rms, 2)[:, None]
    factors, _ = nnls(known[:, :2], known[:, 2])
    return {"force_rms_error": float(np.sqrt(np.mean((error / rms) ** 2))),
            "force_largest_error": float((error / rms).max()), "force_rms_N": float(np.sqrt(np.mean(force**2))),
            "not_converged": lost / steps, **({"warnings": list(doubts)} if doubts else {})}, (
        float(factors[0]), float(factors[1]))


def assemble(model: Model, mesh: SolidMesh, box: PoseBox, taken: Sequence[Snapshots],
             poses: Sequence[Sequence[Pose]], *, count: int, tolerance: float, softness: float, bulk_ratio: float,
             materials: Sequence[Material] = (), group: Sequence[Symmetry] = (),
             progress: Callable[[int, float], None] | None = None) -> ReducedModel:
    """The reduced solid that snapshots along strokes and their images give.

    Args:
        model, mesh, box: of the solid.
        taken: what it did; poses: on which poses.
        count: modes beside the lifted ones; tolerance: of the forces of the sampled elements over those of all.
        softness, bulk_ratio: see `ReducedModel`.
        materials: of which it was on each stroke; none: of the model's.
        group: symmetries of the solid, the identity among them; none: they are looked for.
        progress: called with the number of elements and their error so far.
    """
    solver, start = whole_solver(model, mesh), model.experiment.tool_pose(0.0)
    group = group or symmetries(solver, start)
    states = np.concatenate([each.displacements for each in taken])
    ways = [pose for each in poses for pose in each]
    lifted = lifted_modes(solver)
    lifting = lifted.shape[1]
    amplitudes = np.array([lifted_amplitudes(solver, pose) for pose in ways])[:, :lifting]
    # What a tool lifts has the symmetries of the solid, so that images of the rest are the rest of the images.
    found, singular = modes(states - amplitudes @ lifted.T, group, count + WATCHED)
    basis = np.hstack([lifted, found])
    watched = max(0, found.shape[1] - count)
    looked_at = samples(taken, poses, materials or [model.material] * len(taken), group, start)
    elements, shares = sample_elements(solver, basis, lifting, watched, looked_at, tolerance,
                                       max(bulk_ratio, _SAMPLED_AT), progress)
    kept = found.shape[1] - watched
    report = {"freedoms": int(states.shape[1]), "modes": kept, "elements": int(elements.size),
              "elements_of_all": len(mesh.connectivity), "snapshots": int(states.shape[0]),
              "symmetries": len(group),
              "energy_left_out": float((singular[kept:] ** 2).sum() / (singular**2).sum())}
    return ReducedModel(model, solver.mesh, basis, lifting, elements, shares, box, softness, bulk_ratio, report,
                        watched, rest=_rest(solver))


def _rest(solver: SolidSolver) -> Rest | None:
    """How a solid stands that weighs."""
    if not solver.tissue.specific_weight:
        return None
    solver.lift_off()
    standing = solver.sample()
    return Rest(standing.displacement.ravel(), standing.pressures)


def with_report(reduced: ReducedModel, factors: tuple[float, float], **more: Any) -> ReducedModel:
    """With more in its report, and factors of its estimate of the error."""
    return replace(reduced, report={**reduced.report, **more}, error_factors=factors)


def training_mesh(model: Model, box: PoseBox, resolution: str) -> SolidMesh:
    """The mesh of a named resolution, fine wherever the tool can touch.

    Raises:
        InputError: a tool that can lift off goes aside to where no top is under it.
    """
    experiment, aside = model.experiment, box.sideways
    if experiment.friction == "bonded":
        return build_mesh(experiment, resolution, model.material.layers)
    specimen, (x, y, _) = experiment.specimen, experiment.tool_pose(0.0).position
    for corner in itertools.product((x - aside, x + aside), (y - aside, y + aside)):
        if specimen.margin(*corner) < 0.0:
            at = " and ".join(f"{1e3 * place:.3g}" for place in corner)
            raise InputError(f"the tool would go beyond the specimen, {specimen.in_words}: there is none under it at "
                             f"{at} mm; make the box smaller", field="box.sideways")
    # Rings that fit into the top.
    room = _ROOM * specimen.margin(x, y) - experiment.contact_radius
    return build_mesh(experiment, resolution, model.material.layers, distance=max(0.0, min(aside, room)))
