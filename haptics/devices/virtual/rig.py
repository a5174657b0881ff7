"""A simulated test rig: a finite-element specimen between a stage and a force sensor, with the faults of a real rig."""

from __future__ import annotations

import math
import random
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from haptics.devices.contracts import Bench, DeviceError, StageLimits
from haptics.devices.virtual.faults import Faults
from haptics.devices.virtual.force_sensor import VirtualForceSensor
from haptics.devices.virtual.stage import VirtualStage
from tissue_sim import ForceStatus, Model, Rig, Simulator, simulate
from tissue_sim import Protocol as Motion
from tissue_sim.errors import InputError
from tissue_sim.rig.loading_curve import FirstLoadingCurveWithHistory


@dataclass(frozen=True)
class VirtualSensorAndStageDefaults:
    """Properties of the default sensor and stage of a virtual rig.

    Attributes:
        sensor_range: range of the sensor along z, N, as of an ATI Mini40 SI-40-2.
        sensor_resolution: resolution of the sensor along z, N, as of an ATI Mini40 SI-40-2.
        stage_step: length of a motor step of the stage, m.
        speed_interval: interval of the backward difference that gives the tool's speed, s. A longer interval smooths
            the speed and delays it.
    """

    sensor_range: float = 120.0
    sensor_resolution: float = 0.02
    stage_step: float = 1e-6
    speed_interval: float = 2e-3


#: Default sensor and stage.
DEFAULTS = VirtualSensorAndStageDefaults()
#: Travel and top speed of the default stage, from 50 mm above its zero to 30 mm below, at 20 mm/s.
STAGE_LIMITS = StageLimits(-0.05, 0.03, 0.02)


@dataclass(frozen=True)
class CurveTableSettings:
    """Resolution of an `ElasticSpecimenForceModel`'s force-depth curve."""

    #: Number of simulated depths; a monotone cubic interpolates between them.
    points: int = 41
    #: Number of table intervals; with 4000 linear interpolation adds an error below 1e-6 of the largest force.
    intervals: int = 4000
    #: Largest depth of the table divided by the largest simulated depth; beyond the latter the tangent continues.
    extent: float = 1.2


#: Resolution of all `ElasticSpecimenForceModel`s.
_TABLE = CurveTableSettings()


class SpecimenForceModel(Protocol):
    """Interface of a simulated specimen: force on the tool for time and depth."""

    def advance_and_get_force(self, time: float, depth: float) -> float:
        """Return the force on the tool, N.

        Args:
            time: Time, s; it never decreases from call to call.
            depth: Depth of the tool, m; negative above the surface.
        """


class ElasticSpecimenForceModel:
    """Force-depth curve of an elastic specimen, from one converged simulation of its loading; unloading is the same.

    The curve includes the rig's compliance. A monotone cubic interpolates between simulated depths and its tangent
    continues beyond them; calls read a table, see `CurveTableSettings`.

    Args:
        model: Experiment, material and compliance of the rig; protocol and other rig parameters are ignored.
        depth: Largest simulated depth, m.
        resolution: Resolution of the simulation, as in `tissue_sim.simulate`.

    Raises:
        InputError: Material or contact depend on the loading history; use `HistoryDependentForceModel`.
    """

    def __init__(self, model: Model, depth: float, resolution: str = "accurate"):
        if model.is_path_dependent:
            raise InputError("the material must be independent of the loading history for an "
                             "ElasticSpecimenForceModel; make a "
                             "HistoryDependentForceModel", field="model")
        ideal = replace(model, experiment=replace(model.experiment, protocol=Motion.ramp(depth, _TABLE.points)),
                        rig=Rig())
        curve = FirstLoadingCurveWithHistory(simulate(ideal, resolution=resolution, estimate_error=False))
        self._step = _TABLE.extent * depth / _TABLE.intervals
        motion = self._step * np.arange(_TABLE.intervals + 1)
        self._forces = curve.solve_force_on_compliant_rig(motion, model.rig.compliance, np.zeros(motion.size)).tolist()

    def advance_and_get_force(self, time: float, depth: float) -> float:
        """Return the force, N, at a depth, m, by linear interpolation in the table; 0 above the surface."""
        if depth <= 0.0:
            return 0.0
        index = depth / self._step
        below = min(int(index), _TABLE.intervals - 1)
        lower, upper = self._forces[below:below + 2]
        return lower + (index - below) * (upper - lower)


class HistoryDependentForceModel:
    """Force of a specimen with relaxation, softening or friction, by one simulator step per call.

    Args:
        model: Experiment and material; its protocol is ignored.
        resolution: Resolution of the simulator, as in `tissue_sim.Simulator`.

    Raises:
        InputError: The rig has a compliance, which requires the complete force-depth curve.
    """

    def __init__(self, model: Model, resolution: str = "realtime"):
        if model.rig.compliance:
            raise InputError("the compliance of the rig must be 0 for a history-dependent specimen; "
                             f"got {model.rig.compliance:g} m/N. Leave it out", field="rig.compliance")
        self._simulator = Simulator(model, resolution=resolution, inertia="off")
        self._simulator.warm_up()
        self._time: float | None = None

    def advance_and_get_force(self, time: float, depth: float) -> float:
        """Step the simulation to a time, s, and a depth, m, and return the force, N.

        Raises:
            DeviceError: the simulation refuses the step, or finds no equilibrium.
        """
        dt = 1e-3 if self._time is None else time - self._time
        self._time = time
        answer = self._simulator.step(depth, max(dt, 1e-6))
        if answer.status is ForceStatus.REFUSED:
            raise DeviceError(f"the simulated specimen refuses a step to {depth * 1e3:.3g} mm in {dt:.3g} s: depth and "
                              "time must be finite and within the limits of the simulator; check the stage's motion")
        if answer.status is ForceStatus.STOPPED:
            raise DeviceError(f"the simulated specimen has no equilibrium at {depth * 1e3:.3g} mm; use a smaller depth")
        return answer.force


