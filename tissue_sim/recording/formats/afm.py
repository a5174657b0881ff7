"""Read force curves of atomic force microscopes and nanoindenters with the package afmformats (extra ``formats``).

The displacement is the displacement of the tip: height of the piezo plus deflection F / k of the cantilever, positive
into the tissue. If the file has no spring constant k, the displacement is the height of the piezo, and the metadata
state this.
"""

from __future__ import annotations

import logging
import tempfile
import warnings
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.files import read_bytes, read_first_bytes_or_empty
from tissue_sim.recording.formats.sheets import import_optional_package
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


#: Expected content of the file, for messages.
_EXPECTED = "force curves of an AFM"


def read_afm(path: str | Path, *, curve: int | None = None, spring_constant: float | None = None,
             sensitivity: float | None = None) -> tuple[Recording, ...]:
    """Read the force curves of a file, or of the files in a zip.

    The baseline is the mean force of the first tenth of the approach; the baseline is subtracted from the force. The
    displacement is zero at contact: the last sample of the approach whose deviation from the baseline is at most twice
    the largest deviation within the first tenth. The metadata record both shifts under ``zeroing``; adding the shifts
    restores the raw values.

    Args:
        path: a ``.jpk-force``, ``.jpk-force-map``, ``.ibw``, ``.h5``, ``.tab``, Chiaro ``.txt`` file, or a ``.zip``.
        curve: number (from 1) of the only curve to read; files in a zip are sorted by name. None: all curves.
        spring_constant: spring constant of the cantilever, N/m, for a file without one, such as an NT-MDT text file.
        sensitivity: sensitivity of the detector, m/V, for a file without one, such as an NT-MDT text file.

    Returns:
        One recording for each curve: displacement (m), force (N), time (s) if the file has a time; segments approach,
        hold, retract.

    Raises:
        InputError: no such file or curve, a file that afmformats does not read, or the extra ``formats`` is not
            installed.
    """
    path = Path(path)
    for name, value in (("spring_constant", spring_constant), ("sensitivity", sensitivity)):
        if value is not None and not (np.isfinite(value) and value > 0):
            raise InputError(f"must be positive; got {value!r}. Give a finite number above zero.", file=path,
                             field=name)
    if curve is not None and (isinstance(curve, bool) or not isinstance(curve, int) or curve < 1):
        raise InputError(f"must be a whole number from 1; got {curve!r}. Give the number of a curve.", file=path,
                         field="curve")
    read_bytes(path, _EXPECTED)
    afmformats = import_optional_package("afmformats", path)
    overrides = {key: value for key, value in (("spring constant", spring_constant), ("sensitivity", sensitivity))
                 if value is not None}
    recordings = []
    with _extracted_curve_files(path, afmformats.supported_extensions) as members:
        number = 0
        for member in members:
            curves = _load_curves(afmformats, member, path, overrides)
            for each in curves:
                number += 1
                if curve in (None, number):
                    with _input_errors_without_warnings(path, f"curve {number}"):
                        recording = build_curve_recording(each, number, overrides,
                                                          read_chiaro_tip_radius_or_none(member))
                    recordings.append(recording if member == path else recording.with_metadata(member=member.name))
            if curve is not None and number >= curve:
                break
    if not recordings:
        raise InputError(f"must be from 1 to {number}, the number of curves in the file; got {curve}." if number
                         else "holds no force curve", file=path, field="curve" if number else None)
    return tuple(recordings)


@contextmanager
def _extracted_curve_files(path: Path, suffixes: list[str]) -> Iterator[list[Path]]:
    """Context manager: paths of the files with curves. The files of a zip are in a temporary folder until the end."""
    if path.suffix.lower() != ".zip":
        yield [path]
        return
    try:
        archive = zipfile.ZipFile(path)
    except (zipfile.BadZipFile, OSError) as error:
        raise InputError(f"cannot be unpacked ({error}), expected a zip of {_EXPECTED}", file=path) from None
    with archive, tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        names = sorted(name for name in archive.namelist()
                       if PurePosixPath(name).suffix in suffixes and not PurePosixPath(name).name.startswith("."))
        if not names:
            raise InputError(f"has no file that ends in {', '.join(suffixes)}, expected a zip of {_EXPECTED}",
                             file=path)
        if all(name.endswith(".csv") for name in names):
            # A map of AFM Workshop curves: afmformats reads the grid of the map from the archive.
            yield [path]
            return
        members = []
        for number, name in enumerate(names):
            # The path of a member may lead outside of the folder (path traversal): only the last part is used.
            member = Path(folder, str(number), PurePosixPath(name).name)
            member.parent.mkdir()
            with _input_errors_without_warnings(path, name):
                member.write_bytes(archive.read(name))
            members.append(member)
        yield members


def _load_curves(afmformats: Any, member: Path, path: Path, overrides: Mapping[str, float]) -> list[Any]:
    """Return the curves of one file, as objects of afmformats.

    Args:
        afmformats: the imported package.
        member: the file, or the unpacked file of the zip `path`.
        path: the file that the user named, for messages.
        overrides: metadata key of afmformats -> value for files without the key.
    """
    member_name = "" if member == path else member.name
    if member.suffix not in afmformats.supported_extensions:
        raise InputError(f"the name ends in {member.suffix!r}, expected {_EXPECTED}, which ends in "
                         f"{', '.join(afmformats.supported_extensions)}", file=path)
    with _input_errors_without_warnings(path, member_name):
        try:
            return afmformats.load_data(member)
        except afmformats.errors.MissingMetaDataError as error:
            if set(error.meta_keys) <= set(overrides):
                return afmformats.load_data(member, meta_override=dict(overrides))
            raise InputError("the conversion of the detector's signal to a force is missing in the file; give "
                             "spring_constant (N/m) and sensitivity (m/V)") from None


@contextmanager
def _input_errors_without_warnings(path: Path, member_name: str) -> Iterator[None]:
    """Context manager: raise errors of afmformats as `InputError`; suppress the warnings and log of afmformats."""
    logger = logging.getLogger("afmformats")
    level = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except InputError as error:
        raise error.with_location(file=path, part=member_name) from None
    except (KeyboardInterrupt, SystemExit, GeneratorExit, MemoryError):
        raise
    except BaseException as error:  # afmformats derives its errors from BaseException
        reason = " ".join(str(error).split()).rstrip(".!") or type(error).__name__
        raise InputError(f"cannot be read as {_EXPECTED}: {reason}").with_location(file=path,
                                                                                   part=member_name) from None
    finally:
        logger.setLevel(level)
