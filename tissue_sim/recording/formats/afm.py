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
from tissue_sim.files import read_bytes
from tissue_sim.recording.formats.afm_curve import build_curve_recording, read_chiaro_tip_radius_or_none
from tissue_sim.recording.formats.extra import import_optional_package
from tissue_sim.recording.recording import Recording

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
