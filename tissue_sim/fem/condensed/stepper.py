"""Frictional contact of a tool with a bulk condensed to the contact nodes (Schur complement), step by step.

Each increment alternates between `TangentPlaneContact`, which decides the contact states on the tangent planes of the
tool, and Newton's method for the curved contact with these states. The contact forces are unknowns; gap and stick
conditions are enforced by an augmented Lagrangian with a penalty stiffness for each node.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.fem.condensed.flat_contact import TangentPlaneContact
from tissue_sim.fem.condensed.kernel import (
    ANSWER_SIZE,
    CONTACT_ARRAYS,
    WrenchKernelEntryIndex,
    make_bond_commit_and_wrench_kernel,
    make_contact_iteration_kernel,
)
from tissue_sim.fem.condensed.model import CondensedBulk, ContactState, ContactSurface
from tissue_sim.fem.condensed.tables import (
    LIST_COLUMNS,
    LOCAL_COLUMNS,
    MAX_FREEDOMS,
    NODE_COLUMNS,
    RESULT_COUNT,
    RIGHT_HAND_SIDES,
    SETTING_COUNT,
    STATE_COLUMNS,
    KernelSetting,
    LinearisedContactColumn,
    NodeForceAndAnchorColumn,
    NodeListColumn,
)
from tissue_sim.fem.contact.pairs import ContactBondState
from tissue_sim.fem.stepping import AdaptiveIncrements
from tissue_sim.fem.taichi.launch import BoundKernel
from tissue_sim.fem.taichi.origins import allocate_array, copy_to_addressable_array
from tissue_sim.fem.taichi.runtime import LANES, LOCK
from tissue_sim.pose import Pose, Screw, compute_pose_distance, compute_rigid_motion, interpolate_pose
from tissue_sim.tool_force import Matrix


@dataclass(frozen=True)
class StepperSettings:
    """Settings of `CondensedStepper`.

    Attributes:
        max_iterations: maximum number of contact iterations of an increment.
        max_exact_iterations: maximum number of contact iterations of an increment in an exact step.
        max_flat_iterations: number of iterations in which the linear equations keep the contact states that
            `TangentPlaneContact` found.
        flat_gap: nodes with a gap below this fraction of the contact radius take part in the flat contact.
        flat_tolerance: relative residual of the flat contact.
        near_gap: nodes with a gap above this fraction of the contact radius are not evaluated until the tool or the
            tissue has moved by a third of this gap.
        force_tolerance: relative change of the forces at which an iteration has converged.
        exact_factor: factor of `force_tolerance` in an exact step.
        exact_violation: factor of the tolerance of the contact conditions in an exact step.
        negligible_friction: friction below this fraction of the surface's smallest force is neglected.
        max_stiffness_factor: derivatives of forces above this multiple of the largest stiffness of a single node are
            discarded.
        reassembly_interval: number of increments that use the same derivatives if the same nodes are in contact.
        max_increment: largest increment of the tool, as a fraction of the contact radius.
        min_increment: smallest increment after failures, as a fraction of `max_increment`.
        violation_factor: tolerance of the contact conditions over that of the surface.
    """

    max_iterations: int = 10
    max_exact_iterations: int = 24
    max_flat_iterations: int = 5
    flat_gap: float = 0.06
    flat_tolerance: float = 1e-6
    near_gap: float = 0.2
    force_tolerance: float = 1e-4
    exact_factor: float = 1e-6
    exact_violation: float = 1e-4
    negligible_friction: float = 1e-6
    max_stiffness_factor: float = 10.0
    reassembly_interval: int = 8
    max_increment: float = 0.03
    min_increment: float = 0.5
    violation_factor: float = 0.5


#: Settings of every `CondensedStepper`.
_SETTINGS = StepperSettings()


@dataclass(frozen=True, slots=True)
class ContactStepResult:
    """Result of a step of `CondensedStepper`: wrench and stiffness on the tool.

    Attributes:
        converged: whether all contact conditions hold.
        iterations: number of contact iterations of the last increment.
        wrench: wrench on the tool about its deepest point, N and N m.
        stiffness_matrix: minus the derivative of the wrench with respect to position and rotation vector, 6 x 6.
        residual: norm of the change of the forces in the last iteration, N.
        pressed: number of nodes in contact.
        slipping: number of slipping nodes.
    """

    converged: bool
    iterations: int
    wrench: Screw
    stiffness_matrix: Matrix
    residual: float
    pressed: int
    slipping: int


_ZERO_WRENCH: Screw = (0.0,) * 6
_INITIAL_STEP = ContactStepResult(True, 0, _ZERO_WRENCH, (_ZERO_WRENCH,) * 6, 0.0, 0, 0)


class CondensedStepper:
    """Real-time solver of the contact between a tool and tissue whose bulk is a `CondensedBulk`.

    Forces and bonds of the nodes continue from model to model.

    Args:
        surface: constants of the contact: surface nodes and shape of the tool.
        largest: largest increment of the tool, over the radius of the contact.

    Raises:
        InputError: the surface has too many nodes.

    Attributes:
        model: newest linearisation of the bulk; None before the first.
        forces: forces of the nodes on the tool, N, shape (s, 3).
    """

    def __init__(self, surface: ContactSurface, largest: float = _SETTINGS.max_increment):
        self.surface = surface
        s, n = len(surface.places), surface.candidates
        self._carried, self._states = allocate_array((s, NODE_COLUMNS)), allocate_array((s, STATE_COLUMNS), np.int32)
        self.forces, self._anchors = (self._carried[:, at:at + 3]
                                      for at in (NodeForceAndAnchorColumn.FORCE, NodeForceAndAnchorColumn.ANCHOR))
        self._bound, self._met, self._pressed, self._slips, outlines = self._states.T
        outlines[:] = surface.outlines
        self._settings, self._results = np.zeros(SETTING_COUNT), np.zeros(RESULT_COUNT)
        self._matrix, self._right = allocate_array((9 * n * n,)), allocate_array((3 * n * RIGHT_HAND_SIDES,))
        self._tool_coupling, self._columns = (allocate_array((3 * n, 6)) for _ in range(2))
        # The rows of the compliance are padded to whole vectors.
        width = -(-3 * n // LANES) * LANES
        if width > MAX_FREEDOMS:
            raise InputError(f"the number of nodes that the tool may touch must be at most {MAX_FREEDOMS // 3} in a "
                             f"multirate simulation; got {n}. Use a coarser mesh.", field="resolution")
        self._compliance, self._free_displacement = allocate_array((3 * n, width)), allocate_array((n, 3))
        lists, local = allocate_array((n, LIST_COLUMNS), np.int32), allocate_array((n, LOCAL_COLUMNS))
        self._nodes, self._active, self._signature = (lists[:, at]
                                                      for at in (NodeListColumn.NODE, NodeListColumn.ACTIVE,
                                                                 NodeListColumn.STATUS))
        self._guess = local[:, LinearisedContactColumn.FORCE:LinearisedContactColumn.FORCE + 3]
        constants = {"chains": surface.chains.reshape(-1, surface.chains.shape[-1]), "shapes": surface.shapes,
                     "surface": np.column_stack([surface.places, surface.springs, surface.friction])}
        arrays = {
            **{name: copy_to_addressable_array(array) for name, array in constants.items()}, "states": self._states,
            "carried": self._carried, "lists": lists, "free_displacement": self._free_displacement,
            "tool_coupling": self._tool_coupling, "compliance": self._compliance,
            "rows": self._compliance.reshape(-1, LANES), "u": allocate_array((width,)), "local": local,
            "columns": self._columns, "matrix": self._matrix, "right": self._right}
        self._sum = np.zeros(ANSWER_SIZE)
        table = CONTACT_ARRAYS.make_offset_table(arrays)
        arrays |= {"settings": self._settings, "results": self._results, "answer": self._sum, "table": table}
        with LOCK:
            self._kernel = BoundKernel.bind_by_name(make_contact_iteration_kernel(), arrays)
            self._wrench_kernel = BoundKernel.bind_by_name(make_bond_commit_and_wrench_kernel(), arrays)
        self._flat = TangentPlaneContact(arrays, _SETTINGS.flat_gap * surface.radius, surface.floor)
        self._tolerance, self._stiffest = _SETTINGS.violation_factor * surface.tolerance, math.inf
        self._settings[[KernelSetting.TOLERANCE, KernelSetting.NEGLIGIBLE, KernelSetting.NEAR_GAP]] = (
            self._tolerance, _SETTINGS.negligible_friction * surface.floor, _SETTINGS.near_gap * surface.radius)
        self._tool_radius = float((surface.chains[:, :, 0] + surface.shapes[:, :1]).max())
        self._others = surface.places[:0]
        self._largest = largest * surface.radius
        self._first_height = surface.start.position[2]
        self.model: CondensedBulk | None = None
        self._last = _INITIAL_STEP
        self.reset()

    def reset(self) -> None:
        """Set forces to zero and bonds to those of the first touch, and forget the pose; the linearisation stays."""
        for array in (self.forces, self._pressed, self._slips, self._met):
            array[:] = 0
        self._bound[:], self._anchors[:] = self.surface.bound, self.surface.anchors
        self._pose: Pose | None = None
        self._last = _INITIAL_STEP
        self._factor: tuple[np.ndarray, np.ndarray] | None = None
        self._discard_equations()
        self._steps = 0

    def reset_contact_in_air(self) -> None:
        """Reset the contact for a tool in the air above undeformed tissue: no node is bound to the tool."""
        self.reset()
        self._bound[:] = ContactBondState.FREE

    def place_at_first_touch(self, pose: Pose) -> None:
        """Place the tool at a pose of first touch; the next step continues from there.

        At the pose `ContactSurface.start` the nodes get the bonds that the surface states. At any other pose no node
        is bound; nodes are bound where the tool touches them in the next steps.
        """
        self.reset()
        if compute_pose_distance(self.surface.start, pose, self.surface.radius) > self.surface.tolerance:
            self._bound[:] = ContactBondState.FREE
        self._pose = pose

    def _discard_equations(self) -> None:
        """Discard the linear equations and force derivatives of the last step; the next step assembles new ones."""
        #: Number of nodes, the first of `_active`, whose force derivatives with respect to the pose are known.
        self._predicted_count = 0
        self._settings[KernelSetting.REBUILDS] = 1.0
        #: Pose of the tool when all nodes were evaluated; None: the next iteration evaluates all nodes.
        self._evaluation_pose: Pose | None = None

    def export_state(self, time: float, pose: Pose, earlier: float, before: Pose, epoch: int = 0,
                     touched: bool = True) -> ContactState:
        """Return a copy of the contact state for the solver of the bulk; for the arguments see `ContactState`."""
        return ContactState(0 if self.model is None else self.model.number, epoch, time, pose, earlier, before,
                            self.forces.copy(), self._anchors.copy(),
                            np.stack([self._bound, self._pressed, self._slips]).astype(float), touched)

    def load_state(self, state: ContactState) -> None:
        """Replace forces, anchors, bonds and pose by those of another stepper with the same surface and model."""
        self.forces[:], self._anchors[:] = state.forces, state.anchors
        self._bound[:], self._pressed[:], self._slips[:] = state.states
        self._pose = state.pose
        self._discard_equations()

    def set_linearisation(self, model: CondensedBulk) -> None:
        """Replace the linearisation of the bulk by another one of the same surface.

        Nodes that the new model does not contain lose their forces and frictional bonds.
        """
        n, known = len(model.nodes), self.model
        if known is None or (model.base, model.epoch) != (known.base, known.epoch):
            predicted, rows = self._nodes[self._active[:self._predicted_count]], np.full(len(self.forces), -1)
            rows[model.nodes] = np.arange(n)
            dropped = rows < 0
            self.forces[dropped], self._pressed[dropped], self._met[dropped], self._slips[dropped] = 0.0, 0, 0, 0
            self._others = self.surface.places[dropped]
            self._bound[dropped & (self._bound != ContactBondState.HELD)] = 0
            self._nodes[:n], self._tool_coupling[:3 * n], self._compliance[:3 * n, :3 * n] = (
                model.nodes, model.tool_coupling, model.compliance)
            self._signature[:] = -1
            self._settings[KernelSetting.COUNT] = n
            smallest_compliance = float(np.abs(np.diag(model.compliance)).min(initial=math.inf))
            self._stiffest = _SETTINGS.max_stiffness_factor / smallest_compliance
            self._sum[WrenchKernelEntryIndex.HELD_STIFFNESS:WrenchKernelEntryIndex.HELD_STIFFNESS
                      + 36] = model.stiffness.ravel()
            self._discard_equations()
            if not dropped[predicted].any():
                # The force derivatives of the last model are a better predictor than constant forces.
                self._predicted_count = len(predicted)
                self._active[:self._predicted_count] = rows[predicted]
        self._sum[WrenchKernelEntryIndex.HELD_WRENCH:WrenchKernelEntryIndex.HELD_WRENCH + 6] = model.wrench
        self._free_displacement[:n], self._evaluation_pose = model.free_displacement, None
        self._settings[KernelSetting.MODULUS] = model.modulus
        self.model = model

    def step(self, pose: Pose, exact: bool = False) -> ContactStepResult:
        """Move the tool to a pose and solve the contact.

        Args:
            pose: pose of the tool.
            exact: whether the linear equations are assembled again, so that the stiffness belongs to this pose.

        Returns:
            Result at the pose. If a step does not converge, wrench and stiffness are those of the last converged
            increment, from which the next step continues.

        Raises:
            ValueError: no linearisation was set.
        """
        model = self.model
        if model is None:
            raise ValueError("model must be a linearisation of the bulk; got None. Call set_linearisation before step.")
        start = self._pose
        if start is None:
            return self._solve_increment_to_result(pose, exact)
        travel = compute_pose_distance(start, pose, self.surface.radius)
        largest = self._largest / travel if travel else math.inf
        increments = AdaptiveIncrements(_SETTINGS.min_increment * largest, min(1.0, largest))
        while True:
            step = self._solve_increment_to_result(interpolate_pose(start, pose, increments.end), exact)
            if step.converged:
                increments.advance()
                if increments.is_complete:
                    return step
            elif not increments.halve_and_check_size():
                return step

    def _solve_increment_to_result(self, pose: Pose, exact: bool) -> ContactStepResult:
        """Solve the contact at the end of one increment; the state is unchanged if the solution does not converge."""
        from scipy.linalg import lapack

        assert self.model is not None
        settings, results = self._settings, self._results
        displacement = compute_rigid_motion(self.model.pose, pose)
        self._write_pose_and_displacement_settings(pose, displacement)
        carried, states = self._carried.copy(), self._states.copy()
        if self._predicted_count and self._pose is not None:
            settings[KernelSetting.PREDICTED] = self._predicted_count
            settings[KernelSetting.STEP:KernelSetting.STEP + 6] = compute_rigid_motion(self._pose, pose)
        self._steps += 1
        if exact or self._steps % _SETTINGS.reassembly_interval == 0:
            settings[KernelSetting.REBUILDS] = 1.0
        nearest = _SETTINGS.near_gap / 3.0 * self.surface.radius
        if self._evaluation_pose is None or \
                compute_pose_distance(self._evaluation_pose, pose, self.surface.radius) > nearest:
            self._evaluation_pose, settings[KernelSetting.NEAR_COUNT] = pose, 0.0
        settings[KernelSetting.RELEASE], settings[KernelSetting.CHANGEABLE] = 0.0, 1.0
        max_iterations = _SETTINGS.max_exact_iterations if exact else _SETTINGS.max_iterations
        converged, fresh, decided, iterations, solution = False, False, False, 0, None
        while True:
            with LOCK:
                self._kernel()
            violation, pulling, unbalanced, size, active, rebuilt, slipping, gone = results.tolist()
            settings[KernelSetting.RELEASE], settings[KernelSetting.CHANGEABLE], k = 0.0, 1.0, 3 * int(active)
            if stale := gone > _SETTINGS.near_gap / 3.0 * self.surface.radius:
                settings[KernelSetting.NEAR_COUNT] = 0.0
            change, enough = math.sqrt(unbalanced), _SETTINGS.force_tolerance * max(math.sqrt(size), self.surface.floor)
            if not math.isfinite(unbalanced + size) or iterations >= max_iterations:
                break
            iterations += 1
            if k and rebuilt:
                lu, pivots, failed = lapack.dgetrf(self._matrix[:k * k].reshape(k, k).T, overwrite_a=1)
                self._factor, fresh = (None if failed else (lu, pivots)), True
            usable = fresh and self._factor is not None and len(self._factor[0]) == k
            settles = change < enough and violation <= self._tolerance
            done = settles and not stale and (
                not exact or (change < _SETTINGS.exact_factor * enough
                              and violation <= _SETTINGS.exact_violation * self._tolerance))
            if done and pulling:
                settings[KernelSetting.RELEASE] = 1.0
            elif done and k and not usable and 3 * self._predicted_count != k:
                settings[KernelSetting.REBUILDS] = 1.0
            elif done:
                solution = self._solve_factored_or_zero_if_singular(k) if k and usable else None
                converged = True
                break
            elif usable and (decided or (exact and settles)):
                chosen, step = self._active[:k // 3], self._solve_factored_or_zero_if_singular(k)[:, 0]
                self.forces[self._nodes[chosen]] = self._guess[chosen] + step.reshape(-1, 3)
                decided = False
                settings[KernelSetting.CHANGEABLE], settings[KernelSetting.REBUILDS] = 0.0 if settles else 1.0, 1.0
            else:
                solved = self._flat.try_solving_contact_forces(_SETTINGS.flat_tolerance)
                decided = solved and iterations <= _SETTINGS.max_flat_iterations
                settings[KernelSetting.CHANGEABLE], settings[KernelSetting.REBUILDS] = 0.0, 1.0
        if converged:
            if solution is not None:
                self._columns[:k] = solution[:, 1:]
            self._pose, self._predicted_count = pose, k // 3
            self._last = self._commit_bonds_and_get_step_result(iterations, change, int(slipping))
            return self._last
        self._carried[:], self._states[:] = carried, states
        self._discard_equations()
        return replace(self._last, converged=False, iterations=iterations, residual=change)

    def _solve_factored_or_zero_if_singular(self, k: int) -> np.ndarray:
        """Return the solution of the last linear equations, shape (k, `RIGHT_HAND_SIDES`).

        The solution is zero if the equations are close to singular, which happens when all nodes are about to slip.
        """
        from scipy.linalg import lapack

        assert self._factor is not None
        solution, _ = lapack.dgetrs(*self._factor, self._right[:RIGHT_HAND_SIDES * k].reshape(RIGHT_HAND_SIDES, k).T,
                                    overwrite_b=1)
        if not (math.isfinite(solution.sum()) and np.abs(solution[:, 1:4]).max() < self._stiffest):
            solution[:] = 0.0
        return solution

    def may_touch_missing_nodes(self, pose: Pose) -> bool:
        """Whether the tool at a pose may touch nodes of the surface that the condensed model does not contain."""
        model = self.model
        if model is None or not len(self._others):
            return False
        if compute_pose_distance(model.pose, pose, self.surface.radius) <= model.reach:
            return False
        # Only nodes within the largest radius of the tool can be touched; distant nodes have small displacements.
        self._write_pose_and_displacement_settings(pose, compute_rigid_motion(model.pose, pose))
        origin = self._settings[KernelSetting.ORIGIN:KernelSetting.ORIGIN + 3]
        rotation = self._settings[KernelSetting.ROTATION:KernelSetting.ROTATION + 9].reshape(3, 3)
        at = (self._others - origin) @ rotation
        return bool(np.hypot(at[:, 0], at[:, 1]).min() < self._tool_radius)

    def _write_pose_and_displacement_settings(self, pose: Pose, displacement: Screw) -> None:
        """Write the pose of the tool, and its motion from the pose of the model, to the settings of the kernel."""
        settings, (w, x, y, z) = self._settings, pose.orientation
        settings[KernelSetting.ROTATION:KernelSetting.ROTATION + 9] = (
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y))
        x, y, z = pose.position
        settings[KernelSetting.ORIGIN:KernelSetting.ORIGIN + 3] = x, y, z + self.surface.datum
        settings[KernelSetting.MOTION:KernelSetting.MOTION + 6] = displacement
        settings[KernelSetting.PRESSED_IN] = float(z <= self._first_height)

    def _commit_bonds_and_get_step_result(self, iterations: int, change: float, slipping: int) -> ContactStepResult:
        """Commit the bonds of a converged increment, and return its wrench and stiffness."""
        count = self._predicted_count
        self._sum[WrenchKernelEntryIndex.COUNT] = count
        with LOCK:
            self._wrench_kernel()
        answer = self._sum.tolist()
        x, y, z, u, v, w = answer[WrenchKernelEntryIndex.WRENCH:WrenchKernelEntryIndex.WRENCH + 6]
        if count and not self._columns[:3 * count].any():
            stiffness = self._last.stiffness_matrix  # the linear equations were close to singular
        else:
            stiffness = cast("Matrix", tuple(tuple(-rate for rate in answer[row:row + 6])
                                             for row in range(WrenchKernelEntryIndex.RATES, ANSWER_SIZE, 6)))
        return ContactStepResult(True, iterations, (x, y, z, u, v, w), stiffness, change, count, slipping)
