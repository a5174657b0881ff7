"""Readout of simulated forces: effects in reduced form and sensor faults at the samples of a recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from calibration.campaign.measured import MeasuredCurve
from calibration.campaign.parameter_space import ParameterSpace
from calibration.forward.difference_steps import DIFFERENCES
from calibration.forward.motion import ForceCurve
from calibration.forward.rig_motion import RigForceCurve
from tissue_sim.material.effect import ForceScalingEffect
from tissue_sim.model import Model
from tissue_sim.parameters import with_values
from tissue_sim.recording.recording import Recording
from tissue_sim.rig.rig import Rig


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
