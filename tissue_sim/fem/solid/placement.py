"""Placement of the first touch on a solid: mesh, nodes under the tool and held nodes are moved to its position."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tissue_sim.fem.contact.pairs import ContactPair
from tissue_sim.fem.contact.settings import ContactBondState
from tissue_sim.fem.contact.surface_geometry import find_nearest_surface_geometry
from tissue_sim.fem.free_tool import AT_REST
from tissue_sim.fem.solid.contact import ContactNodes
from tissue_sim.fem.solid.faceting import estimate_faceting_force_error_or_none
from tissue_sim.fem.solid.frame import ToolFrame
from tissue_sim.fem.solid.mass import LumpedMass
from tissue_sim.fem.solid.tissue import Tissue
from tissue_sim.fem.solver import Solver, Step
from tissue_sim.kernel_owner import KernelOwner
from tissue_sim.material.material import Material
from tissue_sim.pose import Pose, compute_rigid_motion, shift_pose_along_z


@dataclass(frozen=True)
class FirstTouchPositionTolerances:
    """Largest distances between the first touch of the tool and the position of the mesh.

    Attributes:
        same_position: distance between two first touches, over the radius of the tool, below which they are the same,
            1.
        face_offset: largest distance of a flat tool from the position of a mesh that cannot be moved, over the radius
            of the tool, 1.
    """

    same_position: float = 1e-6
    face_offset: float = 0.01


#: Tolerances of every solid.
PLACEMENT = FirstTouchPositionTolerances()


class SolidSolverBase(KernelOwner, Solver):
    """Base class of `SolidSolver`: placement and motion of the tool without contact.

    The mesh belongs to one position of the first touch. For a first touch at another position the solver is replaced by
    one with a moved mesh.

    Attributes:
        placement: makes the solver for a first touch at another pose; None: the solver cannot be moved.
        largest_motion: largest motion of the tool after its first touch, downwards and sideways, with which the contact
            conditions are accurate, m.
    """

    ignores_twist = True
    placement: FirstTouchHeightAndSolverMaker | None = None
    contact: ContactNodes
    tissue: Tissue
    material: Material
    _asked: bool
    _committed: tuple[np.ndarray, ...]
    _rest: tuple[np.ndarray, ...]
    _tolerance: float
    largest_motion: float
    _contact_radius: float
    _mass: LumpedMass | None
    _bonded: np.ndarray
    _start: Pose
    _pose: Pose

    def accepts_pose(self, pose: Pose) -> bool:
        """Whether the contact conditions are accurate at a pose, see `largest_motion`; always above the first touch."""
        x, y, z, *turn = compute_rigid_motion(self._start, pose)
        aside = math.hypot(x, y) + self._contact_radius * math.hypot(*turn[:2])
        return z >= 0.0 or max(-z, aside) <= self.largest_motion

    def height_above_tissue(self, pose: Pose) -> float:
        """Return the distance that the tool must go down until it touches the undeformed tissue, m.

        See `ToolInAirInterface.height_above_tissue`.
        """
        return pose.position[2] if self.placement is None else self.placement.height_above_tissue(pose)

    def place_tool_at_first_touch(self, pose: Pose) -> bool:
        """Place the tool at its first touch; the mesh moves with the tool, to stay fine under the tool."""
        if self.placement is None or self.placement.is_at_mesh_position(self._start, pose):
            return True
        other = self.placement.make_solver_for_touch_pose_or_none(pose, self)
        if other is None:
            return False
        self.__dict__.update(other.__dict__)
        return True

    def _add_error_estimate(self, step: Step) -> Step:
        """Return a converged step with its estimated force error, if stiffness is requested in every step."""
        if not self._asked:
            return step
        error = estimate_faceting_force_error_or_none(self.contact, self.mesh, self.committed_displacement,
                                                      math.hypot(*step.wrench[:3]))
        return step if error is None else replace(step, force_error=error)

    def copy_material_and_requests_to(self, other: Any) -> None:
        """Copy material, density and the request for stiffness to another solver of the same model."""
        if self._asked:
            other.enable_stiffness_output()
        if self._mass is not None:
            other.enable_inertia(self._mass.density)
        if self.material is not other.material:
            other.set_material(self.material)

    def clearance(self, pose: Pose) -> float | None:
        """Return the smallest distance of a node from the tool, m; None for bonded tissue, and with contact laws."""
        contact = self.contact
        if self._bonded.size or contact.laws or (
                contact.moves & (contact.stays | (contact.bound != ContactBondState.FREE))).any():
            return None
        frame, displacement, least = ToolFrame(pose, self.datum), self.committed_displacement, math.inf
        for pair, own in contact.parts:
            if pair.moves and own.size:
                at = frame.transform_to_tool(contact.places[own] + displacement[contact.nodes[own]])
                least = min(least, float(find_nearest_surface_geometry(pair, at, pressed_in=False).gap.min()))
        return least

    @property
    def is_time_dependent(self) -> bool:
        """See `ToolInAirInterface.is_time_dependent`."""
        return self.tissue.has_history

    def stop_tissue_motion(self) -> None:
        """See `ToolInAirInterface.stop_tissue_motion`."""
        if self._mass is not None:
            self._mass.motion.reset_velocity()

    @property
    def committed_displacement(self) -> np.ndarray:
        """Displacement of all nodes at the last committed state, m, shape (nodes, 3)."""
        return self._committed[0].reshape(-1, 3)

    def move_to_next_touch(self, pose: Pose) -> bool:
        """Move a lifted tool to its next touch; return whether the touch begins as a first touch.

        See `ToolInAirInterface.move_to_next_touch`.
        """
        begins = (self.placement is not None and not self.is_time_dependent and self._has_tissue_returned_to_rest
                  and self.place_tool_at_first_touch(shift_pose_along_z(pose, -self.height_above_tissue(pose))))
        if begins:
            self.reset_to_first_touch()
        else:
            self.move_in_air(pose)
        return begins

    @property
    def _has_tissue_returned_to_rest(self) -> bool:
        """Whether the tissue has returned to its state before the first touch."""
        return float(np.abs(self._committed[0] - self._rest[0]).max()) <= AT_REST * self._tolerance

    def move_in_air(self, pose: Pose) -> None:
        """See `ToolInAirInterface.move_in_air`."""
        self._pose = pose


class FirstTouchHeightAndSolverMaker:
    """Height of the first touch of a tool on the top of a solid, and the solver for a first touch at another pose.

    Args:
        places: positions of the nodes of the top without a tool, m, shape (n, 3).
        pairs: contact pairs; the last one has the outline of the whole tool.
        datum: height of the scene's origin in the frame of the mesh, m.
        is_level: whether the top is flat and has not settled.
        margin: returns the distance of a point from the edge of the top, m.
        touch_height: returns the height of the scene's origin at which a tool at a pose touches, m; raises InputError
            outside of the top.
        remake: returns the solver for a first touch at a pose, or None if no solver can be made; None: never remake.
    """

    def __init__(self, places: np.ndarray, pairs: Sequence[ContactPair], datum: float, is_level: bool,
                 margin: Callable[[float, float], float], touch_height: Callable[[Pose], float],
                 remake: Callable[[Pose, Any], Any] | None):
        profiles = [pair.profile for pair in pairs if pair.moves][-1:]
        self.radius = max((float(each.vertices[:, 0].max()) + each.rounding for each in profiles), default=0.0)
        self._highest = float(places[:, 2].max()) - datum
        self._datum, self._is_level, self._margin = datum, is_level, margin
        self._touch_height, self._remake = touch_height, remake

    def is_at_mesh_position(self, start: Pose, pose: Pose) -> bool:
        """Whether a first touch at a pose needs no other mesh than the first touch at `start`."""
        x, y, z, *turn = compute_rigid_motion(start, pose)
        return math.hypot(x, y, z) + self.radius * math.hypot(*turn) <= PLACEMENT.same_position * self.radius

    def height_above_tissue(self, pose: Pose) -> float:
        """Return the distance that the tool must go down until it touches the undeformed tissue, m.

        See `ToolInAirInterface.height_above_tissue`.
        """
        x, y, z = pose.position
        _, a, b, _ = pose.orientation
        sine = 2.0 * math.sqrt(max(0.0, (a * a + b * b) * (1.0 - a * a - b * b)))
        lowest = z - self.radius * sine - self._highest
        if lowest > 0.0:
            return lowest
        if self._is_level and sine == 0.0 and self._margin(x, y) >= self.radius:
            return z
        from tissue_sim.errors import InputError

        try:
            return z + self._datum - self._touch_height(Pose((x, y, 0.0), pose.orientation))
        except InputError:
            return math.inf  # outside the top

    def make_solver_for_touch_pose_or_none(self, pose: Pose, solver: Any) -> Any:
        """Return the solver for a first touch at a pose; None if no such solver can be made.

        Args:
            pose: pose of the tool at the first touch.
            solver: solver whose material and density are copied to the new solver.
        """
        return None if self._remake is None else self._remake(pose, solver)
