"""From a curve of afmformats to a recording: sign, zero, segments, metadata."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.files import first_bytes
from tissue_sim.recording.recording import MIN_POINTS, Recording

#: Number of afmformats' segment -> ours, by the kind of measurement. A relaxation begins with a rest above the tissue.
SEGMENTS = {
    "force-distance": ("approach", "retract"),
    "creep-compliance": ("approach", "hold", "retract"),
    "stress-relaxation": ("approach", "approach", "hold", "retract"),
}
#: Name in afmformats -> name and factor in our metadata.
_NUMBERS = {
    "spring constant": ("spring_constant_N_per_m", 1.0), "sensitivity": ("sensitivity_m_per_V", 1.0),
    "setpoint": ("setpoint_N", 1.0), "speed approach": ("approach_speed_mm_s", 1e3),
    "speed retract": ("retract_speed_mm_s", 1e3), "position x": ("position_x_mm", 1e3),
    "position y": ("position_y_mm", 1e3),
}
_WORDS = {"imaging mode": "measurement", "format": "file_format", "instrument": "instrument", "software": "software",
          "software version": "software_version", "date": "date", "time": "clock"}
#: afmformats 0.18 leaves these two of a Chiaro in uN and um/s.
_MICRO_IN_CHIARO = ("setpoint", "speed approach", "speed retract")
#: Share of the approach that is taken to be in air.
BASELINE_SHARE = 0.1


def curve_recording(curve: Any, number: int, stated: Mapping[str, float] | None = None,
                    tip_radius: float | None = None) -> Recording:
    """The recording of one curve of afmformats.

    Args:
        curve: an ``afmformats.AFMData``.
        number: of the curve in its file, from 1.
        stated: spring constant (N/m) and sensitivity (m/V) by their names in afmformats, where the file lacks them.
        tip_radius: m, of a spherical tip, where the file says it.

    Raises:
        InputError: no height or force, too few samples, a value that is not finite, or a stated number that
            contradicts the file's.
    """
    metadata = _metadata(curve, number, stated or {}, tip_radius)
    force = _column(curve, "force")
    height, what = _height(curve, force, metadata.get("spring_constant_N_per_m"))
    segments = _segments(curve, height)
    zero, contact = _contact(force, segments == "approach")
    channels = {"displacement": height[contact] - height, "force": force - zero}
    if "time" in curve:
        channels = {"time": _column(curve, "time"), **channels}
    metadata |= {"displacement": what, "zeroing": {
        "force_N": float(zero), "height_m": float(height[contact]), "contact_sample": int(contact),
        "rule": "deviation from baseline: force within twice the largest deviation in the first tenth of the approach"}}
    return Recording(channels, {"segment": segments}, metadata)


def tip_radius(path: Path) -> float | None:
    """Radius of the sphere, m, that a text file of a Chiaro states and afmformats leaves out; None elsewhere."""
    if path.suffix != ".txt":
        return None
    for line in first_bytes(path, 16_384).decode("latin-1").splitlines()[:60]:
        name, _, value = line.partition("\t")
        if name.strip() == "Tip radius (um)":
            try:
                return float(value) * 1e-6
            except ValueError:
                return None
    return None


def _column(curve: Any, name: str) -> np.ndarray:
    if name not in curve:
        raise InputError(f"has no {name}; it has {', '.join(curve.columns)}")
    values = np.asarray(curve[name], float)
    if values.size < MIN_POINTS:
        raise InputError(f"has {values.size} samples, expected at least {MIN_POINTS}")
    bad = np.flatnonzero(~np.isfinite(values))
    if bad.size:
        raise InputError(f"{name} of sample {bad[0] + 1} is {values[bad[0]]}, expected a finite number")
    return values


def _height(curve: Any, force: np.ndarray, spring_constant: float | None) -> tuple[np.ndarray, str]:
    """Height of the tip (of the piezo without a spring constant) above some level, m, and which of the two it is."""
    if "tip position" in curve:
        return _column(curve, "tip position"), "tip"
    height = _column(curve, next((name for name in ("height (measured)", "height (piezo)") if name in curve),
                                 "height (measured)"))
    if spring_constant is None:
        return height, "piezo: the file has no spring constant, so the deflection of the cantilever is in it"
    return height + force / spring_constant, "tip"


def _segments(curve: Any, height: np.ndarray) -> np.ndarray:
    """Name of each sample's segment."""
    numbers, names = np.asarray(curve["segment"], int), SEGMENTS[curve.modality]
    if numbers.max() == numbers.min():
        # Igor files carry no segments: the tip turns at its deepest point.
        numbers = (np.arange(numbers.size) > np.argmin(height)).astype(int)
        names = ("approach", "retract")
    if numbers.max() >= len(names):
        raise InputError(f"has {numbers.max() + 1} segments, expected {len(names)} of a {curve.modality} curve")
    return np.array(names)[numbers]


def _contact(force: np.ndarray, approach: np.ndarray) -> tuple[float, int]:
    """Force in air, N, and the sample of contact."""
    samples = np.flatnonzero(approach)
    if not samples.size:
        raise InputError("has no approach, from which the contact would be known")
    baseline = force[samples[:max(MIN_POINTS, round(BASELINE_SHARE * samples.size))]]
    zero = baseline.mean()
    inside = force[samples] - zero <= 2.0 * abs(baseline - zero).max()
    return zero, samples[np.flatnonzero(inside)[-1]]


def _metadata(curve: Any, number: int, stated: Mapping[str, float], tip_radius: float | None) -> dict[str, Any]:
    found: dict[str, Any] = {"format": "afm", "curve": number}
    known = dict(curve.metadata.items())
    for key, value in stated.items():
        if known.setdefault(key, value) != value:
            raise InputError(f"the file's own {key} is {known[key]:g}, not {value:g}; leave it out")
    chiaro = "Chiaro" in str(known.get("format", ""))
    for key, (name, factor) in _NUMBERS.items():
        if key in known:
            value = float(known[key]) * factor * (1e-6 if chiaro and key in _MICRO_IN_CHIARO else 1.0)
            # Without the dust of the change of unit: 20 um/s must not become 0.019999999999999997 mm/s.
            found[name] = float(f"{value:.12g}")
    found |= {name: str(known[key]).strip() for key, name in _WORDS.items() if key in known}
    if tip_radius is not None:
        found |= {"tool": "sphere", "tool_radius_mm": float(f"{tip_radius * 1e3:.12g}")}
    return found
