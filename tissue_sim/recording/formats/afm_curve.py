"""Convert a force curve of afmformats to a recording: sign, zero, segments, metadata."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.files import read_first_bytes_or_empty
from tissue_sim.recording.recording import MIN_POINTS, Recording

#: Modality of afmformats -> names of its segments in order. A relaxation begins with a rest above the tissue.
SEGMENTS_OF_MODALITY = {
    "force-distance": ("approach", "retract"),
    "creep-compliance": ("approach", "hold", "retract"),
    "stress-relaxation": ("approach", "approach", "hold", "retract"),
}
#: Number in the metadata of afmformats -> name and factor in the metadata of the recording.
_NUMBERS = {
    "spring constant": ("spring_constant_N_per_m", 1.0), "sensitivity": ("sensitivity_m_per_V", 1.0),
    "setpoint": ("setpoint_N", 1.0), "speed approach": ("approach_speed_mm_s", 1e3),
    "speed retract": ("retract_speed_mm_s", 1e3), "position x": ("position_x_mm", 1e3),
    "position y": ("position_y_mm", 1e3),
}
#: Text in the metadata of afmformats -> name in the metadata of the recording.
_WORDS = {"imaging mode": "measurement", "format": "file_format", "instrument": "instrument", "software": "software",
          "software version": "software_version", "date": "date", "time": "clock"}
#: Numbers of a Chiaro file that afmformats 0.18 returns in uN and um/s instead of SI units.
_MICRO_IN_CHIARO = ("setpoint", "speed approach", "speed retract")
#: Fraction of the approach that is assumed to be in air.
BASELINE_FRACTION = 0.1


def build_curve_recording(curve: Any, number: int, overrides: Mapping[str, float] | None = None,
                          tip_radius: float | None = None) -> Recording:
    """Return the recording of one curve of afmformats.

    Args:
        curve: an ``afmformats.AFMData``.
        number: number of the curve in its file, from 1.
        overrides: name in afmformats -> spring constant (N/m) or sensitivity (m/V), for a file without the value.
        tip_radius: radius of a spherical tip, m; None: unknown.

    Raises:
        InputError: no height or force, too few samples, a value that is not finite, or a stated number that
            contradicts the file's.
    """
    metadata = _build_curve_metadata(curve, number, overrides or {}, tip_radius)
    force = _read_curve_column(curve, "force")
    height, what = _get_height_and_description_of_source(curve, force, metadata.get("spring_constant_N_per_m"))
    segments = _make_segment_name_per_sample(curve, height)
    zero, contact = _find_force_in_air_and_contact_index(force, segments == "approach")
    channels = {"displacement": height[contact] - height, "force": force - zero}
    if "time" in curve:
        channels = {"time": _read_curve_column(curve, "time"), **channels}
    metadata |= {"displacement": what, "zeroing": {
        "force_N": float(zero), "height_m": float(height[contact]), "contact_sample": int(contact),
        "rule": "deviation from baseline: force within twice the largest deviation in the first tenth of the approach"}}
    return Recording(channels, {"segment": segments}, metadata)


def read_chiaro_tip_radius_or_none(path: Path) -> float | None:
    """Return the radius of the sphere, m, in a text file of a Chiaro, which afmformats omits; None: not stated."""
    if path.suffix != ".txt":
        return None
    for line in read_first_bytes_or_empty(path, 16_384).decode("latin-1").splitlines()[:60]:
        name, _, value = line.partition("\t")
        if name.strip() == "Tip radius (um)":
            try:
                return float(value) * 1e-6
            except ValueError:
                return None
    return None


def _read_curve_column(curve: Any, name: str) -> np.ndarray:
    """Return a column of a curve, SI units, shape (n,).

    Raises:
        InputError: no such column, too few samples, or a value that is not finite.
    """
    if name not in curve:
        raise InputError(f"has no {name}; it has {', '.join(curve.columns)}")
    values = np.asarray(curve[name], float)
    if values.size < MIN_POINTS:
        raise InputError(f"has {values.size} samples, expected at least {MIN_POINTS}")
    bad = np.flatnonzero(~np.isfinite(values))
    if bad.size:
        raise InputError(f"{name} of sample {bad[0] + 1} is {values[bad[0]]}, expected a finite number")
    return values


def _get_height_and_description_of_source(curve: Any, force: np.ndarray,
                                          spring_constant: float | None) -> tuple[np.ndarray, str]:
    """Return the height above an arbitrary level, m, shape (n,), and its source in words.

    The height is that of the tip or, without a spring constant, that of the piezo.
    """
    if "tip position" in curve:
        return _read_curve_column(curve, "tip position"), "tip"
    height = _read_curve_column(curve, next((name for name in ("height (measured)", "height (piezo)") if name in curve),
                                            "height (measured)"))
    if spring_constant is None:
        return height, "piezo: the file has no spring constant, so the deflection of the cantilever is in it"
    return height + force / spring_constant, "tip"


def _make_segment_name_per_sample(curve: Any, height: np.ndarray) -> np.ndarray:
    """Return the name of the segment of each sample, shape (n,)."""
    numbers, names = np.asarray(curve["segment"], int), SEGMENTS_OF_MODALITY[curve.modality]
    if numbers.max() == numbers.min():
        # Igor files have no segments: the motion reverses at the lowest height.
        numbers = (np.arange(numbers.size) > np.argmin(height)).astype(int)
        names = ("approach", "retract")
    if numbers.max() >= len(names):
        raise InputError(f"has {numbers.max() + 1} segments, expected {len(names)} of a {curve.modality} curve")
    return np.array(names)[numbers]


def _find_force_in_air_and_contact_index(force: np.ndarray, approach: np.ndarray) -> tuple[float, int]:
    """Return the force in air, N, and the index of the sample at contact."""
    samples = np.flatnonzero(approach)
    if not samples.size:
        raise InputError("has no approach segment, which is required to find the contact; export this segment too")
    baseline = force[samples[:max(MIN_POINTS, round(BASELINE_FRACTION * samples.size))]]
    zero = baseline.mean()
    inside = force[samples] - zero <= 2.0 * abs(baseline - zero).max()
    return zero, samples[np.flatnonzero(inside)[-1]]


def _build_curve_metadata(curve: Any, number: int, overrides: Mapping[str, float], tip_radius: float | None
                          ) -> dict[str, Any]:
    """Return the metadata of a recording; see `build_curve_recording`."""
    found: dict[str, Any] = {"format": "afm", "curve": number}
    known = dict(curve.metadata.items())
    for key, value in overrides.items():
        if known.setdefault(key, value) != value:
            raise InputError(f"{key} must be {known[key]:g} as in the file; got {value:g}. Omit the {key}.")
    chiaro = "Chiaro" in str(known.get("format", ""))
    for key, (name, factor) in _NUMBERS.items():
        if key in known:
            value = float(known[key]) * factor * (1e-6 if chiaro and key in _MICRO_IN_CHIARO else 1.0)
            # Rounded, because 20 um/s must not become 0.019999999999999997 mm/s.
            found[name] = float(f"{value:.12g}")
    found |= {name: str(known[key]).strip() for key, name in _WORDS.items() if key in known}
    if tip_radius is not None:
        found |= {"tool": "sphere", "tool_radius_mm": float(f"{tip_radius * 1e3:.12g}")}
    return found
