"""Recordings of tests; measurements and simulations have the same type.

Time or displacement of a test at constant speed is computed from the other. Tool and kind of test in the metadata are
compared with the expected ones.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import isclose
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np

from tissue_sim.errors import InputError, make_hint_with_similar_or_known_words
from tissue_sim.settings import make_shallow_read_only_copy

#: Channel -> quantity of its unit. SI inside: s, m, N, Pa, K.
CHANNELS: dict[str, str] = {
    "time": "time", "displacement": "length", "force": "force",
    "stretch": "ratio", "nominal stress": "stress", "shear strain": "ratio",
    "angle": "angle", "torque": "torque", "temperature": "temperature",
    "frequency": "frequency", "storage modulus": "stress", "loss modulus": "stress", "loss factor": "ratio",
    "complex modulus": "stress",
    "displacement 2": "length", "force 2": "force", "stretch 2": "ratio", "nominal stress 2": "stress",
    "Fx": "force", "Fy": "force", "Fz": "force", "Tx": "torque", "Ty": "torque", "Tz": "torque",
}
#: Channel of a motion -> its value at rest. The first one of a recording is used.
MOTIONS = {"displacement": 0.0, "stretch": 1.0, "shear strain": 0.0, "angle": 0.0}
#: Channels of a load. The first one of a recording is used.
LOADS = ("force", "nominal stress", "torque")
#: Channel of a motion along a second axis -> its value at rest.
SECOND_MOTIONS = {"displacement 2": 0.0, "stretch 2": 1.0}
#: Channels of a load along a second axis.
SECOND_LOADS = ("force 2", "nominal stress 2")
#: Channels from which stress and strain follow by the sizes of the specimen only.
SIZE_DEPENDENT = ("displacement", "force", "angle", "torque", "displacement 2", "force 2")
#: Names of the labels of samples.
LABELS = ("segment", "cycle")
#: Fewest samples of a recording.
MIN_POINTS = 5


@dataclass(frozen=True, eq=False)
class Recording:
    """One replicate of one test.

    Attributes:
        channels: name in `CHANNELS` -> values in SI, all of shape (n,), read-only. Displacement is positive into the
            tissue, force positive when the tissue pushes back; stretch and nominal stress carry their sign
            (compression: stretch below 1, stress below 0). Channels of a second axis end with 2.
        labels: ``segment`` (str) and ``cycle`` (int), each of shape (n,), where they exist.
        metadata: the sidecar: specimen, tool, device configuration, source file, SHA-256, solver status, ...
        fields: converged fields of a simulation (see `tissue_sim.Fields`), None for a measurement.

    Raises:
        InputError: unknown channel, channels of different length, a value that is not finite, time running backwards.

    Examples:
        >>> recording = Recording({"displacement": [0.0, 1e-3, 2e-3], "force": [0.0, 0.5, 1.1]})
        >>> len(recording), "force" in recording
        (3, True)
        >>> recording.select(slice(1, None)).force
        array([0.5, 1.1])
    """

    channels: Mapping[str, np.ndarray]
    labels: Mapping[str, np.ndarray] = field(default_factory=dict)
    metadata: Mapping[str, Any] = field(default_factory=dict)
    fields: Any = None

    def __post_init__(self):
        channels, length = {}, None
        for name, values in self.channels.items():
            if name not in CHANNELS:
                raise InputError(f"unknown channel{make_hint_with_similar_or_known_words(name, CHANNELS)}", field=name)
            # Read-only arrays are shared, not copied, because recordings are large and share their channels.
            array = values if _is_owned_read_only_array(values) else np.array(values, dtype=float)
            array.flags.writeable = False
            if array.ndim != 1 or length not in (None, array.size):
                raise InputError(f"shape {array.shape}, expected {length if length is not None else 'one list of'} "
                                 "numbers", field=name)
            bad = np.flatnonzero(~np.isfinite(array))
            if bad.size:
                raise InputError(f"value {bad[0] + 1} is {array[bad[0]]}, expected a finite number", field=name)
            channels[name], length = array, array.size
        if not channels:
            raise InputError("a recording needs at least one channel", field="channels")
        for name, values in self.labels.items():
            if name not in LABELS:
                raise InputError(
                    f"unknown label channel (one text per sample){make_hint_with_similar_or_known_words(name, LABELS)}",
                    field=name)
            if len(values) != length:
                raise InputError(f"must have one label per sample; got {len(values)} labels for {length} "
                                 "samples.", field=name)
        if "time" in channels:
            back = np.flatnonzero(np.diff(channels["time"]) < 0)
            if back.size:
                raise InputError(f"time runs backwards after sample {back[0] + 1} ({channels['time'][back[0]]:g} s, "
                                 f"then {channels['time'][back[0] + 1]:g} s)", field="time")
        object.__setattr__(self, "channels", make_shallow_read_only_copy(channels))
        labels = {name: np.array(values) for name, values in self.labels.items()}
        for values in labels.values():
            values.flags.writeable = False
        object.__setattr__(self, "labels", make_shallow_read_only_copy(labels))
        object.__setattr__(self, "metadata", make_shallow_read_only_copy(self.metadata))

    def __reduce__(self):
        # The constructor makes the arrays of another process read-only.
        return type(self), (dict(self.channels), dict(self.labels), dict(self.metadata), self.fields)

    def __len__(self) -> int:
        return next(iter(self.channels.values())).size

    def __contains__(self, channel: str) -> bool:
        return channel in self.channels

    def channel(self, name: str) -> np.ndarray:
        """Return the values of a channel, SI units, shape (n,).

        Raises:
            InputError: the recording has no such channel.
        """
        if name not in self.channels:
            raise InputError(f"this recording has no {name!r}; it has {', '.join(self.channels)}", field=name,
                             file=self.metadata.get("source"))
        return self.channels[name]

    @property
    def time(self) -> np.ndarray:
        """Time, s, shape (n,)."""
        return self.channel("time")

    @property
    def displacement(self) -> np.ndarray:
        """Tool displacement, m, positive into the tissue."""
        return self.channel("displacement")

    @property
    def force(self) -> np.ndarray:
        """Force on the tool, N, positive when the tissue pushes back."""
        return self.channel("force")

    @property
    def name(self) -> str:
        """Name in the metadata; empty without a name."""
        return str(self.metadata.get("name", ""))

    def with_channels(self, **channels) -> Recording:
        """Return a copy with channels replaced or added (SI)."""
        return replace(self, channels={**self.channels, **channels})

    def with_metadata(self, **metadata) -> Recording:
        """Return a copy with metadata replaced or added."""
        return replace(self, metadata={**self.metadata, **metadata})

    def select(self, samples) -> Recording:
        """Return a recording of the samples of a boolean mask, slice or index array."""
        return replace(self, channels={name: values[samples] for name, values in self.channels.items()},
                       labels={name: values[samples] for name, values in self.labels.items()}, fields=None)


def _is_owned_read_only_array(values: Any) -> bool:
    """Return whether values are a read-only array of float that owns its memory."""
    return (isinstance(values, np.ndarray) and values.dtype == float and values.base is None
            and not values.flags.writeable)


#: Largest relative difference of equal radii.
_RADIUS_TOLERANCE = 0.01


def get_recorded_tool_if_different_or_empty(recording: Recording, shape: str, radius: float | None) -> str:
    """Return the tool in the metadata if it differs from the expected shape or radius (m); else an empty text."""
    stated = recording.metadata.get("tool")
    if not isinstance(stated, Mapping) or "shape" not in stated:
        return ""
    measured = stated.get("radius_mm")
    tool, other = str(stated["shape"]), stated["shape"] != shape
    if isinstance(measured, (int, float)):
        tool += f" of {measured:g} mm radius"
        other |= radius is not None and not isclose(measured, radius * 1e3, rel_tol=_RADIUS_TOLERANCE)
    return tool if other else ""


def get_recorded_kind_if_different_or_empty(recording: Recording, kind: str) -> str:
    """Return the kind of test in the metadata if it differs from the expected kind; else an empty text."""
    stated = recording.metadata.get("kind", kind)
    return "" if stated == kind else str(stated)


def add_time_or_motion_from_speed(recording: Recording, speed: float, path: Path) -> Recording:
    """Return a recording of a test at constant speed with the missing time, s, or displacement, m, added.

    Args:
        recording: recording without time or without displacement; a recording with both is returned without a change.
        speed: speed of the test, m/s.
        path: file name for messages.

    Raises:
        InputError: not a positive speed; neither time nor displacement.
    """
    if isinstance(speed, bool) or not isinstance(speed, Real) or not 0 < speed <= sys.float_info.max:
        raise InputError(f"must be a positive number in m/s; got {speed!r}", field="speed")
    if "displacement" in recording:
        if "time" in recording:
            return recording
        path_length = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(recording.displacement)))])
        return recording.with_channels(time=path_length / speed)
    if "time" in recording and "force" in recording:
        return recording.with_channels(displacement=speed * (recording.time - recording.time[0]))
    raise InputError("requires a displacement, from which it gives the time, or time and force, from which it gives "
                     f"the displacement; this file has {', '.join(recording.channels)}", file=path, field="speed")