class VirtualRig:
    """A virtual stage and a virtual sensor with a specimen between them.

    The stage's position minus `surface` is the motion that `Rig` describes: contact offset, screw error, backlash and
    lost steps change the tool's motion; guide friction, rate damping, latency, gain, zero offset, drift and noise
    change the reading. The specimen accounts for the compliance.

    Args:
        specimen: SpecimenForceModel under the tool.
        rig: Errors of the rig; None: none.
        surface: Stage position at first contact without `Rig.contact_offset`, m.
        limits: Travel and top speed of the stage.
        start_at: Stage position before homing, m.
        channels: Channels of the sensor; ``Fz`` reads the specimen's force, the others read 0.
        sign: Sign of ``Fz`` when the specimen pushes the tool back, 1 or -1.
        rate: Sampling rate of the sensor, Hz.
        reach: Range of the sensor, N.
        resolution: Resolution of the sensor, N.
        encoder: True if the stage measures its position.
        faults: Faults of sensor and motor: saturation, drift, stall, disconnection.
        clock: Monotonic clock, s.

    Raises:
        InputError: The rig has added faults or a sampling rate, or ``Fz`` is not among the channels.
    """

    def __init__(self, specimen: SpecimenForceModel, rig: Rig | None = None, *, surface: float = 2e-3,
                 limits: StageLimits = STAGE_LIMITS, start_at: float = -5e-3, channels: tuple[str, ...] = ("Fz",),
                 sign: int = 1, rate: float = 1000.0, reach: float = DEFAULTS.sensor_range,
                 resolution: float = DEFAULTS.sensor_resolution, encoder: bool = True, faults: Faults | None = None,
                 clock: Callable[[], float] = time.monotonic):
        rig, faults = rig or Rig(), faults or Faults()
        if rig.faults or rig.sampling_rate is not None:
            raise InputError("the rig must have no added faults and no sampling rate in a VirtualRig; leave them out",
                             field="rig")
        if "Fz" not in channels:
            raise InputError(f"the channels must contain Fz, the axis of the tool; got {', '.join(channels)}. Name Fz "
                             "among them",
                             field="channels")
        self._specimen, self._rig, self._surface, self._faults, self._sign = specimen, rig, surface, faults, sign
        self._axis, self._count, self._reach = channels.index("Fz"), len(channels), reach
        self._random = random.Random(rig.seed)
        #: Last noise, N, its time, s, and time of the first sample, s.
        self._noise, self._last, self._began = 0.0, -math.inf, math.inf
        self._tool_motion = replace(rig.with_motion_effects_only, compliance=0.0).compute_unloaded_tool_displacement
        self.stage = VirtualStage(limits, DEFAULTS.stage_step, start_at, clock, encoder, faults.stall_after)
        self.sensor = VirtualForceSensor(self._advance_and_get_channel_loads, channels, rate, resolution, reach, clock,
                                         silent_after=faults.disconnect_after)

    @property
    def bench(self) -> Bench:
        """The virtual sensor and the virtual stage of this rig as a `Bench`; neither is started here."""
        return Bench(self.sensor, self.stage)

    def _advance_and_get_channel_loads(self, at: float) -> tuple[float, ...]:
        """Return the load of each channel, N, at a time on the clock, s; advances the specimen and the noise to it."""
        rig = self._rig
        self._began = min(self._began, at)
        delayed = at - rig.latency
        depth, before = self._compute_tool_depth(delayed), self._compute_tool_depth(delayed - DEFAULTS.speed_interval)
        speed = (depth - before) / DEFAULTS.speed_interval
        force = self._specimen.advance_and_get_force(delayed, depth)
        force += rig.guide_friction * ((speed > 0) - (speed < 0)) + rig.rate_damping * speed
        force = (1 + rig.sensor_gain) * force + rig.zero_offset + self._sample_noise_plus_drift(at)
        if at - self._began >= self._faults.saturate_after:
            force = 2 * self._reach
        return tuple(self._sign * force if axis == self._axis else 0.0 for axis in range(self._count))

    def _compute_tool_depth(self, at: float) -> float:
        """Return the depth, m, of the tool below the surface at a time on the clock, s, with the errors of the rig."""
        return float(self._tool_motion(np.array(self._list_reversals_and_position(at)) - self._surface)[-1])

    def _list_reversals_and_position(self, at: float) -> Sequence[float]:
        """Return the stage's first position, reversals until a time, s, and position then, m; for the backlash."""
        return (*self.stage.list_first_and_reversal_positions(at), self.stage.compute_tool_position_with_stall(at))

    def _sample_noise_plus_drift(self, at: float) -> float:
        """Return noise (a Gauss-Markov process) plus drift, N; advances the noise to a time on the clock, s."""
        rig, time_constant = self._rig, self._rig.noise_correlation_time
        if rig.force_noise:
            correlation = math.exp(-(at - self._last) / time_constant) if time_constant and at > self._last else 0.0
            innovation = math.sqrt(1.0 - correlation * correlation) * rig.force_noise
            self._noise = correlation * self._noise + self._random.gauss(0.0, innovation)
            self._last = at
        return self._noise + (rig.sensor_drift + self._faults.drift) * (at - self._began)
