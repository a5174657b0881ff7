"""The rig: what stands between the tissue and the numbers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from numbers import Integral, Real

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.recording.recording import Recording
from tissue_sim.rig.backlash import follow
from tissue_sim.rig.loading_curve import LoadingCurve
from tissue_sim.rig.noise import sensor_noise

_NOT_NEGATIVE = ("compliance", "backlash", "latency", "guide_friction", "rate_damping", "force_resolution",
                 "displacement_resolution", "force_noise", "noise_correlation_time")
#: What moves the tool, and what is of single samples; every other field acts on the reading of the force.
_MOTION = ("contact_offset", "displacement_gain", "backlash", "step_loss", "step_loss_depth", "compliance")
_SAMPLES = ("sampling_rate", "force_noise", "noise_correlation_time", "force_resolution", "displacement_resolution",
            "seed")
_RELATIVE = ("displacement_gain", "sensor_gain")
_MOST_SAMPLES = 10_000_000


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

    Raises:
        InputError: a value out of its range, with the field ``rig.NAME``.
    """

    contact_offset: float = 0.0
    displacement_gain: float = 0.0
    backlash: float = 0.0
    step_loss: float = 0.0
    step_loss_depth: float = 0.0
    compliance: float = 0.0
    guide_friction: float = 0.0
    rate_damping: float = 0.0
    latency: float = 0.0
    sensor_gain: float = 0.0
    zero_offset: float = 0.0
    sensor_drift: float = 0.0
    sampling_rate: float | None = None
    force_noise: float = 0.0
    noise_correlation_time: float = 0.0
    force_resolution: float = 0.0
    displacement_resolution: float = 0.0
    seed: int = 0

    def __post_init__(self):
        for name in (entry.name for entry in fields(self)):
            value = getattr(self, name)
            if name == "seed":
                if not isinstance(value, Integral) or isinstance(value, bool) or value < 0:
                    raise InputError(f"{value!r} is not a seed; give a whole number, 0 or above", field="rig.seed")
                continue
            if name == "sampling_rate" and value is None:
                continue
            if not isinstance(value, Real) or isinstance(value, bool) or not np.isfinite(value):
                raise InputError(f"{value!r} is not a finite number", field=f"rig.{name}")
            if name in _NOT_NEGATIVE and value < 0:
                raise InputError(f"{value:g} is negative; give 0 (absent) or a number above", field=f"rig.{name}")
            if name in _RELATIVE and value <= -1:
                raise InputError(f"{value:g} would reverse the reading; give a relative error above -1, such as 0.01",
                                 field=f"rig.{name}")
            if name == "sampling_rate" and value <= 0:
                raise InputError(f"{value:g} Hz is not a rate; give one above 0, or None", field="rig.sampling_rate")

    @property
    def ideal(self) -> bool:
        """Whether the rig reports exactly what happens."""
        return replace(self, seed=0, step_loss_depth=0.0, noise_correlation_time=0.0) == Rig()

    @property
    def motion_only(self) -> Rig:
        """The rig as far as it moves the tool: it reads every force as it is."""
        return self._without(lambda name: name not in _MOTION)

    @property
    def reading_only(self) -> Rig:
        """The rig as far as it reads forces: the tool moves as reported, and samples are taken as they are."""
        return self._without(lambda name: name in (*_MOTION, *_SAMPLES))

    @property
    def without_noise(self) -> Rig:
        """The rig without what it does to single samples: rate, noise and resolution."""
        return self._without(lambda name: name in _SAMPLES)

    def _without(self, left_out: Callable[[str], bool]) -> Rig:
        ideal = Rig()
        return replace(self, **{entry.name: getattr(ideal, entry.name) for entry in fields(self)
                                if left_out(entry.name)})

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
        return follow(self._screw(np.asarray(displacement, dtype=float)), self.backlash)[0]

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
        motion, history = follow(self._screw(recording.displacement), self.backlash)
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
        reported = recording if self.sampling_rate is None else self._resampled(recording)
        if self.latency or reported is not recording:
            seen = reported.time - self.latency
            # Friction belongs to the way from one sample to the next: it jumps, it is not interpolated.
            way = np.minimum(np.searchsorted(recording.time, seen), len(recording) - 1)
            force = np.interp(seen, recording.time, recording.force) + friction[way]
        force = (1.0 + self.sensor_gain) * force + self.zero_offset
        if self.sensor_drift:
            force = force + self.sensor_drift * (reported.time - reported.time[0])
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

    def _screw(self, reported: np.ndarray) -> np.ndarray:
        """Where the lead screw holds the tool while the play is taken up downwards, m."""
        lost = self.step_loss * (np.maximum.accumulate(reported) > self.step_loss_depth)
        return (1.0 + self.displacement_gain) * (reported - lost - self.contact_offset)

    def _resampled(self, recording: Recording) -> Recording:
        """The recording on the grid of the sampling rate."""
        time = recording.time
        samples = (time[-1] - time[0]) * self.sampling_rate
        if samples > _MOST_SAMPLES:
            raise InputError(f"{self.sampling_rate:g} Hz over {time[-1] - time[0]:g} s are more than {_MOST_SAMPLES} "
                             "samples; give a lower rate", field="rig.sampling_rate")
        # Rounding must not put a sample just beside one that it falls on.
        slack = 1e-6 / self.sampling_rate
        grid = time[0] + np.arange(self.readings(time)) / self.sampling_rate
        before = np.searchsorted(time, grid + slack, side="right") - 1
        grid = np.where(grid - time[before] < slack, time[before], grid)
        channels = {name: np.interp(grid, time, values) for name, values in recording.channels.items()}
        labels = {name: values[before] for name, values in recording.labels.items()}
        return replace(recording, channels={**channels, "time": grid}, labels=labels, fields=None)


def _rounded(values: np.ndarray, resolution: float) -> np.ndarray:
    return np.round(values / resolution) * resolution if resolution else values
