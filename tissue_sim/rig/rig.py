"""The rig: what stands between the tissue and the numbers."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from math import inf
from numbers import Integral, Real
from typing import Any

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.frozen_mapping import read_only
from tissue_sim.parameters import declared, parameter
from tissue_sim.recording.recording import Recording
from tissue_sim.rig.backlash import follow
from tissue_sim.rig.fault import RigFault
from tissue_sim.rig.loading_curve import LoadingCurve
from tissue_sim.rig.noise import sensor_noise

#: What a field of the rig acts on: where the tool goes, what is read of the true force, or single samples.
_TOOL, _READING, _SAMPLES = "tool", "reading", "samples"
_ACTS_ON = "tissue_sim.acts_on"
#: A relative error must stay above -1, or it would reverse the reading.
_REVERSED = -1.0 + 1e-9
_MOST_SAMPLES = 10_000_000


def _effect(acts_on: str, symbol: str, unit: str, key: str, factor: float = 1.0, *, low: float = -inf) -> Any:
    """A field that is absent at 0."""
    entry = parameter(symbol, unit, key=key, factor=factor, bounds=(low, inf), absent=0.0)
    return field(default=0.0, metadata={**entry.metadata, _ACTS_ON: acts_on})


@dataclass(frozen=True, kw_only=True)
class Rig:
    """Effects of the load frame and the sensor. `Rig()` is ideal; 0 (None for the rate) leaves an effect out.

    A model's protocol is the motion D that the stage reports. The tool is at d = tool_motion(D) - compliance F(d), and
    the sensor, `latency` seconds later, reads (1 + sensor_gain)(F + guide_friction sign(v) + rate_damping v) +
    zero_offset + sensor_drift t + noise, v being the speed of the reported motion.

    Attributes:
        contact_offset: reported displacement at which the tool truly touches, m.
        displacement_gain: relative error of the lead screw: the tool moves 1 + gain times what is reported.
        backlash: lost motion at a reversal, m; none at the start, where the play is taken up downwards.
        step_loss: how far the tool stays behind from the first time the report passes `step_loss_depth` on, m.
        step_loss_depth: m.
        compliance: of the load train, m/N.
        guide_friction: Coulomb friction that the sensor feels, N, with the sign of the velocity, 0 at rest.
        rate_damping: N s/m.
        latency: by how much force is read later than displacement, s.
        sensor_gain: relative error of every force.
        zero_offset: reading without load, N.
        sensor_drift: of the zero since the first sample, N/s.
        sampling_rate: Hz of the reported recording; None keeps the samples of the protocol.
        force_noise: standard deviation, N.
        noise_correlation_time: s, of noise with autocorrelation exp(-lag / time); 0 is white.
        force_resolution, displacement_resolution: what the reported numbers are multiples of, N and m.
        seed: of the noise; the same seed gives the same recording.
        faults: what was added beside these, by name; see `tissue_sim.rig.fault`. A sequence of faults is taken, too.
            They come first in what moves the tool, and last, before noise and resolution, in what is read.

    Raises:
        InputError: a value out of its range, with the field ``rig.NAME``.
    """

    contact_offset: float = _effect(_TOOL, "d0", "m", "contact_offset_mm", 1e-3)
    displacement_gain: float = _effect(_TOOL, "eps_d", "1", "displacement_gain", low=_REVERSED)
    backlash: float = _effect(_TOOL, "b", "m", "backlash_mm", 1e-3, low=0.0)
    step_loss: float = _effect(_TOOL, "s", "m", "step_loss_mm", 1e-3)
    step_loss_depth: float = _effect(_TOOL, "d_s", "m", "step_loss_depth_mm", 1e-3)
    compliance: float = _effect(_TOOL, "c", "m/N", "compliance_mm_per_N", 1e-3, low=0.0)
    guide_friction: float = _effect(_READING, "F_c", "N", "guide_friction_N", low=0.0)
    rate_damping: float = _effect(_READING, "eta", "N s/m", "rate_damping_N_s_per_mm", 1e3, low=0.0)
    latency: float = _effect(_READING, "dt", "s", "latency_s", low=0.0)
    sensor_gain: float = _effect(_READING, "eps_F", "1", "sensor_gain", low=_REVERSED)
    zero_offset: float = _effect(_READING, "F0", "N", "zero_offset_N")
    sensor_drift: float = _effect(_READING, "r", "N/s", "sensor_drift_N_per_s")
    sampling_rate: float | None = field(default=None, metadata={_ACTS_ON: _SAMPLES, **parameter(
        "f", "Hz", key="sampling_rate_Hz", bounds=(1e-9, inf)).metadata})
    force_noise: float = _effect(_SAMPLES, "sigma", "N", "force_noise_N", low=0.0)
    noise_correlation_time: float = _effect(_SAMPLES, "tau_n", "s", "noise_correlation_time_s", low=0.0)
    force_resolution: float = _effect(_SAMPLES, "q_F", "N", "force_resolution_N", low=0.0)
    displacement_resolution: float = _effect(_SAMPLES, "q_d", "m", "displacement_resolution_mm", 1e-3, low=0.0)
    seed: int = 0
    faults: Mapping[str, RigFault] = field(default_factory=dict)

    def __post_init__(self):
        given = self.faults.values() if isinstance(self.faults, Mapping) else self.faults
        faults = {fault.name: fault for fault in given}
        object.__setattr__(self, "faults", read_only(faults))
        if not isinstance(self.seed, Integral) or isinstance(self.seed, bool) or self.seed < 0:
            raise InputError(f"{self.seed!r} is not a seed; give a whole number, 0 or above", field="rig.seed")
        for name, what in declared(type(self)).items():
            value, low = getattr(self, name), what.bounds[0]
            if name == "sampling_rate" and value is None:
                continue
            if not isinstance(value, Real) or isinstance(value, bool) or not abs(value) <= sys.float_info.max:
                raise InputError(f"{value!r} is not a finite number", field=f"rig.{name}")
            if low == _REVERSED and value <= -1:
                raise InputError(f"{value:g} would reverse the reading; give a relative error above -1, such as 0.01",
                                 field=f"rig.{name}")
            if low == 0.0 and value < 0:
                raise InputError(f"{value:g} is negative; give 0 (absent) or a number above", field=f"rig.{name}")
            if name == "sampling_rate" and value <= 0:
                raise InputError(f"{value:g} Hz is not a rate; give one above 0, or None", field="rig.sampling_rate")

    @property
    def ideal(self) -> bool:
        """Whether the rig reports exactly what happens."""
        return replace(self, seed=0, step_loss_depth=0.0, noise_correlation_time=0.0) == Rig()

    @property
    def motion_only(self) -> Rig:
        """The rig as far as it moves the tool: it reads every force as it is."""
        return self._acting_on(_TOOL, faults=[fault for fault in self.faults.values() if fault.moves_tool])

    @property
    def reading_only(self) -> Rig:
        """The rig as far as it reads forces: the tool is where the stage says, and there is no noise."""
        return self._acting_on(_READING, faults=[fault for fault in self.faults.values() if fault.reads])

    @property
    def without_noise(self) -> Rig:
        """The rig without what it does to single samples: noise, resolution, a sampling rate."""
        return self._acting_on(_TOOL, _READING, faults=self.faults)

    @property
    def needs_time(self) -> bool:
        """Whether what it reads depends on the time, or on the speed, of the motion."""
        return any((self.latency, self.rate_damping, self.sensor_drift, self.sampling_rate,
                    *(fault.needs_time for fault in self.faults.values())))

    def _acting_on(self, *targets: str, faults: Any) -> Rig:
        own = {entry.name: getattr(self, entry.name) for entry in fields(self)
               if entry.metadata.get(_ACTS_ON) in targets}
        return Rig(**own, faults=faults)

    def readings(self, time: np.ndarray) -> int:
        """How many samples it reports of a recording at these times, s, shape (n,)."""
        if self.sampling_rate is None or not len(time):
            return len(time)
        # Rounding must not lose the last sample.
        return int((time[-1] - time[0]) * self.sampling_rate + 1e-6) + 1

    def tool_motion(self, displacement) -> np.ndarray:
        """Where the tool would be with a rigid load train.

        Args:
            displacement: reported by the stage, m, in the order of time, shape (n,).

        Returns:
            m, shape (n,).
        """
        return follow(self._screw(self._faulty(np.asarray(displacement, dtype=float))), self.backlash)[0]

    def apply(self, recording: Recording) -> Recording:
        """The true force under this rig for the same reported motion, from an ideal recording and without a new solve.

        With E(d) the force when depth d was first reached, the ideal recording is F = R E(D), where R holds what
        history does (relaxation, unloading, friction, softening). The answer is R E(d), R taken at the same time and
        d + compliance F = `tool_motion`. Exact, but for interpolation between the samples, for a material without
        history; with history an approximation for tool motions that differ little from D.

        Args:
            recording: computed at d = D, the reported displacement.
        """
        if not len(recording):
            return recording
        # The history of the tissue is what it was when the screw stood where the nut is now.
        motion, history = follow(self._screw(self._faulty(recording.displacement)), self.backlash)
        if not self.compliance and np.array_equal(motion, recording.displacement):
            return recording
        force = LoadingCurve(recording).force_behind(motion, self.compliance, history)
        return recording.with_channels(force=force)

    def read(self, recording: Recording) -> Recording:
        """What the sensor and the stage report of a recording of reported displacement and true force.

        Between its samples the recording is taken as straight lines. At new sampling times, labels are those of the
        last sample before and fields are left out.

        Raises:
            InputError: a recording without the time that the effects need, or more samples than anyone can keep.
        """
        if self.ideal or not len(recording):
            return recording
        step = np.diff(recording.displacement, prepend=recording.displacement[0])
        if "segment" in recording.labels:
            step = np.where(recording.labels["segment"] == "hold", 0.0, step)
        friction = self.guide_friction * np.sign(step)
        if self.rate_damping:
            duration = np.diff(recording.time, prepend=recording.time[0])
            friction = friction + self.rate_damping * np.divide(step, duration, out=np.zeros_like(step),
                                                                where=duration > 0)
        force = recording.force + friction
        reported = recording if self.sampling_rate is None else self._resampled(recording, self.sampling_rate)
        if self.latency or reported is not recording:
            seen = reported.time - self.latency
            # Friction belongs to the way from one sample to the next: it jumps, it is not interpolated.
            way = np.minimum(np.searchsorted(recording.time, seen), len(recording) - 1)
            force = np.interp(seen, recording.time, recording.force) + friction[way]
        force = (1.0 + self.sensor_gain) * force + self.zero_offset
        if self.sensor_drift:
            force = force + self.sensor_drift * (reported.time - reported.time[0])
        if self.faults:
            reported = reported.with_channels(force=force)
            for fault in self.faults.values():
                reported = fault.reading(reported)
            force = reported.force
        if self.force_noise:
            force = force + sensor_noise(force.size, self.force_noise, self.seed,
                                         time=reported.time if self.noise_correlation_time else None,
                                         correlation_time=self.noise_correlation_time)
        return reported.with_channels(displacement=_rounded(reported.displacement, self.displacement_resolution),
                                      force=_rounded(force, self.force_resolution))

    def measure(self, recording: Recording) -> Recording:
        """What this rig reports instead of an ideal recording of the same reported motion: `apply`, then `read`.

        An ideal rig returns the recording itself.
        """
        return self.read(self.apply(recording))

    def _faulty(self, reported: np.ndarray) -> np.ndarray:
        """Where the screw is told to go by what was added, m."""
        for fault in self.faults.values():
            reported = fault.tool_motion(reported)
        return reported

    def _screw(self, reported: np.ndarray) -> np.ndarray:
        """Where the lead screw holds the tool while the play is taken up downwards, m."""
        lost = self.step_loss * (np.maximum.accumulate(reported) > self.step_loss_depth)
        return (1.0 + self.displacement_gain) * (reported - lost - self.contact_offset)

    def _resampled(self, recording: Recording, rate: float) -> Recording:
        """The recording on the grid of a sampling rate."""
        time = recording.time
        samples = (time[-1] - time[0]) * rate
        if samples > _MOST_SAMPLES:
            raise InputError(f"{rate:g} Hz over {time[-1] - time[0]:g} s are more than {_MOST_SAMPLES} "
                             "samples; give a lower rate", field="rig.sampling_rate")
        # Rounding must not put a sample just beside one that it falls on.
        slack = 1e-6 / rate
        grid = time[0] + np.arange(self.readings(time)) / rate
        before = np.searchsorted(time, grid + slack, side="right") - 1
        grid = np.where(grid - time[before] < slack, time[before], grid)
        channels = {name: np.interp(grid, time, values) for name, values in recording.channels.items()}
        labels = {name: values[before] for name, values in recording.labels.items()}
        return replace(recording, channels={**channels, "time": grid}, labels=labels, fields=None)


def _rounded(values: np.ndarray, resolution: float) -> np.ndarray:
    return np.round(values / resolution) * resolution if resolution else values
