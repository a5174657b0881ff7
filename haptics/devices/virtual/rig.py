"""A rig that needs no hardware: a simulated specimen behind a stage and a sensor, with the faults of a real one."""

from __future__ import annotations

import math
import random
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from haptics.devices.contracts import Bench, DeviceError, StageLimits
from haptics.devices.virtual.faults import Faults
from haptics.devices.virtual.force_sensor import VirtualForceSensor
from haptics.devices.virtual.stage import VirtualStage
from tissue_sim import ForceStatus, Model, Rig, Simulator, simulate
from tissue_sim import Protocol as Motion
from tissue_sim.errors import InputError
from tissue_sim.rig.loading_curve import LoadingCurve

#: The study's sensor, an ATI Mini40 SI-40-2: range along z, N, and what it resolves, N.
RANGE, RESOLUTION = 120.0, 0.02
#: The study's stage: room above the specimen and into it, m; fastest, m/s; a step of the motor, m.
LIMITS, STEP = StageLimits(-0.05, 0.03, 0.02), 1e-6
#: A curve is simulated at so many depths, and read from a table with so many steps, which goes on to this many depths.
_POINTS, _TABLE, _BEYOND = 41, 4000, 1.2
#: Over which time a speed is taken, s.
_MOMENT = 2e-3


class Specimen(Protocol):
    """What the tool presses."""

    def force(self, time: float, depth: float) -> float:
        """On the tool, N, at a time, s, that never goes back, and a depth, m, below zero in the air."""


class ElasticSpecimen:
    """Force by a converged simulation on the way in, which an elastic specimen repeats; compliant rigs included.

    Between the simulated depths a monotone cubic, beyond the deepest its tangent; read from a table so fine that it
    adds less than a millionth of the largest force.

    Args:
        model: experiment, material, and of the rig the compliance alone; its protocol is not asked.
        depth: m, to which it is simulated.
        resolution: of the simulation, as in `tissue_sim.simulate`.

    Raises:
        InputError: a material or a contact that remembers, or ages: give such a one to `RememberingSpecimen`.
    """

    def __init__(self, model: Model, depth: float, resolution: str = "accurate"):
        if model.depends_on_way:
            raise InputError("this specimen remembers how it was loaded; make a RememberingSpecimen of it",
                             field="model")
        ideal = replace(model, experiment=replace(model.experiment, protocol=Motion.ramp(depth, _POINTS)), rig=Rig())
        curve = LoadingCurve(simulate(ideal, resolution=resolution, estimate_error=False))
        self._step = _BEYOND * depth / _TABLE
        motion = self._step * np.arange(_TABLE + 1)
        self._forces = curve.force_behind(motion, model.rig.compliance, np.zeros(motion.size)).tolist()

    def force(self, time: float, depth: float) -> float:
        if depth <= 0.0:
            return 0.0
        place = depth / self._step
        below = min(int(place), _TABLE - 1)
        here, there = self._forces[below:below + 2]
        return here + (place - below) * (there - here)


class RememberingSpecimen:
    """Force by stepping the tissue to where the tool is: relaxation, softening, friction. A sample takes as long as a
    step.

    Args:
        model: experiment and material; its protocol is not asked.
        resolution: as in `tissue_sim.Simulator`.

    Raises:
        InputError: a rig with a compliance, which needs the whole curve.
    """

    def __init__(self, model: Model, resolution: str = "realtime"):
        if model.rig.compliance:
            raise InputError("a specimen that remembers has no compliance before it; leave it out",
                             field="rig.compliance")
        self._simulator = Simulator(model, resolution=resolution, inertia="off")
        self._simulator.warm_up()
        self._time: float | None = None

    def force(self, time: float, depth: float) -> float:
        passed = 1e-3 if self._time is None else time - self._time
        self._time = time
        answer = self._simulator.step(depth, max(passed, 1e-6))
        if answer.status is ForceStatus.REFUSED:
            raise DeviceError(f"the simulated specimen has no equilibrium at {depth * 1e3:.3g} mm; give a depth that "
                              "its "
                              "material bears")
        return answer.force


