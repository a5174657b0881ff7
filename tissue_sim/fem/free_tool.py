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


class FreeTool:
    """The part of the contract of a `tissue_sim.fem.solver.Solver` that concerns a tool in the air."""

    mesh: Any = None
    #: Whether the rotation of the tool about its own axis at the touch has no influence, as for a body of revolution.
    #: It is then removed from the poses that the solver gets.
    ignores_twist: ClassVar[bool] = False

    @property
    def is_time_dependent(self) -> bool:
        """Whether the tissue changes with time while nothing moves, so that it has to be stepped without a tool."""
        return True

    def mesh_digest(self) -> str:
        """Digest of what a saved state belongs to: the undeformed mesh."""
        return digest_arrays(getattr(self.mesh, "nodes", None), getattr(self.mesh, "connectivity", None))

    def height_above_tissue(self, pose: Pose) -> float:
        """Distance that the tool must go down from a pose until it touches the undeformed tissue.

        Called before the first touch.

        Returns:
            m, or a positive lower bound of the distance; zero or negative if the tool touches.
        """
        return pose.position[2]

    def place_tool_at_first_touch(self, pose: Pose) -> bool:
        """Place the tool at the pose of its first touch, on tissue that has not been touched.

        A solver whose mesh, contact or reference belongs to one position of the tool moves them to `pose`, so that the
        tool drags no tissue there.

        Returns:
            False if the solver cannot place the tool there; nothing is changed.
        """
        return True

    def clearance(self, pose: Pose) -> float | None:
        """Distance between a tool at a pose and the tissue at the last committed state.

        Returns:
            m, negative inside; or another number with the same sign. None if the tool touches, holds or attracts
            tissue at the last committed state, or if the solver does not know: then every motion is stepped.
        """
        return None

    def move_in_air(self, pose: Pose) -> None:
        """Move the tool without a step, between poses whose `clearance` is positive."""

    def move_to_next_touch(self, pose: Pose) -> bool:
        """Move a tool that has lifted off, in the air, to the pose at which it touches again.

        Elastic tissue that is at rest again is touched as at the first touch: the solver returns to the state in which
        the tool just touches, so that the whole face sticks from the touch on. A solver whose mesh belongs to one
        position of the tool may move it here.

        Returns:
            Whether the touch begins as a first touch, with the tool already at the surface.
        """
        self.move_in_air(pose)
        return False

    def bind_points_on_path(self, pose: Pose) -> None:
        """Bind the points of the tissue that the tool touches on its path to a pose, with stick or friction.

        Called before the first increment of a touch that does not begin as a first touch (`move_to_next_touch`);
        without this call the tissue that touches within an increment slides without friction until its end.
        """

    def stop_tissue_motion(self) -> None:
        """Set the velocity of the tissue to zero."""


def digest_arrays(*arrays: np.ndarray | None) -> str:
    """Hexadecimal digest of the contents of arrays; "" if there are none."""
    known = [array for array in arrays if array is not None]
    found = hashlib.blake2b(digest_size=16)
    for array in known:
        found.update(f"{array.shape}{array.dtype}".encode())
        found.update(np.ascontiguousarray(array).data)
    return found.hexdigest() if known else ""
