"""Penalty contact of a reduced solid with the tool through a thin elastic layer.

Exact contact constraints at the nodes would lock a reduced solid, because the number of constraints reaches the number
of modes. The penalty stiffness corresponds to a thin elastic layer on the tool: soft enough to avoid locking and stiff
enough for an accurate force.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tissue_sim.fem.contact.pairs import STICK, ContactPair
from tissue_sim.fem.linear.dense import euclidean_norm
from tissue_sim.fem.reduced.kernels import (
    LAYER_ARRAYS,
    NodeState,
    PenaltyContactResult,
    PenaltyContactSetting,
    make_penalty_contact_kernel,
)
from tissue_sim.fem.solid.contact import ToolFrame
from tissue_sim.fem.taichi.launch import BoundKernel
from tissue_sim.fem.taichi.origins import allocate_array, copy_to_addressable_array
from tissue_sim.fem.taichi.runtime import LOCK

#: Friction coefficient of an interface that cannot slip and can lift off.
_NO_SLIP = 1e6
#: A node within this fraction of its friction limit counts as slipping, for the stiffness of continued slip. The
#: fraction is larger than the relative residual of a step.
_SLIP_MARGIN = 1e-2


class PenaltyContact:
    """Penalty contact of a reduced solid: contact forces and their derivatives, projected on the modes.

    The penalty stiffness per area is mu / (softness reach) with the shear modulus mu at the node.

    Args:
        pairs: contact pairs; those of bodies at rest are ignored.
        places: positions of all nodes without contact, m, shape (nodes, 3).
        areas: tributary areas of all nodes, m2, shape (nodes,).
        basis: displacements of the modes, m per amplitude, shape (freedoms, modes).
        reach: contact radius, m.
        softness: thickness of the layer over the contact radius; a smaller value is stiffer.

    Attributes:
        nodes: numbers of the contact nodes, shape (n,).
        forces: contact forces on the tissue, valid for touching nodes, N, shape (n, 3).
        touched: which nodes touched the tool in the last committed step, shape (n,).
        largest_lateral: largest lateral force, N, see `largest_lateral_tool_force_since_touch`, of the committed steps,
            shape (1,).
    """

    def __init__(self, pairs: Sequence[ContactPair], places: np.ndarray, areas: np.ndarray, basis: np.ndarray, *,
                 reach: float, softness: float):
        moving = [pair for pair in pairs if pair.moves]
        owner: dict[int, ContactPair] = {}
        for pair in moving:
            for node in pair.surface.tolist():
                owner.setdefault(node, pair)
        self.nodes = np.array(sorted(owner), dtype=np.intp)
        own = [owner[node] for node in self.nodes.tolist()]
        n = self.nodes.size
        self.places = copy_to_addressable_array(places[self.nodes])
        self.areas = areas[self.nodes]
        self._rows = copy_to_addressable_array(basis.reshape(-1, 3, basis.shape[1])[self.nodes].reshape(3 * n, -1))
        self._settings = np.zeros(PenaltyContactSetting.COUNT)
        profile = moving[-1].profile
        self._settings[PenaltyContactSetting.ROUNDING] = profile.rounding
        self._settings[PenaltyContactSetting.ZONE] = softness * reach
        self._reach, self._softness = reach, softness
        friction = np.array([pair.friction for pair in own], dtype=float).reshape(n, 2)
        friction[friction == STICK] = _NO_SLIP
        self.has_friction = bool((friction > 0.0).any())
        self._springs, self.touched = allocate_array((n,)), allocate_array((n,), np.int32)
        self._states = allocate_array((n,), np.int32)
        self.anchors, self._new_anchors, self.forces = (allocate_array((n, 3)) for _ in range(3))
        self.largest_lateral = np.zeros(1)
        self._moved = allocate_array((n, 3))
        self._modes = modes = self._rows.shape[1]
        # Arrays of the kernel. `_products` is the stiffness between modes and tool, shape (modes + 6, modes + 6).
        self._met, self._answers = (allocate_array((3 * n, modes + 6)) for _ in range(2))
        self._pushes, self._twists = allocate_array((modes + 6,)), allocate_array((3, modes))
        self._report = np.zeros(PenaltyContactResult.COUNT)
        self._products = np.zeros((modes + 6, modes + 6))
        constants = {
            "lines": profile.lines, "shaft": np.array([profile.shaft], dtype=np.int32), "friction": friction,
            "first": np.array([pair.first_line for pair in own], dtype=np.int32),
            "closed": np.array([pair.closed for pair in own], dtype=np.int32)}
        arrays = {
            **{name: copy_to_addressable_array(array) for name, array in constants.items()},
            "places": self.places, "moved": self._moved, "springs": self._springs, "anchors": self.anchors,
            "touched": self.touched, "forces": self.forces, "rates": allocate_array((n, 3, 3)),
            "gaps": allocate_array((n,)), "new_anchors": self._new_anchors, "states": self._states,
            "rows": self._rows, "met": self._met, "answers": self._answers, "pushes": self._pushes,
            "twists": self._twists}
        with LOCK:
            self._press = BoundKernel(make_penalty_contact_kernel(), {
                "settings": self._settings, "report": self._report, "table": LAYER_ARRAYS.make_offset_table(arrays)})

    def set_penalty_and_get_smallest_modulus(self, moduli: np.ndarray) -> float:
        """Set the penalty stiffness of the contact nodes from the shear moduli at all nodes, Pa, shape (nodes,).

        Returns:
            Smallest shear modulus of the contact nodes, Pa.
        """
        own = moduli[self.nodes]
        self._springs[:] = own / (self._softness * self._reach) * self.areas
        return float(own.min())

    def evaluate_contact(self, amplitudes: np.ndarray, frame: ToolFrame, pressed_in: bool, *,
                         slips_on: bool = False) -> None:
        """Evaluate the contact forces and their derivatives, which the properties return.

        Args:
            amplitudes: modal amplitudes, shape (modes,).
            frame: frame of the tool.
            pressed_in: whether the tool is at or below the height of first contact.
            slips_on: whether nodes close to the friction limit have the derivative of slip instead of stick.
        """
        settings = self._settings
        settings[PenaltyContactSetting.SLIP_MARGIN] = _SLIP_MARGIN * slips_on
        settings[PenaltyContactSetting.ROTATION : PenaltyContactSetting.ROTATION + 9] = frame.rotation.ravel()
        settings[PenaltyContactSetting.ORIGIN : PenaltyContactSetting.ORIGIN + 3] = frame.origin
        settings[PenaltyContactSetting.PRESSED_IN] = pressed_in
        np.dot(self._rows, amplitudes, out=self._moved.reshape(-1))
        with LOCK:
            self._press()
        rows = 3 * int(self._report[PenaltyContactResult.TOUCHING])
        np.dot(self._met[:rows].T, self._answers[:rows], out=self._products)

    def get_modal_forces_and_stiffness(self) -> tuple[np.ndarray, np.ndarray]:
        """Return minus the modal contact forces on the tissue, (modes,), and their derivative, (modes, modes).

        The derivative is a view, valid until the next evaluation.
        """
        modes = self._modes
        return -self._pushes[:modes], self._products[:modes, :modes]

    @property
    def wrench(self) -> np.ndarray:
        """Force and torque on the tool about its deepest point in the last evaluation, N and N m, shape (6,)."""
        return -self._pushes[self._modes :]

    @property
    def modal_force_derivative_by_pose(self) -> np.ndarray:
        """Derivative of the modal forces with respect to the pose of the tool, at fixed tissue, shape (modes, 6)."""
        modes = self._modes
        return -self._products[:modes, modes:]

    def compute_force_change_by_amplitudes(self, change: np.ndarray) -> np.ndarray:
        """Return the linearised change of the force on the tool, N, (3,), for a change of the amplitudes, (modes,)."""
        modes = self._modes
        return self._products[modes : modes + 3, :modes] @ change

    def compute_contact_stiffness_at_tool(self, sensitivity: np.ndarray) -> np.ndarray:
        """Compute the stiffness of the contact at the tool: minus d wrench / d pose of the tool, shape (6, 6).

        Args:
            sensitivity: derivative of the amplitudes with respect to the pose, shape (modes, 6).
        """
        modes = self._modes
        stiffness = self._products[modes:, modes:] - self._products[modes:, :modes] @ sensitivity
        # The lever arms of the forces change with the tool and the nodes.
        x, y, z = self._pushes[modes : modes + 3].tolist()
        stiffness[3:] += self._twists @ sensitivity
        stiffness[3:, :3] += ((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0))
        return stiffness

    @property
    def largest_lateral_tool_force_since_touch(self) -> float:
        """Largest force on the tool perpendicular to its axis since the first touch, N, with the last evaluation."""
        if not self.has_touching_nodes:
            return 0.0
        axis = self._settings[PenaltyContactSetting.ROTATION + 2 : PenaltyContactSetting.ROTATION + 9 : 3]
        force = self.wrench[:3]
        return max(float(self.largest_lateral[0]), euclidean_norm(force - (force @ axis) * axis))

    @property
    def has_touching_nodes(self) -> bool:
        """Whether any node touched the tool in the last evaluation."""
        return bool(self._report[PenaltyContactResult.TOUCHING])

    @property
    def touching_mask(self) -> np.ndarray:
        """Mask of the nodes that touched the tool in the last evaluation, shape (n,)."""
        return self._states != NodeState.FREE

    @property
    def slipping_count(self) -> int:
        """Number of slipping nodes in the last evaluation."""
        return int(self._report[PenaltyContactResult.SLIPPING])

    @property
    def largest_penetration(self) -> float:
        """Largest penetration of a node into the tool in the last evaluation, m: the compression of the layer."""
        return float(self._report[PenaltyContactResult.DEPTH])

    def commit_step(self) -> None:
        """Make stick anchors, touching nodes and largest lateral force of a converged step the committed ones."""
        self.anchors[:] = self._new_anchors
        self.touched[:] = self._states != NodeState.FREE
        self.largest_lateral[0] = self.largest_lateral_tool_force_since_touch

    def mark_all_nodes_untouched(self) -> None:
        """Mark all nodes as not touching, and set the largest lateral force to zero."""
        self.touched[:], self.largest_lateral[:] = 0, 0.0

    @property
    def state_arrays(self) -> tuple[np.ndarray, ...]:
        """Arrays of the committed contact state; writing saved copies into them restores the state."""
        return self.anchors, self.touched, self.largest_lateral