class VirtualRig:
    """A specimen between a stage and a sensor.

    The stage's position less `surface` is the motion that a `Rig` takes: offset, screw, backlash and lost steps move
    the tool, friction, damping, latency, gain, zero, drift and noise are read; compliance belongs to the specimen.

    Args:
        specimen: on the bench.
        rig: what stands between it and the numbers.
        surface: position of the stage at which a tool without `Rig.contact_offset` touches, m.
        limits: of the stage, m, m/s. start_at: where it stands before it is homed, m.
        channels: of the sensor; only ``Fz`` feels the specimen, with `sign`, and the others rest.
        sign: 1 or -1: what the sensor reads when it is pushed.
        rate: Hz. reach, resolution: of the sensor, N.
        encoder: whether the stage measures where it is.
        faults: of sensor and motor: saturation, drift, stall, disconnection.
        clock: s, never backwards.

    Raises:
        InputError: a rig with faults that were added to it, or with a sampling rate: the sensor has one.
    """

    def __init__(self, specimen: Specimen, rig: Rig | None = None, *, surface: float = 2e-3,
                 limits: StageLimits = LIMITS, start_at: float = -5e-3, channels: tuple[str, ...] = ("Fz",),
                 sign: int = 1, rate: float = 1000.0, reach: float = RANGE, resolution: float = RESOLUTION,
                 encoder: bool = True, faults: Faults | None = None, clock: Callable[[], float] = time.monotonic):
        rig, faults = rig or Rig(), faults or Faults()
        if rig.faults or rig.sampling_rate is not None:
            raise InputError("a rig on a bench has no added faults and no sampling rate; leave them out", field="rig")
        if "Fz" not in channels:
            raise InputError("the sensor feels along z; name Fz among its channels", field="channels")
        self._specimen, self._rig, self._surface, self._faults, self._sign = specimen, rig, surface, faults, sign
        self._axis, self._count, self._reach = channels.index("Fz"), len(channels), reach
        self._random = random.Random(rig.seed)
        self._noise, self._last, self._began = 0.0, -math.inf, math.inf
        self._tool_motion = replace(rig.motion_only, compliance=0.0).tool_motion
        self.stage = VirtualStage(limits, STEP, start_at, clock, encoder, faults.stall_after)
        self.sensor = VirtualForceSensor(self._load, channels, rate, resolution, reach, clock,
                                         silent_after=faults.disconnect_after)

    @property
    def bench(self) -> Bench:
        return Bench(self.sensor, self.stage)

    def _load(self, at: float) -> tuple[float, ...]:
        """What is read at a time on the clock, s: in every channel, N."""
        rig = self._rig
        self._began = min(self._began, at)
        seen = at - rig.latency
        place, before = self._depth(seen), self._depth(seen - _MOMENT)
        speed = (place - before) / _MOMENT
        force = self._specimen.force(seen, place)
        force += rig.guide_friction * ((speed > 0) - (speed < 0)) + rig.rate_damping * speed
        force = (1 + rig.sensor_gain) * force + rig.zero_offset + self._disturbance(at)
        if at - self._began >= self._faults.saturate_after:
            force = 2 * self._reach
        return tuple(self._sign * force if axis == self._axis else 0.0 for axis in range(self._count))

    def _depth(self, at: float) -> float:
        """Of the tool at a time, m."""
        return float(self._tool_motion(np.array(self._turns(at)) - self._surface)[-1])

    def _turns(self, at: float) -> Sequence[float]:
        """Where the stage turned round until then, and where it is, m: all that its play remembers."""
        return (*self.stage.turns(at), self.stage.tool_place(at))

    def _disturbance(self, at: float) -> float:
        """Noise and drift, N."""
        rig, time_constant = self._rig, self._rig.noise_correlation_time
        if rig.force_noise:
            kept = math.exp(-(at - self._last) / time_constant) if time_constant and at > self._last else 0.0
            fresh = math.sqrt(1.0 - kept * kept) * rig.force_noise
            self._noise = kept * self._noise + self._random.gauss(0.0, fresh)
            self._last = at
        return self._noise + (rig.sensor_drift + self._faults.drift) * (at - self._began)
