"""Common part of real-time simulations: locking, checks of poses, and changes of the material."""

from __future__ import annotations

import threading
import time
from dataclasses import replace

from tissue_sim.kernel_owner import KernelOwner, make_busy_error, make_single_thread_method
from tissue_sim.material.effect import CombinedForceFactor
from tissue_sim.material.material import Material
from tissue_sim.model import Model
from tissue_sim.motion_limits import LimitError, MotionLimits, convert_to_pose
from tissue_sim.parameters import with_values
from tissue_sim.pose import Pose
from tissue_sim.realtime.accepted_models import require_equal_layer_thicknesses, require_moduli_in_range
from tissue_sim.tool_force import ForceStatus, ToolForce, make_axial_stiffness_matrix, make_axial_wrench

#: Force before the first step.
FORCE_BEFORE_FIRST_STEP = ToolForce(make_axial_wrench(0.0), make_axial_stiffness_matrix(0.0), ForceStatus.STOPPED)


class RealTimeTissue(KernelOwner):
    """Base of `Simulator` and `MultiRateTissue`: pose of the tool in, force on the tool out.

    A subclass implements `_compute_step` and `_send_material_to_solver`, and sets `_answer` in each step.

    Args:
        model: experiment and material.
        limits: of poses and time steps; None: the defaults of `MotionLimits`.

    Raises:
        InputError: a modulus outside of the range of tissues.
    """

    def __init__(self, model: Model, limits: MotionLimits | None):
        require_moduli_in_range(model.material)
        self.model, self.limits = model, limits or MotionLimits()
        self._guard = threading.RLock()
        self._answer = FORCE_BEFORE_FIRST_STEP
        self._reduced = self._make_combined_force_factor(model.material)

    @property
    def _last_pose(self) -> Pose | None:
        """Pose of the tool in the last step; None before the first step. Subclasses implement it."""
        raise NotImplementedError

    def _compute_step(self, pose: Pose, dt: float, began: float) -> ToolForce:
        """Move the tool to a valid pose in `dt` s; return the force. `began` is the clock at the start of the step."""
        raise NotImplementedError

    def _send_material_to_solver(self, material: Material) -> None:
        """Change the material of the solver; raises an InputError before any change. Subclasses implement it."""
        raise NotImplementedError

    def step(self, pose: float | Pose, dt: float) -> ToolForce:
        """Move the tool to a pose and compute the force.

        Args:
            pose: depth, m, or a `Pose`; an axisymmetric scene uses its depth only.
            dt: time since the last step, s; 0 for a sudden step.

        Returns:
            The force and its status. REFUSED, with the last force and an unchanged state: numbers that are not finite,
            or outside of `limits`.

        Raises:
            InputError: a pose or a time that does not consist of numbers.
            BusyError: another thread is inside a call of this object.
        """
        # Not `make_single_thread_method`, which would add a call to each tick.
        if not self._guard.acquire(blocking=False):
            raise make_busy_error(self)
        try:
            began = time.perf_counter()
            pose = convert_to_pose(pose)
            try:
                self.limits.require_valid_step(pose, self._last_pose, dt)
            except LimitError:
                return self._make_refused_result(began)
            return self._compute_step(pose, dt, began)
        finally:
            self._guard.release()

    def _make_refused_result(self, began: float) -> ToolForce:
        """Return the last force with the status REFUSED."""
        return replace(self._answer, status=ForceStatus.REFUSED, iterations=0, compute_time=time.perf_counter() - began)

    def _make_zero_force(self, status: ForceStatus, pose: Pose, began: float, is_on_axis: bool = True) -> ToolForce:
        """Return the force of a tool without contact at a pose; `began` is the clock at the start of the step."""
        zero = FORCE_BEFORE_FIRST_STEP
        return ToolForce(zero.wrench, zero.stiffness_matrix, status, pose=pose, is_on_axis=is_on_axis,
                         compute_time=time.perf_counter() - began)

    @make_single_thread_method
    def set_parameters(self, **values: float) -> None:
        """Change parameters of the material; the state is kept, and the next step finds its equilibrium.

        Args:
            values: by name, as in `sensitivities`: ``C10``; paths through a mapping,
                ``set_parameters(**{"viscoelastic.terms[0].g": 0.2})``.

        Raises:
            InputError: an unknown parameter, an invalid value, or a modulus outside of the range of tissues
                (`tissue_sim.realtime.accepted_models`); nothing is changed.
        """
        material = with_values(self.model.material, values)
        require_equal_layer_thicknesses(self.model.material, material)
        require_moduli_in_range(material)
        self._set_material(material)

    def _set_material(self, material: Material) -> None:
        """Change the material; the history of effects in reduced form is kept."""
        self._send_material_to_solver(material)
        self.model = replace(self.model, material=material)
        history = self._reduced.history
        self._reduced = self._make_combined_force_factor(material)
        self._reduced.history = history

    def _make_combined_force_factor(self, material: Material) -> CombinedForceFactor:
        """Return the factor of a material's effects in reduced form on the force of this experiment's tool."""
        return CombinedForceFactor(
            material.list_acting_force_scaling_effects(plate=self.model.experiment.tool.is_plate))
