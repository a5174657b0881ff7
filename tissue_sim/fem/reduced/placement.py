"""First contact of the tool with a reduced solid, motion without contact, and prediction of the next pose.

A bonded tool imposes its displacement on the tissue as prescribed modes. The modal amplitudes of the next pose are
predicted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from tissue_sim.fem.contact.pairs import ContactPair
from tissue_sim.fem.reduced.contact import PenaltyContact
from tissue_sim.fem.reduced.elements import SampledElements
from tissue_sim.fem.reduced.model import ReducedModel
from tissue_sim.fem.reduced.settings import BondedPlacementLimits
from tissue_sim.fem.solid.contact import ToolFrame, differentiate_rotated_forces
from tissue_sim.fem.solid.touch import FirstTouchHeightAndSolverMaker, find_first_touch
from tissue_sim.fem.solver import Solver, digest_arrays
from tissue_sim.fem.taichi.launch import KernelOwner
from tissue_sim.pose import Pose, compute_rigid_motion

#: Largest ratio of the present to the last step of the tool that scales the second-order correction. A tool that
#: accelerates more is predicted as if it accelerated by this ratio.
_MAX_STEP_RATIO = 2.0


class AmplitudePredictor:
    """Predictor of the modal amplitudes: second-order extrapolation along the motion of the tool.

    The prediction is du = S dx + c + a^2 e with the sensitivity S, the correction c by the remaining residual, the
    error e of the last linear prediction and the ratio a of the present to the last step of the tool.

    Args:
        modes: number of modes.
        reach: radius of the contact, m; a rotation is measured by the displacement of a point at this distance.

    Attributes:
        sensitivity: derivative of the amplitudes with respect to position and rotation of the tool at the last
            equilibrium, shape (modes, 6).
        correction: change of the amplitudes that would remove the remaining residual, shape (modes,).
    """

    def __init__(self, modes: int, reach: float):
        self.sensitivity = np.zeros((modes, 6))
        self.correction, self._error, self._last_step = np.zeros(modes), np.zeros(modes), np.zeros(6)
        self._weights = np.array([1.0] * 3 + [reach**2] * 3)

    def predict_amplitude_change(self, tool_step: np.ndarray) -> np.ndarray:
        """Predict the change of the amplitudes in the next step, shape (modes,).

        Args:
            tool_step: displacement, m, and rotation vector, rad, of the tool in the next step, shape (6,).
        """
        change = self.sensitivity @ tool_step + self.correction
        last = float(self._weights @ self._last_step**2)
        if last > 0.0:
            # The error of a linear prediction is of second order in the step of the tool.
            ratio = min(max(float(self._weights @ (tool_step * self._last_step)) / last, 0.0), _MAX_STEP_RATIO)
            change += ratio**2 * self._error
        return change

    def record_step(self, tool_step: np.ndarray, change: np.ndarray, sensitivity: np.ndarray,
                    correction: np.ndarray) -> None:
        """Record a converged step for the next predictions.

        Args:
            tool_step: displacement, m, and rotation vector, rad, of the tool in the step, shape (6,).
            change: change of the amplitudes in the step, shape (modes,).
            sensitivity: derivative at the new equilibrium, shape (modes, 6).
            correction: change of the amplitudes that would remove the remaining residual, shape (modes,).
        """
        self._error[:] = change + correction - self.correction - self.sensitivity @ tool_step
        self._last_step[:], self.sensitivity[:], self.correction[:] = tool_step, sensitivity, correction

    def reset_predictions(self) -> None:
        """Discard all recorded steps; the predicted change is then zero."""
        for array in self.state_arrays:
            array[:] = 0.0

    def clear_corrections(self) -> None:
        """Set the corrections to zero and keep the sensitivity, after a change of the material."""
        self.correction[:], self._error[:], self._last_step[:] = 0.0, 0.0, 0.0

    @property
    def state_arrays(self) -> tuple[np.ndarray, ...]:
        """Arrays of the recorded steps; writing saved copies into them restores an earlier state."""
        return self.sensitivity, self.correction, self._error, self._last_step


class PrescribedModeAmplitudes:
    """Amplitudes of the modes that are prescribed by the pose of a bonded tool.

    The amplitudes are the displacement of the tool (3) and the change of its rotation matrix row by row (9).

    Args:
        count: number of prescribed modes: 12 for a bonded tool, 0 for a tool that can lift off.
        first: frame of the tool at which all amplitudes are zero.
    """

    def __init__(self, count: int, first: ToolFrame):
        self.count, self.first = count, first
        self._frame: ToolFrame | None = None
        self._rates = np.zeros((count, 6))

    def compute_amplitudes(self, frame: ToolFrame) -> np.ndarray:
        """Return the amplitudes of the prescribed modes for a frame of the tool, shape (count,)."""
        return frame.compute_origin_and_matrix_change_from(self.first)[: self.count]

    def compute_amplitude_rates(self, frame: ToolFrame) -> np.ndarray:
        """Return the derivative of the amplitudes with respect to position and rotation of the tool.

        Returns:
            Shape (count, 6). The array is cached; the caller must not change it.
        """
        if self.count and frame is not self._frame:
            self._rates = np.zeros((self.count, 6))
            self._rates[:3, :3] = np.eye(3)
            self._rates[3:, 3:] = differentiate_rotated_forces(frame.rotation.T).transpose(1, 0, 2).reshape(9, 6)[:, 3:]
            self._frame = frame
        return self._rates


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
