"""Readout of simulated forces: rig, effects in reduced form, and sensor faults at the samples of a recording.

A rig with compliance, backlash or offsets moves the tool to other positions than it reports. While the force depends on
the position alone (path-independent tests), one simulated loading curve is evaluated at the true positions of the tool
without a new simulation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from calibration.campaign.measured import MeasuredCurve
from calibration.campaign.parameter_space import ParameterSpace
from calibration.forward.contract import InfeasibleError
from calibration.forward.motion import (
    DIFFERENCES,
    MOTION_STEPS,
    ForceCurve,
    MonotonicLoading,
    build_cubic_or_linear_spline,
)
from tissue_sim.experiment.experiment import Experiment
from tissue_sim.experiment.protocol import STUDY_SPEED
from tissue_sim.material.effect import ForceScalingEffect
from tissue_sim.model import Model
from tissue_sim.parameters import with_values
from tissue_sim.recording.recording import Recording
from tissue_sim.rig.rig import Rig
from tissue_sim.simulation import split_tilted_face_into_strips

#: Steps to the largest reported depth, equal to those of a timed motion; a deeper tool continues the same spacing.
STEPS = MOTION_STEPS.timed_steps


@dataclass(frozen=True)
class ToolPositionSolverSettings:
    """Settings of the computation of the tool position behind a compliant load train.

    Attributes:
        step_tolerance: fraction of the last step within which the tool counts as at the last knot.
        position_tolerance: tolerance of the tool position, relative to the largest depth.
        max_iterations: maximum number of iterations of Newton's method for the tool position.
        min_growth: smallest ratio of stage displacement to tool displacement, 1 + C dF/dx, for which the equilibrium
            counts as stable; below it the load train is unstable (snap-through).
    """

    step_tolerance: float = 1e-3
    position_tolerance: float = 1e-12
    max_iterations: int = 60
    min_growth: float = 0.1


_POSITION_SOLVER = ToolPositionSolverSettings()


def build_loading_to_true_depth(depth: float, deepest: float, limit: float) -> MonotonicLoading:
    """Return a monotonic loading from zero depth to the deepest true position of the tool, at most `limit`.

    Args:
        depth: largest reported depth, m.
        deepest: largest true depth of the tool, m.
        limit: largest depth of a knot, m.
    """
    ratio = (max(deepest, depth) / depth) ** (1.0 / MOTION_STEPS.sliding_power)
    steps = max(STEPS, int(np.ceil(STEPS * ratio - _POSITION_SOLVER.step_tolerance)))
    knots = depth * (np.arange(steps + 1) / STEPS) ** MOTION_STEPS.sliding_power
    return MonotonicLoading(np.append(knots[knots < limit], limit) if knots[-1] > limit else knots, STUDY_SPEED)


@dataclass(frozen=True, eq=False)
class ForcePositionCurve:
    """Force and its derivatives as functions of the tool position.

    Attributes:
        columns: interpolant of force and derivatives with respect to the parameters, force first.
        force_alone: interpolant of the force.
        end: largest simulated position, m.
        holds: whether the tissue pulls at a tool that retracts past the first contact; otherwise the force is zero.
        strips: strips of a tilted face: lag of each strip behind the deepest one, m, and its fraction of the face.
    """

    columns: Any
    force_alone: Any
    end: float
    holds: bool
    strips: list[tuple[float, float]]

    @classmethod
    def from_knot_values(cls, depth: np.ndarray, columns: np.ndarray, *, holds: bool,
                         tilt: float = 0.0) -> ForcePositionCurve:
        """Return the curve that interpolates values at knots.

        Args:
            depth: depth of the knots from 0 on, m, shape (k,).
            columns: force and derivatives at the knots, force first, shape (k, m).
            holds: see `ForcePositionCurve`.
            tilt: height difference across the tool's face, m.
        """
        return cls(build_cubic_or_linear_spline(depth, columns), build_cubic_or_linear_spline(depth, columns[:, 0]),
                   float(depth[-1]), holds, _divide_tilted_face(tilt))

    def with_tilt(self, tilt: float) -> ForcePositionCurve:
        """Return a copy of the curve for a tool face with another tilt (height difference across the face, m)."""
        return replace(self, strips=_divide_tilted_face(tilt))

    def __call__(self, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Evaluate the curve at tool positions.

        Args:
            position: tool positions, m, shape (n,).

        Returns:
            Force and derivatives, shape (n, m), and the derivative of the force by the position, N/m, shape (n,).
        """
        columns, slope = np.zeros(()), np.zeros(())
        for lag, fraction in self.strips:
            depth, velocity = _compute_strip_depth_and_derivative(position, lag)
            inside, contact = self._clip_positions_and_get_contact_factor(depth)
            rates = self._derivatives_by_position(inside) * contact[:, None]
            columns = columns + fraction * (self.columns(inside) * contact[:, None] + rates * (depth - inside)[:, None])
            slope = slope + fraction * velocity * rates[:, 0]
        return columns, slope

    @cached_property
    def _derivatives_by_position(self) -> Any:
        """Interpolant of the derivatives of all columns (force and its derivatives) with respect to tool position."""
        return self.columns.derivative()

    def compute_force(self, position: np.ndarray) -> np.ndarray:
        """Return the force at tool positions in m, N, same shape as `position`."""
        force = np.zeros(position.shape)
        for lag, fraction in self.strips:
            depth, _ = _compute_strip_depth_and_derivative(position, lag)
            inside, contact = self._clip_positions_and_get_contact_factor(depth)
            beyond = depth - inside
            part = self.force_alone(inside)
            if beyond.any():
                part = part + self.force_alone(inside, 1) * beyond
            force += fraction * contact * part
        return force

    def _clip_positions_and_get_contact_factor(self, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return positions limited to the simulated range, and a factor: 1 if the tissue exerts a force, else 0.

        Callers extrapolate the force linearly beyond the simulated range.
        """
        return np.clip(position, 0.0, self.end), np.ones(position.shape) if self.holds else (
            position >= 0.0).astype(float)


def _divide_tilted_face(tilt: float) -> list[tuple[float, float]]:
    """Return (lag behind the deepest strip in m, fraction of the face area) of each strip; one strip without tilt."""
    return split_tilted_face_into_strips(tilt) if tilt else [(0.0, 1.0)]


def _compute_strip_depth_and_derivative(position: np.ndarray, lag: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions of a strip of a tilted face, m, and their derivatives with respect to the face position."""
    if not lag:
        return position, np.ones(position.shape)
    inside = np.maximum(position - lag, 0.0)
    return np.where(position > 0, inside, position), ((inside > 0) | (position <= 0)).astype(float)


@dataclass(frozen=True, eq=False)
class RigForceCurve:
    """Force at the samples of a recording, from the true tool positions behind the compliant load train.

    Attributes:
        curve: force against tool position.
        motion: tool positions with a rigid load train at the samples, m, shape (n,).
        compliance: compliance C of the load train, m/N.
        neighbours: index of a column -> curve with a slightly larger value of the parameter of this column, and the
            difference of the values, for a finite difference.
    """

    curve: ForcePositionCurve
    motion: np.ndarray
    compliance: float
    neighbours: Mapping[int, tuple[RigForceCurve, float]] = field(default_factory=dict)

    def __call__(self, time: np.ndarray | None, displacement: np.ndarray,
                 offset: float) -> tuple[np.ndarray, np.ndarray]:
        """Evaluate force and derivatives at the samples of the recording.

        Args:
            time: unused; the samples are those of `motion`.
            displacement: unused.
            offset: contact offset, m.

        Returns:
            Force and derivatives, shape (n, m), and the derivative of the force by the contact offset, N/m, shape (n,).

        Raises:
            InfeasibleError: the load train is unstable (snap-through), or the tool has no equilibrium position.
        """
        position = self.compute_tool_positions(offset)
        columns, slope = self.curve(position)
        growth = 1.0 + self.compliance * slope
        if growth.min(initial=1.0) < _POSITION_SOLVER.min_growth:
            raise InfeasibleError("the force decreases with depth so steeply that the compliant load train is unstable "
                                  "(snap-through)")
        columns[:, 1:] /= growth[:, None]
        rate = -slope / growth
        # The force is zero before the first contact.
        before_contact = ~np.maximum.accumulate(position >= 0.0)
        columns[before_contact], rate[before_contact] = 0.0, 0.0
        for number, (other, step) in self.neighbours.items():
            columns[:, number] = (other.compute_force_at_contact_offsets(time, displacement, np.array([offset]))[:, 0]
                                  - columns[:, 0]) / step
        return columns, rate

    def compute_force_at_contact_offsets(self, time: np.ndarray | None, displacement: np.ndarray,
                                         offsets: np.ndarray) -> np.ndarray:
        """Return the force at the samples for several contact offsets, m; shape (n, offsets)."""
        position = self.compute_tool_positions(offsets)
        return np.where(np.maximum.accumulate(position >= 0.0, axis=0), self.curve.compute_force(position), 0.0)

    def compute_tool_positions(self, offset: float | np.ndarray) -> np.ndarray:
        """Return the tool positions at the samples.

        Newton's method solves the equilibrium x + C F(x) = s of tool position x and stage position s.

        Args:
            offset: contact offset, m, a number or shape (offsets,).

        Returns:
            Positions, m, shape (n,) or (n, offsets).

        Raises:
            InfeasibleError: the tool has no equilibrium position with the load train.
        """
        stage = self.motion - offset if np.ndim(offset) == 0 else self.motion[:, None] - offset
        if not self.compliance:
            return stage
        position, tolerance = stage, _POSITION_SOLVER.position_tolerance * np.abs(stage).max(initial=1e-6)
        step = 1e-6 * np.abs(stage).max(initial=1e-6)
        for _ in range(_POSITION_SOLVER.max_iterations):
            force = self.curve.compute_force(position)
            stiffness = (self.curve.compute_force(position + step) - force) / step
            change = (stage - position - self.compliance * force) / np.maximum(1.0 + self.compliance * stiffness,
                                                                               _POSITION_SOLVER.min_growth)
            position = position + change
            if np.abs(change).max(initial=0.0) <= tolerance:
                return position
        raise InfeasibleError("no equilibrium position of the tool behind the compliant load train was found")


def is_path_dependent_with_rig(model: Model) -> bool:
    """Return whether the force of a model depends on the path of the tool and not on the tool position alone.

    Effects in reduced form are path-dependent too if the true depth of the tool differs from the reported one.
    """
    reduced = model.material.list_acting_force_scaling_effects(plate=model.experiment.tool.is_plate)
    return model.is_path_dependent or bool(reduced and (model.rig.compliance or model.experiment.tilt))


def tool_separates_on_retraction(experiment: Experiment) -> bool:
    """Return whether the tool separates from the tissue when it retracts past the first contact."""
    return experiment.friction != "bonded" and experiment.adhesion is None and not experiment.contact_laws


def is_rig_or_tilt_parameter(path: str) -> bool:
    """Return whether a parameter belongs to the rig or is the tilt, so that the tissue's response does not change.

    Args:
        path: path of the parameter.
    """
    return path.startswith("rig.") or path == "experiment.tilt"


def make_model_without_rig_and_tilt(model: Model) -> Model:
    """Return a copy of the model with an ideal rig and without tilt: the tool is at the position of the stage."""
    return replace(model, experiment=replace(model.experiment, tilt=0.0), rig=Rig())


def compute_difference_step(value: float) -> float:
    """Return the step of a finite difference at a parameter value, in the unit of the parameter.

    Readings depend almost linearly on the parameters of the readout, so a small relative step is accurate.
    """
    return DIFFERENCES.relative * (abs(value) or 1.0)


def parameter_affects_readings_only(rig: Rig, path: str, value: float) -> bool:
    """Return whether a parameter of a rig changes only the readings, and not the motion of the tool.

    Args:
        rig: rig with the parameter.
        path: path of the parameter in the rig.
        value: value near which the motion is compared.
    """
    changed = with_values(rig, {path: value + compute_difference_step(value)})
    return changed.with_motion_effects_only == with_values(rig, {path: value}).with_motion_effects_only


@dataclass(frozen=True, eq=False)
class RigReadout:
    """Conversion of true forces to the readings of a rig."""

    rig: Rig

    @cached_property
    def reading_only_rig_or_none(self) -> Rig | None:
        """Rig that has only the faults that change readings; None if no fault changes readings."""
        reading = self.rig.with_reading_effects_only
        return None if reading.is_ideal else reading

    def convert_to_readings(self, measured: MeasuredCurve, force: np.ndarray) -> np.ndarray:
        """Return the readings of the force sensor, N, shape (n,), for given true forces.

        Args:
            measured: recording with displacement and time of the samples.
            force: true force at the samples, N, shape (n,).
        """
        if self.reading_only_rig_or_none is None:
            return force
        channels = {"displacement": measured.displacement, "force": force}
        if measured.time is not None:
            channels["time"] = measured.time
        return self.reading_only_rig_or_none.read(Recording(channels)).force

    def convert_derivatives_to_readings(self, measured: MeasuredCurve, true: np.ndarray, read: np.ndarray,
                                        rates: np.ndarray, rate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Convert derivatives of the true force to derivatives of the readings.

        Args:
            measured: recording.
            true: true force, N, shape (n,).
            read: readings of `true`, N, shape (n,).
            rates: derivatives of the true force with respect to the parameters, shape (n, p).
            rate: derivative of the true force with respect to the contact offset, shape (n,).

        Returns:
            Derivatives of the readings, shapes (n, p) and (n,).
        """
        if not any(fault.reads for fault in self.rig.faults.values()):
            gain = 1.0 + self.rig.sensor_gain
            return gain * rates, gain * rate
        # A registered fault may be any function of the force history: directional derivatives by finite differences.
        columns = np.column_stack([rates, rate])
        for index, column in enumerate(columns.T):
            if column.any():
                step = DIFFERENCES.relative * max(float(np.abs(true).max()), 1e-6) / np.abs(column).max()
                columns[:, index] = (self.convert_to_readings(measured, true + step * column) - read) / step
        return columns[:, :-1], columns[:, -1]


@dataclass(frozen=True, eq=False)
class ForceFactorEffects:
    """Effects of the material that are applied after the simulation, as a factor of the simulated force.

    These effects are jumps of the force, which an interpolation between the knots of a simulation would smear.

    Attributes:
        effects: acting effects.
    """

    effects: tuple[ForceScalingEffect, ...]

    @classmethod
    def from_model(cls, model: Model) -> ForceFactorEffects:
        """Return the effects of a model that are applied after the simulation.

        With a tilted tool or a rig that changes the motion, the simulation applies the effects and this object is
        empty.
        """
        ideal = not model.experiment.tilt and model.rig.with_motion_effects_only.is_ideal
        return cls(model.material.list_acting_force_scaling_effects(plate=model.experiment.tool.is_plate) if ideal
                   else ())

    def has_effect_parameter(self, path: str) -> bool:
        """Return whether a parameter of the material belongs to one of these effects."""
        part = path.rpartition(".")[0]
        return any(part in (effect.name, f"effects.{effect.name}") for effect in self.effects)

    def remove_effects_from_model(self, model: Model) -> Model:
        """Return a copy of the model without these effects, so that a simulation does not apply the effects twice."""
        material = model.material
        if not self.effects:
            return model
        kept = {name: effect for name, effect in material.effects.items() if effect not in self.effects}
        puncture = None if material.puncture in self.effects else material.puncture
        return replace(model, material=replace(material, puncture=puncture, effects=kept))

    def compute_force_factor(self, measured: MeasuredCurve, depth: np.ndarray) -> np.ndarray:
        """Return the factor by which the effects multiply the simulated force at the samples of a recording.

        Args:
            measured: recording.
            depth: true depth of the tool at the samples, m, shape (n,) or (n, k).

        Returns:
            Factor, dimensionless, shape of `depth`.
        """
        deepest = np.maximum.accumulate(depth, axis=0)
        clock = np.zeros(depth.shape[0]) if measured.time is None else measured.time - measured.time[0]
        time = np.broadcast_to(clock.reshape(-1, *[1] * (depth.ndim - 1)), depth.shape)
        factor = np.ones(depth.shape)
        for effect in self.effects:
            factor = factor * effect.compute_force_factors(depth, deepest, time)
        return factor


def compute_depth_in_tissue(curve: ForceCurve | RigForceCurve, measured: MeasuredCurve,
                            offset: float | np.ndarray) -> np.ndarray:
    """Return the true depth of the tool at the samples of a recording; negative before contact.

    Args:
        curve: force curve of the recording.
        measured: recording.
        offset: contact offset, m, a number or shape (offsets,).

    Returns:
        Depth, m, shape (n,) or (n, offsets).
    """
    if isinstance(curve, RigForceCurve):
        return curve.compute_tool_positions(offset)
    return measured.displacement - offset if np.ndim(offset) == 0 else measured.displacement[:, None] - offset


@dataclass(frozen=True, eq=False)
class SimulatedTestForceCurves:
    """Simulated force curves of one test at one set of parameters, and the readout of each recording.

    Attributes:
        curves: force and derivatives of each recording.
        readouts: readout of each recording.
        effects: effects in reduced form of each recording.
        space: parameter space.
        values: name -> value of all parameters, SI.
        differences: names of parameters whose derivatives are finite differences.
    """

    curves: Sequence[ForceCurve | RigForceCurve]
    readouts: list[RigReadout]
    effects: list[ForceFactorEffects]
    space: ParameterSpace
    values: dict[str, float]
    differences: frozenset[str]
