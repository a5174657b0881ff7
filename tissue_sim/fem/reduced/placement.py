"""First contact of the tool with a reduced solid, and motion of the tool without contact."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from tissue_sim.fem.contact.pairs import ContactPair
from tissue_sim.fem.free_tool import digest_arrays
from tissue_sim.fem.reduced.contact import PenaltyContact
from tissue_sim.fem.reduced.elements import SampledElements
from tissue_sim.fem.reduced.model import ReducedModel
from tissue_sim.fem.reduced.prediction import AmplitudePredictor
from tissue_sim.fem.reduced.settings import BondedPlacementLimits
from tissue_sim.fem.reduced.tool_motion import PrescribedModeAmplitudes
from tissue_sim.fem.solid.frame import ToolFrame
from tissue_sim.fem.solid.touch import FirstTouchHeightAndSolverMaker, find_first_touch
from tissue_sim.fem.solver import Solver
from tissue_sim.kernel_owner import KernelOwner
from tissue_sim.pose import Pose, compute_rigid_motion

#: Settings of every reduced solid.
PLACEMENT = BondedPlacementLimits()


class ReducedSolverBase(KernelOwner, Solver):
    """Base class of `ReducedSolver`: methods for a tool without contact and its first contact."""

    ignores_twist = True
    reduced: ReducedModel
    elements: SampledElements
    contact: PenaltyContact
    _start: Pose
    _pose: Pose
    _landed: Pose
    _reach: float
    _lifting: int
    _tool_motion: PrescribedModeAmplitudes
    _prediction: AmplitudePredictor
    amplitudes: np.ndarray
    _placement: FirstTouchHeightAndSolverMaker

    def _set_up_touch_height_finder(self, pairs: Sequence[ContactPair]) -> None:
        """Set `_placement`, which computes the height of the first touch of the tool from the contact pairs."""
        reduced = self.reduced
        mesh, places, specimen = reduced.mesh, reduced.rest_positions, reduced.model.experiment.specimen
        self._placement = FirstTouchHeightAndSolverMaker(
            places[mesh.sets["top"]], pairs, self.datum, is_level=specimen.is_flat and reduced.rest is None,
            margin=specimen.margin, touch_height=lambda pose: find_first_touch(mesh, places, pairs, pose).height,
            remake=None)

    def mesh_digest(self) -> str:
        """See `ToolInAirInterface.mesh_digest`. The digest includes mesh, modes and sampled elements."""
        reduced = self.reduced
        return digest_arrays(reduced.mesh.nodes, reduced.mesh.connectivity, reduced.basis, reduced.elements)

    def height_above_tissue(self, pose: Pose) -> float:
        """Return the distance that the tool must go down until it touches the undeformed tissue, m.

        See `ToolInAirInterface.height_above_tissue`.
        """
        return self._placement.height_above_tissue(pose)

    def place_tool_at_first_touch(self, pose: Pose) -> bool:
        """See `ToolInAirInterface.place_tool_at_first_touch`.

        The modes of a bonded tool belong to one pose of first contact; other poses are refused. A tool that can lift
        off may touch anywhere in the box of poses.
        """
        if self._lifting:
            x, y, z, *turn = compute_rigid_motion(self._start, pose)
            if math.hypot(x, y, z) > PLACEMENT.max_offset * self._reach or math.hypot(*turn) > PLACEMENT.max_rotation:
                return False
            self._tool_motion = PrescribedModeAmplitudes(self._lifting, ToolFrame(pose, self.datum))
        self._pose = self._landed = pose
        return True

    @property
    def is_time_dependent(self) -> bool:
        """Whether the force depends on time; also true while the stiffness at rest is not computed completely."""
        return self.elements.has_history or not self.is_undeformed_with_complete_stiffness

    @property
    def is_undeformed_with_complete_stiffness(self) -> bool:
        """Whether the tissue is undeformed and its stiffness at rest is computed completely."""
        raise NotImplementedError

    def clearance(self, pose: Pose) -> float | None:
        """Return 1 if the tool at this pose touches no tissue, deformed or at rest, else -1.

        None for a bonded tool, and if the tool touches at the last state.
        """
        if self._lifting or self.contact.touched.any():
            return None
        return 1.0 if self._is_tool_clear_of_tissue(ToolFrame(pose, self.datum)) else -1.0

    def _is_tool_clear_of_tissue(self, frame: ToolFrame) -> bool:
        """Whether a tool in this frame touches neither the deformed tissue nor the tissue at rest."""
        if self._lifting:
            return False
        for amplitudes in (self.amplitudes, np.zeros_like(self.amplitudes)):
            self.contact.evaluate_contact(amplitudes, frame, False)
            if self.contact.has_touching_nodes:
                return False
        return True

    def move_in_air(self, pose: Pose) -> None:
        """See `ToolInAirInterface.move_in_air`."""
        self._pose = pose
        self._prediction.reset_predictions()
