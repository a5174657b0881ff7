"""Common part of real-time simulations: locking, limits of poses and time steps, checks of models, material."""

from __future__ import annotations

import math
import threading
import time
from dataclasses import dataclass, fields, replace
from typing import Any

from tissue_sim.errors import InputError
from tissue_sim.experiment.experiment import Experiment
from tissue_sim.fem.taichi.launch import KernelOwner, make_busy_error, make_single_thread_method
from tissue_sim.material.effect import CombinedForceFactor
from tissue_sim.material.material import Material
from tissue_sim.model import Model
from tissue_sim.parameters import parameters, with_values
from tissue_sim.pose import Pose
from tissue_sim.public_names import OldName, rename_old_members_of_subclass
from tissue_sim.tool_force import ForceStatus, ToolForce, make_axial_stiffness_matrix, make_axial_wrench


@dataclass(frozen=True)
class AcceptedModulusRange:
    """Moduli that a real-time simulation accepts.

    Attributes:
        smallest: smallest shear modulus, Pa; softer than any gel.
        largest: largest modulus, Pa; stiffer than any tissue.
    """

    smallest: float = 1e-2
    largest: float = 1e9


#: Range of every real-time simulation.
MODULI = AcceptedModulusRange()


def require_real_time_experiment(experiment: Experiment) -> None:
    """Require an experiment with a tool, without tilt and partial slip, which are corrections of whole recordings.

    Raises:
        InputError: a gripped specimen, a tilted tool, or partial slip.
    """
    if experiment.grip is not None:
        raise InputError("must be None in real time, where the pose of a tool is given; got a gripped specimen. Use "
                         "tissue_sim.simulate, or KINDS['bonded_compression']", field="grip")
    if experiment.tilt:
        raise InputError("must be 0 in real time: the effect of a tilt is a correction of whole recordings. Leave the "
                         "tilt out", field="tilt")
    if experiment.slip:
        raise InputError("must be 0 in real time: partial slip is a correction of whole recordings. Leave the slip "
                         "out, or use a coefficient of friction", field="slip")


def require_moduli_in_range(material: Material) -> None:
    """Check that the moduli of a material are in the range of tissues and gels.

    Raises:
        InputError: a modulus above `AcceptedModulusRange.largest`, or a shear modulus below
            `AcceptedModulusRange.smallest`.
    """
    for each in parameters(material).values():
        if each.declaration.unit == "Pa" and not abs(each.value) <= MODULI.largest:
            raise InputError(f"must be at most {MODULI.largest:g} Pa; got {each.value:g} Pa.",
                             field=each.path)
    if not MODULI.smallest <= material.mu0 <= MODULI.largest:
        raise InputError(f"must give a shear modulus of {MODULI.smallest:g} to {MODULI.largest:g} Pa; got "
                         f"{material.mu0:g} Pa.",
                         field="parameters")


def require_equal_layer_thicknesses(before: Material, after: Material) -> None:
    """Check that two materials have layers of the same thickness, on which the mesh depends.

    Raises:
        InputError: other layers.
    """
    thick = [[layer.thickness for layer in material.layers] for material in (before, after)]
    if thick[0] != thick[1]:
        raise InputError("must keep the thickness of the layers, which is part of the mesh; make another simulator",
                         field="layers")


class LimitError(InputError):
    """A pose or a time step that a scene refuses: not finite, or beyond its limits."""


def convert_to_pose(pose: float | Pose) -> Pose:
    """Return a pose unchanged, or the upright pose on the axis at a depth, m; numbers may be NaN or infinite.

    Raises:
        InputError: something else than a pose of numbers, or than one real number.
    """
    if isinstance(pose, Pose):
        return pose
    if type(pose) is float:
        return Pose((0.0, 0.0, -pose))
    if isinstance(pose, str | bytes):
        raise _make_pose_error(pose)
    try:
        return Pose.at_depth(float(pose))
    except (TypeError, ValueError, OverflowError):
        raise _make_pose_error(pose) from None


def _make_pose_error(pose: object) -> InputError:
    """Make the error that an object is neither a pose nor a depth."""
    return InputError(f"must be a Pose, or a depth in m; got {pose!r}. Write Pose((x, y, z), (w, x, y, z)).",
                      field="pose")


@dataclass(frozen=True)
class MotionLimits:
    """Limits of poses and time steps, the same for a `Simulator` and for a server.

    Attributes:
        deepest: m below the undeformed top; deeper poses are refused.
        reach: m from the origin along each axis; poses farther away are refused.
        speed: m/s within the tissue; faster steps are refused. After a jump the tool is accepted again as soon as
            enough time has passed. A step of zero length has no speed. Above the tissue every speed is accepted.
        longest: s; longer time steps are refused.

    Raises:
        InputError: a limit that is not positive.
    """

    deepest: float = math.inf
    reach: float = 10.0
    speed: float = 100.0
    longest: float = 86400.0

    def __post_init__(self):
        for each in fields(self):
            number = getattr(self, each.name)
            if not number > 0.0:
                raise InputError(f"must be positive; got {number:g}.", field=each.name)

    require = OldName("require_valid_step")

    def __init_subclass__(cls, **options: Any):
        super().__init_subclass__(**options)
        rename_old_members_of_subclass(cls, {"require": "require_valid_step"})

    def require_valid_step(self, pose: Pose, before: Pose | None, dt: float) -> None:
        """Raise a `LimitError` for a pose or time step beyond the limits, before the step changes the tissue.

        Args:
            pose: of the tool at the end of the step.
            before: pose in the last accepted step; None before the first one.
            dt: length of the step, s.

        Raises:
            LimitError: a number that is not finite, or beyond a limit.
            InputError: a pose or a time that does not consist of numbers.
        """
        try:
            x, y, z = pose.position
            q, a, b, c = pose.orientation
            is_finite = math.isfinite(x + y + z + q + a + b + c)
            reach = self.reach
            is_near = -reach <= x <= reach and -reach <= y <= reach and -reach <= z <= reach
        except (TypeError, ValueError):
            raise InputError(f"must consist of numbers; got {pose!r}.", field="pose") from None
        if not is_finite:
            raise LimitError(f"position and orientation must be finite; got {pose!r}.", field="pose")
        if not is_near:
            raise LimitError(f"must be within {self.reach:g} m of the origin; got {pose.position}.",
                             field="position")
        if -z > self.deepest:
            raise LimitError(f"depth must be at most {self.deepest:g} m; got {-z:g} m.", field="position")
        try:
            is_possible = 0.0 <= dt <= self.longest
        except TypeError:
            raise InputError(f"dt must be a number of seconds; got {dt!r}.", field="time") from None
        if not is_possible:
            raise LimitError(f"dt must be 0 to {self.longest:g} s; got {dt:g} s.", field="time")
        if before is not None and dt > 0.0:
            u, v, w = before.position
            is_inside = z < 0.0 and w < 0.0
            length = math.hypot(x - u, y - v, z - w) if is_inside else abs(min(z, 0.0) - min(w, 0.0))
            if length > self.speed * dt:
                raise LimitError(f"speed within the tissue must be at most {self.speed:g} m/s; got {length:g} m in "
                                 f"{dt:g} s.", field="position")


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
                (`tissue_sim.realtime.tissue`); nothing is changed.
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
