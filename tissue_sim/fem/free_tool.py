"""Contract of a solver for a tool in the air: before the first touch, and after lift-off.

The defaults are valid for every solver: the tool first touches where its deepest point reaches z = 0, and after that
every motion is stepped.
"""

from __future__ import annotations

import hashlib
from typing import Any, ClassVar

import numpy as np

from tissue_sim.pose import Pose

#: Tissue that has moved by less than this fraction of the tolerance of the contact is at rest.
AT_REST = 0.1


class ToolInAirInterface:
    """Interface of a `tissue_sim.fem.solver.Solver` for a tool in the air, before and after contact."""

    mesh: Any = None
    #: Whether the rotation of the tool about its own axis at the touch has no influence, as for a body of revolution.
    #: It is then removed from the poses that the solver gets.
    ignores_twist: ClassVar[bool] = False

    @property
    def is_time_dependent(self) -> bool:
        """Whether the tissue changes with time while the tool rests, so that steps are needed without contact too."""
        return True

    def mesh_digest(self) -> str:
        """Return a digest of the undeformed mesh; a saved state can be restored on a mesh with the same digest."""
        return digest_arrays(getattr(self.mesh, "nodes", None), getattr(self.mesh, "connectivity", None))

    def height_above_tissue(self, pose: Pose) -> float:
        """Return the distance that the tool must move down from a pose to touch the undeformed tissue.

        Called before the first touch.

        Returns:
            Distance, m, or a positive lower bound of the distance; zero or negative if the tool touches.
        """
        return pose.position[2]

    def place_tool_at_first_touch(self, pose: Pose) -> bool:
        """Place the tool at the pose of its first touch on undeformed tissue; return whether the tool was placed.

        A solver whose mesh, contact or reference belongs to one position of the tool moves them to `pose`, so that the
        tool drags no tissue there.

        Returns:
            True if the tool was placed; False if the solver cannot place the tool at this pose and has changed nothing.
        """
        return True

    def clearance(self, pose: Pose) -> float | None:
        """Return the distance between the tool at a pose and the tissue at the last committed state.

        Returns:
            Distance, m, negative if the tool is inside the tissue; or another number with the same sign. None if the
            tool touches, holds or attracts tissue at the last committed state, or if the solver cannot compute the
            distance: then every motion is stepped.
        """
        return None

    def move_in_air(self, pose: Pose) -> None:
        """Set the pose of the tool without solving a step; `clearance` must be positive there and on the path."""

    def move_to_next_touch(self, pose: Pose) -> bool:
        """Prepare the next touch of a lifted tool at a pose in the air; return whether it is like a first touch.

        Elastic tissue that is at rest again is touched as at the first touch: the solver returns to the state in which
        the tool just touches, so that the whole face sticks from the touch on. Otherwise the tool moves to the pose in
        the air. A solver whose mesh belongs to one position of the tool may move it here.

        Returns:
            Whether the touch begins as a first touch: the solver is in the state in which the tool just touches.
        """
        self.move_in_air(pose)
        return False

    def bind_points_on_path(self, pose: Pose) -> None:
        """Bind the surface points that the tool touches on its path to a pose, so that stick or friction acts on them.

        Called before the first increment of a touch that does not begin as a first touch (`move_to_next_touch`);
        without this call the tissue that touches within an increment slides without friction until its end.
        """

    def stop_tissue_motion(self) -> None:
        """Set the velocity of the tissue to zero."""


def digest_arrays(*arrays: np.ndarray | None) -> str:
    """Return a hexadecimal BLAKE2 digest of shapes, types and contents of arrays; "" if all are None."""
    known = [array for array in arrays if array is not None]
    found = hashlib.blake2b(digest_size=16)
    for array in known:
        found.update(f"{array.shape}{array.dtype}".encode())
        found.update(np.ascontiguousarray(array).data)
    return found.hexdigest() if known else ""
