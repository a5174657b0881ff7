"""Force curves of atomic force microscopes and nanoindenters, through the package afmformats (extra ``formats``).

Displacement is that of the tip: height of the piezo plus deflection F / k of the cantilever, turned to point into the
tissue. Where the file has no spring constant k it is that of the piezo, and the metadata say so.
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
from tissue_sim.recording.formats.afm_curve import curve_recording, tip_radius
from tissue_sim.recording.formats.extra import require
from tissue_sim.recording.recording import Recording

EXPECTED = "force curves of an AFM"


def read_afm(path: str | Path, *, curve: int | None = None, spring_constant: float | None = None,
             sensitivity: float | None = None) -> tuple[Recording, ...]:
    """The force curves of a file, or of a zip of files, that afmformats reads.

    The force is tared by the first tenth of the approach, and the displacement counts from the contact: the last sample
    of the approach whose force is within twice the largest deviation of that tenth (deviation from baseline). The
    metadata hold both shifts under ``zeroing``, so that the raw values can be had back.

    Args:
        path: such as a ``.jpk-force``, ``.jpk-force-map``, ``.ibw``, ``.h5``, ``.tab``, Chiaro ``.txt``, or a ``.zip``.
        curve: number from 1 of the only one wanted, in a zip in the order of the names. None: all.
        spring_constant, sensitivity: N/m and m/V, for files that lack them: NT-MDT text files need both.

    Returns:
        Each curve as a recording: displacement (m), force (N), time (s) where the file has it; segments approach, hold,
        retract.

    Raises:
        InputError: no such file or curve, a file that afmformats does not read, or the extra ``formats`` is not
            installed.
    """
    path = Path(path)
    for name, value in (("spring_constant", spring_constant), ("sensitivity", sensitivity)):
        if value is not None and not (np.isfinite(value) and value > 0):
            raise InputError(f"{value!r} is not positive; give a number above zero", file=path, field=name)
    if curve is not None and (isinstance(curve, bool) or not isinstance(curve, int) or curve < 1):
        raise InputError(f"{curve!r} is not the number of a curve; give a whole number from 1", file=path,
                         field="curve")
    read_bytes(path, EXPECTED)
    afmformats = require("afmformats", path)
    stated = {key: value for key, value in (("spring constant", spring_constant), ("sensitivity", sensitivity))
              if value is not None}
    recordings = []
    with _members(path, afmformats.supported_extensions) as members:
        counted = 0
        for member in members:
            curves = _load(afmformats, member, path, stated)
            for each in curves:
                counted += 1
                if curve in (None, counted):
                    with _refusals(path, f"curve {counted}"):
                        recording = curve_recording(each, counted, stated, tip_radius(member))
                    recordings.append(recording if member == path else recording.with_metadata(member=member.name))
            if curve is not None and counted >= curve:
                break
    if not recordings:
        raise InputError(f"there is no curve {curve}; the file has {counted}" if counted else "holds no force curve",
                         file=path, field="curve" if counted else None)
    return tuple(recordings)


@contextmanager
def _members(path: Path, suffixes: list[str]) -> Iterator[list[Path]]:
    """The files of curves: the file itself or, unpacked for the time of the work, those in a zip."""
    if path.suffix.lower() != ".zip":
        yield [path]
        return
    try:
        archive = zipfile.ZipFile(path)
    except (zipfile.BadZipFile, OSError) as error:
        raise InputError(f"cannot be unpacked ({error}), expected a zip of {EXPECTED}", file=path) from None
    with archive, tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        names = sorted(name for name in archive.namelist()
                       if PurePosixPath(name).suffix in suffixes and not PurePosixPath(name).name.startswith("."))
        if not names:
            raise InputError(f"has no file that ends in {', '.join(suffixes)}, expected a zip of {EXPECTED}",
                             file=path)
        if all(name.endswith(".csv") for name in names):
            # A map of AFM Workshop curves: afmformats reads their grid from the archive.
            yield [path]
            return
        members = []
        for number, name in enumerate(names):
            # Names in an archive may lead anywhere; only their last part is used.
            member = Path(folder, str(number), PurePosixPath(name).name)
            member.parent.mkdir()
            with _refusals(path, name):
                member.write_bytes(archive.read(name))
            members.append(member)
        yield members


def _load(afmformats: Any, member: Path, path: Path, stated: Mapping[str, float]) -> list[Any]:
    where = "" if member == path else member.name
    if member.suffix not in afmformats.supported_extensions:
        raise InputError(f"the name ends in {member.suffix!r}, expected {EXPECTED}, which ends in "
                         f"{', '.join(afmformats.supported_extensions)}", file=path)
    with _refusals(path, where):
        try:
            return afmformats.load_data(member)
        except afmformats.errors.MissingMetaDataError as error:
            if set(error.meta_keys) <= set(stated):
                return afmformats.load_data(member, meta_override=dict(stated))
            raise InputError("the file does not say how the detector's signal becomes a force; give spring_constant "
                             "(N/m) and sensitivity (m/V)") from None


@contextmanager
def _refusals(path: Path, where: str) -> Iterator[None]:
    """Whatever afmformats raises, as one sentence; its warnings and its log of tracebacks are kept from the screen."""
    logger = logging.getLogger("afmformats")
    level = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except InputError as error:
        raise error.located(file=path, part=where) from None
    except (KeyboardInterrupt, SystemExit, GeneratorExit, MemoryError):
        raise
    except BaseException as error:  # afmformats derives its errors from BaseException
        reason = " ".join(str(error).split()).rstrip(".!") or type(error).__name__
        raise InputError(f"cannot be read as {EXPECTED}: {reason}").located(file=path, part=where) from None
    finally:
        logger.setLevel(level)
