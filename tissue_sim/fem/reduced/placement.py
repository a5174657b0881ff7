"""Where the tool first touches a reduced solid, and what it does in the air."""

from __future__ import annotations

import math

import numpy as np

from tissue_sim.fem.free_tool import digest
from tissue_sim.fem.reduced.contact import LayerContact
from tissue_sim.fem.reduced.elements import SampledElements
from tissue_sim.fem.reduced.lifting import Lifting
from tissue_sim.fem.reduced.model import ReducedModel
from tissue_sim.fem.reduced.prediction import Prediction
from tissue_sim.fem.solid.bodies import Body
from tissue_sim.fem.solid.frame import Frame
from tissue_sim.fem.solid.placement import Placement
from tissue_sim.fem.solid.touch import touch
from tissue_sim.fem.solver import Solver
from tissue_sim.kernel_owner import KernelOwner
from tissue_sim.pose import Pose, motion

#: A tool that holds tissue may touch this fraction of the contact radius away from the place of the reduced model.
HOLDS_WITHIN = 0.01
#: Its axis may lean by this angle from that of the reduced model, rad.
HOLDS_LEANING = 2e-3


class PlacedReduced(KernelOwner, Solver):
    """The part of a reduced solver that concerns a tool in the air and its first touch."""

    ignores_twist = True
    reduced: ReducedModel
    elements: SampledElements
    contact: LayerContact
    _start: Pose
    _pose: Pose
    _landed: Pose
    _reach: float
    _lifting: int
    _lifted: Lifting
    _prediction: Prediction
    amplitudes: np.ndarray
    _placement: Placement

    def _make_placement(self, bodies: list[Body]) -> None:
        """Note where the tool may touch."""
        reduced = self.reduced
        mesh, places, specimen = reduced.mesh, reduced.places, reduced.model.experiment.specimen
        self._placement = Placement(
            places[mesh.sets["top"]], bodies, self.datum, is_level=specimen.is_flat and reduced.rest is None,
            margin=specimen.margin, touch_height=lambda pose: touch(mesh, places, bodies, pose).height, remake=None)

    def identity(self) -> str:
        """See `FreeTool.identity`; the modes belong to it."""
        reduced = self.reduced
        return digest(reduced.mesh.nodes, reduced.mesh.connectivity, reduced.basis, reduced.elements)

    def height_above(self, pose: Pose) -> float:
        """See `FreeTool.height_above`."""
        return self._placement.height_above(pose)

    def place_tool(self, pose: Pose) -> bool:
        """See `FreeTool.place_tool`. The modes of a tool that holds tissue are made for one place: it cannot begin to
        hold elsewhere. Other tools may touch anywhere in the box of poses."""
        if self._lifting:
            x, y, z, *turn = motion(self._start, pose)
            if math.hypot(x, y, z) > HOLDS_WITHIN * self._reach or math.hypot(*turn) > HOLDS_LEANING:
                return False
            self._lifted = Lifting(self._lifting, Frame(pose, self.datum))
        self._pose = self._landed = pose
        return True

    @property
    def relaxes(self) -> bool:
        """See `FreeTool.relaxes`; stiffness at rest that has yet to be computed counts, too."""
        return self.elements.remember or not self.is_at_rest

    @property
    def is_at_rest(self) -> bool:
        """Whether the tissue is undeformed and its stiffness there is known."""
        raise NotImplementedError

    def clearance(self, pose: Pose) -> float | None:
        """See `FreeTool.clearance`; None for a tool that holds tissue."""
        if self._lifting or self.contact.touched.any():
            return None
        return 1.0 if self._is_clear_of(Frame(pose, self.datum)) else -1.0

    def _is_clear_of(self, frame: Frame) -> bool:
        """Whether a tool there touches neither the tissue as it is nor as it would rest."""
        if self._lifting:
            return False
        for amplitudes in (self.amplitudes, np.zeros_like(self.amplitudes)):
            self.contact.evaluate(amplitudes, frame, False)
            if self.contact.touches:
                return False
        return True

    def move_in_air(self, pose: Pose) -> None:
        """See `FreeTool.move_in_air`."""
        self._pose = pose
        self._prediction.forget()
