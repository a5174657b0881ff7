"""Rig: effects of load frame and sensor on a recording, such as backlash and noise of the sensor."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from math import inf
from numbers import Integral, Real
from typing import Any

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.parameters import list_field_declarations, parameter
from tissue_sim.public_names import OldName, with_old_names
from tissue_sim.recording.recording import Recording
from tissue_sim.rig.fault import RigFault
from tissue_sim.rig.loading_curve import FirstLoadingCurveWithHistory
from tissue_sim.settings import make_shallow_read_only_copy

#: Smallest reversal of the motion that moves the stage, as a fraction of the backlash.
_LEAST_REVERSAL = 1e-3


def compute_nut_positions_and_screw_samples(screw: np.ndarray, play: float) -> tuple[np.ndarray, np.ndarray]:
    """Compute the motion of the nut (play operator).

    The screw moves the nut downwards (to larger values) at once, and upwards only after `play`; at the first sample the
    play is taken up in the downward direction.

    Args:
        screw: positions in order of time, m, shape (n,).
        play: m, not negative.

    Returns:
        Positions of the nut, m, shape (n,); and the fractional sample number at which the screw was last at the
        position of the nut, by linear interpolation, shape (n,).

    Source: Krasnosel'skii and Pokrovskii, Systems with Hysteresis, 1989.
    """
    nut, since = screw.copy(), np.arange(screw.size, dtype=float)
    if not play:
        return nut, since
    positions = screw.tolist()
    for sample in range(1, screw.size):
        nut[sample] = min(max(nut[sample - 1], positions[sample]), positions[sample] + play)
        if nut[sample] == positions[sample]:
            continue
        since[sample] = since[sample - 1]
        if nut[sample] < nut[sample - 1]:
            before = int(since[sample])
            while positions[before + 1] >= nut[sample]:
                before += 1
            since[sample] = before + (positions[before] - nut[sample]) / (positions[before] - positions[before + 1])
    return nut, since


def generate_sensor_noise(samples: int, standard_deviation: float, seed: int, *, time: np.ndarray | None = None,
                          correlation_time: float = 0.0) -> np.ndarray:
    """Generate Gaussian noise with autocorrelation exp(-lag / correlation_time), white if that time is 0.

    Coloured noise is the Ornstein-Uhlenbeck process, exact for any spacing of the samples (Gillespie, Phys. Rev. E 54
    (1996) 2084); on a uniform grid it is the autoregressive process AR(1).

    Args:
        samples: number of samples n.
        standard_deviation: of every sample, in the unit of the result.
        seed: the same seed gives the same noise.
        time: s, shape (n,); required with a correlation time.
        correlation_time: s.

    Returns:
        Shape (n,).

    Raises:
        InputError: a correlation time without `time`.
    """
    noise = np.random.default_rng(seed).normal(0.0, standard_deviation, samples)
    if correlation_time:
        if time is None:
            raise InputError("time must be given if correlation_time is above 0; got None.", field="time")
        kept = np.exp(-np.diff(time) / correlation_time)
        fresh = np.sqrt(1.0 - kept**2) * noise[1:]
        for sample, (share, part) in enumerate(zip(kept.tolist(), fresh.tolist(), strict=True), start=1):
            noise[sample] = share * noise[sample - 1] + part
    return noise


#: Targets of the effects: motion of the tool.
_TOOL = "tool"
#: Reading of the true force.
_READING = "reading"
#: Single samples.
_SAMPLES = "samples"
#: Key of the target in the metadata of a field.
_ACTS_ON = "tissue_sim.acts_on"
#: Smallest relative error, 1; at -1 the reading would be reversed.
_REVERSED = -1.0 + 1e-9
#: Largest number of samples of a reading.
_MOST_SAMPLES = 10_000_000


def _declare_rig_effect(acts_on: str, symbol: str, unit: str, key: str, factor: float = 1.0, *,
                        low: float = -inf) -> Any:
    """Declare a field of the rig whose effect is absent at 0."""
    entry = parameter(symbol, unit, key=key, factor=factor, bounds=(low, inf), absent=0.0)
    return field(default=0.0, metadata={**entry.metadata, _ACTS_ON: acts_on})


@with_old_names(motion_only="with_motion_effects_only", reading_only="with_reading_effects_only",
                without_noise="without_sampling_effects", apply="apply_motion_effects",
                tool_motion="compute_unloaded_tool_displacement")
@dataclass(frozen=True, kw_only=True)
class Rig:
    """Effects of the load frame and the sensor. `Rig()` is ideal; 0 (None for the rate) means that an effect is absent.

    The protocol of a model is the motion D that the stage reports. The tool is at d =
    compute_unloaded_tool_displacement(D) - compliance F(d). The sensor reads, `latency` seconds later, (1 +
    sensor_gain) (F + guide_friction sign(v) + rate_damping v) + zero_offset + sensor_drift t + noise, with the speed v
    of the reported motion.

    Attributes:
        contact_offset: reported displacement at the true touch, m.
        displacement_gain: relative error of the lead screw, 1: the tool moves by 1 + gain times the reported motion.
        backlash: lost motion at a reversal, m; the play is taken up in the downward direction at the start.
        step_loss: displacement that the tool loses when the report first exceeds `step_loss_depth`, m.
        step_loss_depth: m.
        compliance: of the load train, m/N.
        guide_friction: Coulomb friction between tool and sensor, N, with the sign of the velocity, 0 at rest.
        rate_damping: N s/m.
        latency: delay of the force with respect to the displacement, s.
        sensor_gain: relative error of every force, 1.
        zero_offset: reading without load, N.
        sensor_drift: rate of the zero since the first sample, N/s.
        sampling_rate: of the reported recording, Hz; None: the samples of the protocol.
        force_noise: standard deviation, N.
        noise_correlation_time: s, of noise with autocorrelation exp(-lag / time); 0 for white noise.
        force_resolution, displacement_resolution: step of the reported numbers, N and m.
        seed: of the noise; the same seed gives the same recording.
        faults: additional faults by name; see `tissue_sim.rig.fault`. A sequence of faults is accepted. They act first
            on the motion of the tool, and last, before noise and resolution, on the reading.

    Raises:
        InputError: a value outside of its range, with the field ``rig.NAME``.
    """

    contact_offset: float = _declare_rig_effect(_TOOL, "d0", "m", "contact_offset_mm", 1e-3)
    displacement_gain: float = _declare_rig_effect(_TOOL, "eps_d", "1", "displacement_gain", low=_REVERSED)
    backlash: float = _declare_rig_effect(_TOOL, "b", "m", "backlash_mm", 1e-3, low=0.0)
    step_loss: float = _declare_rig_effect(_TOOL, "s", "m", "step_loss_mm", 1e-3)
    step_loss_depth: float = _declare_rig_effect(_TOOL, "d_s", "m", "step_loss_depth_mm", 1e-3)
    compliance: float = _declare_rig_effect(_TOOL, "c", "m/N", "compliance_mm_per_N", 1e-3, low=0.0)
    guide_friction: float = _declare_rig_effect(_READING, "F_c", "N", "guide_friction_N", low=0.0)
    rate_damping: float = _declare_rig_effect(_READING, "eta", "N s/m", "rate_damping_N_s_per_mm", 1e3, low=0.0)
    latency: float = _declare_rig_effect(_READING, "dt", "s", "latency_s", low=0.0)
    sensor_gain: float = _declare_rig_effect(_READING, "eps_F", "1", "sensor_gain", low=_REVERSED)
    zero_offset: float = _declare_rig_effect(_READING, "F0", "N", "zero_offset_N")
    sensor_drift: float = _declare_rig_effect(_READING, "r", "N/s", "sensor_drift_N_per_s")
    sampling_rate: float | None = field(default=None, metadata={_ACTS_ON: _SAMPLES, **parameter(
        "f", "Hz", key="sampling_rate_Hz", bounds=(1e-9, inf)).metadata})
    force_noise: float = _declare_rig_effect(_SAMPLES, "sigma", "N", "force_noise_N", low=0.0)
    noise_correlation_time: float = _declare_rig_effect(_SAMPLES, "tau_n", "s", "noise_correlation_time_s", low=0.0)
    force_resolution: float = _declare_rig_effect(_SAMPLES, "q_F", "N", "force_resolution_N", low=0.0)
    displacement_resolution: float = _declare_rig_effect(_SAMPLES, "q_d", "m", "displacement_resolution_mm", 1e-3,
                                                         low=0.0)
    seed: int = 0
    faults: Mapping[str, RigFault] = field(default_factory=dict)

    def __post_init__(self):
        given = self.faults.values() if isinstance(self.faults, Mapping) else self.faults
        faults = {fault.name: fault for fault in given}
        object.__setattr__(self, "faults", make_shallow_read_only_copy(faults))
        if not isinstance(self.seed, Integral) or isinstance(self.seed, bool) or self.seed < 0:
            raise InputError(f"must be an integer of 0 or more; got {self.seed!r}.", field="rig.seed")
        for name, what in list_field_declarations(type(self)).items():
            value, low = getattr(self, name), what.bounds[0]
            if name == "sampling_rate" and value is None:
                continue
            if not isinstance(value, Real) or isinstance(value, bool) or not abs(value) <= sys.float_info.max:
                raise InputError(f"must be a finite number; got {value!r}.", field=f"rig.{name}")
            if low == _REVERSED and value <= -1:
                raise InputError(f"must be a relative error above -1, such as 0.01; got {value:g}.",
                                 field=f"rig.{name}")
            if low == 0.0 and value < 0:
                raise InputError(f"must be 0 (absent) or positive; got {value:g}.", field=f"rig.{name}")
            if name == "sampling_rate" and value <= 0:
                raise InputError(f"must be positive, or None; got {value:g} Hz.", field="rig.sampling_rate")

    #: Old names.
    ideal = OldName("is_ideal")
    readings = OldName("count_readings")

    @property
    def is_ideal(self) -> bool:
        """Whether the rig has no effect."""
        return replace(self, seed=0, step_loss_depth=0.0, noise_correlation_time=0.0) == Rig()

    @property
    def with_motion_effects_only(self) -> Rig:
        """Rig with the effects on the motion of the tool only."""
        return self._make_rig_with_effects_on_targets(_TOOL,
                                                      faults=[fault for fault in self.faults.values()
                                                              if fault.moves_tool])

    @property
    def with_reading_effects_only(self) -> Rig:
        """Rig with the effects on the reading of forces only, without noise."""
        return self._make_rig_with_effects_on_targets(_READING,
                                                      faults=[fault for fault in self.faults.values() if fault.reads])

    @property
    def without_sampling_effects(self) -> Rig:
        """Rig without noise, resolution and sampling rate."""
        return self._make_rig_with_effects_on_targets(_TOOL, _READING, faults=self.faults)

    @property
    def with_sampling_effects_only(self) -> Rig:
        """Rig with noise, resolution, sampling rate and seed only."""
        return replace(self._make_rig_with_effects_on_targets(_SAMPLES, faults=()), seed=self.seed)

    @property
    def needs_time(self) -> bool:
        """Whether a reading depends on the time or the speed of the motion."""
        return any((self.latency, self.rate_damping, self.sensor_drift, self.sampling_rate,
                    *(fault.needs_time for fault in self.faults.values())))

    def _make_rig_with_effects_on_targets(self, *targets: str, faults: Any) -> Rig:
        """Return a rig with only the effects on the given targets, and the given faults."""
        own = {entry.name: getattr(self, entry.name) for entry in fields(self)
               if entry.metadata.get(_ACTS_ON) in targets}
        return Rig(**own, faults=faults)

    def count_readings(self, time: np.ndarray) -> int:
        """Return the number of samples that the rig reports for a recording with sample times `time`, s, shape (n,)."""
        if self.sampling_rate is None or not len(time):
            return len(time)
        # The tolerance keeps the last sample despite rounding.
        return int((time[-1] - time[0]) * self.sampling_rate + 1e-6) + 1

    def compute_unloaded_tool_displacement(self, displacement) -> np.ndarray:
        """Return the displacement of the tool, m, for reported displacements, if the load train is rigid.

        Args:
            displacement: reported by the stage, m, in order of time, shape (n,).

        Returns:
            m, shape (n,).
        """
        screw = self._compute_tool_position_set_by_screw(
            self._apply_faults_to_motion(np.asarray(displacement, dtype=float)))
        return compute_nut_positions_and_screw_samples(screw, self.backlash)[0]

    def require_support_of_force_control(self) -> None:
        """Refuse effects that have no model in a test that is controlled by the force at the load cell.

        Raises:
            InputError: the rig has latency, guide friction, rate damping, a zero offset, lost steps or faults.
        """
        for name in ("latency", "guide_friction", "rate_damping", "zero_offset", "step_loss"):
            if value := getattr(self, name):
                raise InputError(f"must be 0 with a prescribed force; got {value:g}. Remove the effect or prescribe "
                                 "the displacement", field=f"rig.{name}")
        if self.faults:
            raise InputError(f"must be empty with a prescribed force; got {', '.join(self.faults)}. Remove the faults "
                             "or prescribe the displacement", field="rig.faults")

    def compute_controlled_force(self, reading: float, elapsed: float) -> float:
        """Return the force on the tool, N, at which the load cell reads a force, N, `elapsed` s after the start.

        Gain and drift of the sensor act; noise does not, because the control filters the noise.
        """
        return (reading - self.sensor_drift * elapsed) / (1.0 + self.sensor_gain)

    def compute_reading_without_noise(self, force: float, elapsed: float) -> float:
        """Return the inverse of `compute_controlled_force`: the reading, N, of a force on the tool, N."""
        return (1.0 + self.sensor_gain) * force + self.sensor_drift * elapsed

    def compute_reported_displacement(self, position: float, before: tuple[float, float] | None) -> float:
        """Return the displacement that the stage reports, m: the inverse of `compute_unloaded_tool_displacement`.

        Args:
            position: of the tool with a rigid load train, m.
            before: position and reported displacement, m, when the stage last moved; None at the first sample.
                Reversals up to `_LEAST_REVERSAL` of the backlash are rounding errors of a held force: the stage then
                stays at rest.
        """
        play = 0.0
        if before is not None:
            change = position - before[0]
            # The screw first takes up the play when the tool turns.
            play_before = before[0] - (before[1] - self.contact_offset) * (1.0 + self.displacement_gain)
            turns = play_before > 0.5 * self.backlash if change > 0 else play_before < 0.5 * self.backlash
            if change == 0 or (turns and abs(change) <= _LEAST_REVERSAL * self.backlash):
                return before[1]
            play = self.backlash if change < 0 else 0.0
        return (position - play) / (1.0 + self.displacement_gain) + self.contact_offset

    def apply_motion_effects(self, recording: Recording) -> Recording:
        """Return the recording with the true force under this rig for the same reported motion; no new simulation.

        Let E(d) be the force on first loading. The ideal recording is F = R E(D), where R contains the effect of
        history (relaxation, unloading, friction, softening). The result is F = R E(d) with R at the same time and
        d + compliance F = `compute_unloaded_tool_displacement`. It is exact, except for interpolation between samples,
        for a material without history; with history it is an approximation for tool motions that differ little from D.

        Args:
            recording: recording of an ideal rig, computed at d = D.
        """
        if not len(recording):
            return recording
        # With backlash the history is that at the time when the screw was at the present position of the nut.
        motion, history = compute_nut_positions_and_screw_samples(
            self._compute_tool_position_set_by_screw(self._apply_faults_to_motion(recording.displacement)),
            self.backlash)
        if not self.compliance and np.array_equal(motion, recording.displacement):
            return recording
        force = FirstLoadingCurveWithHistory(recording).solve_force_on_compliant_rig(motion, self.compliance, history)
        return recording.with_channels(force=force)

    def read(self, recording: Recording) -> Recording:
        """Return the report of sensor and stage for a recording of reported displacement and true force.

        The recording is linear between its samples. At new sampling times, labels are those of the last sample before,
        and fields are left out.

        Raises:
            InputError: a recording without time, if the effects need it, or more than 10,000,000 samples.

        Examples:
            >>> true = Recording({"displacement": [0.0, 1e-3], "force": [0.0, 2.0]})
            >>> Rig(sensor_gain=0.1, zero_offset=0.5).read(true).force
            array([0.5, 2.7])
        """
        if self.is_ideal or not len(recording):
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
        reported = recording if self.sampling_rate is None else self._resample_recording(recording, self.sampling_rate)
        if self.latency or reported is not recording:
            read = reported.time - self.latency
            # Friction belongs to the interval between two samples: it is piecewise constant and not interpolated.
            interval = np.minimum(np.searchsorted(recording.time, read), len(recording) - 1)
            force = np.interp(read, recording.time, recording.force) + friction[interval]
        force = (1.0 + self.sensor_gain) * force + self.zero_offset
        if self.sensor_drift:
            force = force + self.sensor_drift * (reported.time - reported.time[0])
        if self.faults:
            reported = reported.with_channels(force=force)
            for fault in self.faults.values():
                reported = fault.reading(reported)
            force = reported.force
        if self.force_noise:
            force = force + generate_sensor_noise(force.size, self.force_noise, self.seed,
                                                  time=reported.time if self.noise_correlation_time else None,
                                                  correlation_time=self.noise_correlation_time)
        displacement = _round_to_resolution(reported.displacement, self.displacement_resolution)
        return reported.with_channels(displacement=displacement,
                                      force=_round_to_resolution(force, self.force_resolution))

    def measure(self, recording: Recording) -> Recording:
        """Return the report of this rig for an ideal recording: `apply_motion_effects`, then `read`.

        An ideal rig returns the recording itself.
        """
        return self.read(self.apply_motion_effects(recording))

    def _apply_faults_to_motion(self, reported: np.ndarray) -> np.ndarray:
        """Return the displacement of the lead screw, m, after the faults of `faults` that move the tool."""
        for fault in self.faults.values():
            reported = fault.tool_motion(reported)
        return reported

    def _compute_tool_position_set_by_screw(self, reported: np.ndarray) -> np.ndarray:
        """Return the position of the tool, m, that the lead screw sets while the play is taken up downwards."""
        lost = self.step_loss * (np.maximum.accumulate(reported) > self.step_loss_depth)
        return (1.0 + self.displacement_gain) * (reported - lost - self.contact_offset)

    def _resample_recording(self, recording: Recording, rate: float) -> Recording:
        """Resample a recording at a sampling rate, Hz."""
        time = recording.time
        samples = (time[-1] - time[0]) * rate
        if samples > _MOST_SAMPLES:
            raise InputError(f"{rate:g} Hz over {time[-1] - time[0]:g} s are more than {_MOST_SAMPLES} samples; use a "
                             "lower rate", field="rig.sampling_rate")
        # A new sample that coincides with an old one except for rounding is moved to the old one.
        slack = 1e-6 / rate
        grid = time[0] + np.arange(self.count_readings(time)) / rate
        before = np.searchsorted(time, grid + slack, side="right") - 1
        grid = np.where(grid - time[before] < slack, time[before], grid)
        channels = {name: np.interp(grid, time, values) for name, values in recording.channels.items()}
        labels = {name: values[before] for name, values in recording.labels.items()}
        return replace(recording, channels={**channels, "time": grid}, labels=labels, fields=None)


def _round_to_resolution(values: np.ndarray, resolution: float) -> np.ndarray:
    """Return the values rounded to multiples of the resolution; unchanged if the resolution is 0."""
    return np.round(values / resolution) * resolution if resolution else values
