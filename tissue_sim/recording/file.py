"""Read and write recordings: a CSV file with the columns, and a JSON sidecar with the metadata."""

from __future__ import annotations

import csv
import hashlib
import inspect
import io
import json
from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tissue_sim.bounded import run_in_sandbox
from tissue_sim.decode import convert_to_json_types, read_json_value, require_valid_json_values
from tissue_sim.errors import InputError, located_and_converted_errors
from tissue_sim.experiment.kinds.kind import KINDS, has_modulus_channels
from tissue_sim.files import open_input_file, write_bytes, write_text
from tissue_sim.recording.formats import FORMATS
from tissue_sim.recording.recording import CHANNELS, LABELS, LOADS, MOTIONS, Recording, add_time_or_motion_from_speed
from tissue_sim.units import get_si_factor_and_offset

#: Quantity -> unit in the CSV file.
_FILE_UNITS = {"time": "s", "length": "mm", "force": "N", "torque": "Nm", "stress": "Pa", "ratio": "-",
               "angle": "deg", "temperature": "degC", "frequency": "Hz"}


def read_recording(path: str | Path, *, format: str = "native", columns: Mapping[str, Any] | None = None,
                   skip_lines: int = 0, delimiter: str | None = None, speed: float | None = None,
                   kind: str | None = None, **options) -> Recording:
    """Read the only recording of a file; the values of the recording are in SI.

    Args:
        path: the file. ``NAME.json`` in the folder of ``NAME.csv`` is merged into the metadata.
        format: name in `tissue_sim.recording.formats.FORMATS`.
        columns: channel -> column, for any other CSV and for spreadsheets; see
            `tissue_sim.recording.formats.columns.read_single_recording`.
        skip_lines: number of lines at the top that are ignored; with `columns` only.
        delimiter: one character between the cells; with `columns` only. None: found.
        speed: constant speed, m/s; makes the time from the displacement where the file has no time, and the
            displacement from the time where it has force and no motion.
        kind: kind of test, such as ``"lubricated_compression"``: refuse a recording without the channels it needs.
        options: arguments of certain formats: ``sheet`` of a spreadsheet; ``curve``, ``spring_constant`` and
            ``sensitivity`` of an AFM file.

    Returns:
        The recording; its metadata always has ``name``, ``source`` and ``sha256``.

    Raises:
        InputError: the file is invalid (with the line if it is known), or contains several recordings.
    """
    found = read_recordings(path, format=format, columns=columns, skip_lines=skip_lines, delimiter=delimiter,
                            speed=speed, kind=kind, **options)
    if len(found) > 1:
        raise InputError(f"holds {len(found)} curves; choose one with curve = 1 to {len(found)}", file=path,
                         field="curve")
    return found[0]


def read_recordings(path: str | Path, *, format: str = "native", columns: Mapping[str, Any] | None = None,
                    skip_lines: int = 0, delimiter: str | None = None, speed: float | None = None,
                    kind: str | None = None, **options) -> tuple[Recording, ...]:
    """Read all recordings of one file, such as the curves of an AFM file; see `read_recording` for the arguments.

    Several recordings are named after the file and their numbers: ``cells_3``.
    """
    path = Path(path)
    reader = FORMATS.find(format, "format")
    if kind is not None:
        KINDS.find(kind, "kind")
    parameters = inspect.signature(reader).parameters
    if columns is not None and "columns" not in parameters:
        raise InputError(f"give either format = {format!r} or columns, not both", field="columns")
    for key, value in (("skip_lines", skip_lines), ("delimiter", delimiter)):
        if value and columns is None:
            raise InputError(f"{key} requires columns; give columns too", field=key)
    if columns is not None:
        options |= {"columns": columns} | ({"skip_lines": skip_lines} if skip_lines else {}) | (
            {"delimiter": delimiter} if delimiter is not None else {})
    for key in options:
        if key not in parameters:
            raise InputError(f"files of format {format!r} have no {key}; leave it out", field=key)
    with open_input_file(path, "a recording"):  # refuses a folder, a pipe or a device before the reader starts
        pass
    answer = run_in_sandbox(partial(reader, path, **options), file=path)
    several = answer if isinstance(answer, tuple) else (answer,)
    recordings = tuple(_add_time_and_metadata(each, path, speed, kind) for each in several)
    if len(recordings) == 1:
        return recordings
    return tuple(each.with_metadata(name=f"{path.stem}_{number}") for number, each in enumerate(recordings, start=1))


def _add_time_and_metadata(recording: Recording, path: Path, speed: float | None, kind: str | None) -> Recording:
    """Return a recording with time or displacement from the speed, and with the metadata of file and sidecar.

    Raises:
        InputError: the kind of test requires other channels.
    """
    strained = not {"stretch", "shear strain"}.isdisjoint(recording.channels)
    if speed is not None and not (strained and "time" in recording):
        recording = add_time_or_motion_from_speed(recording, speed, path)
    _require_channels_of_kind(recording, kind, path)
    with open_input_file(path, "a recording") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    metadata = {"name": path.stem, **_read_sidecar(path, digest), "source": str(path), "sha256": digest}
    return recording.with_metadata(**metadata)


def write_recording(recording: Recording, path: str | Path) -> None:
    """Write ``NAME.csv`` with every digit, and ``NAME.json`` with the metadata and the SHA-256 of the CSV.

    Metadata ``source`` is omitted, because it is the path of another file.

    Raises:
        InputError: a name that does not end in ``.csv``, a label or metadata that a file cannot hold, a ``NAME.json``
            that is not the sidecar of a recording, or a path that cannot be written; then no file is written.

    Examples:
        >>> displacement = [0.0, 1e-3, 2e-3, 3e-3, 4e-3]  # m
        >>> force = [0.0, 0.5, 1.1, 1.7, 2.4]  # N
        >>> write_recording(Recording({"displacement": displacement, "force": force}), "plates.csv")
        >>> read_recording("plates.csv").force
        array([0. , 0.5, 1.1, 1.7, 2.4])
    """
    path = Path(path)
    if path.suffix.lower() != ".csv":
        raise InputError(f"the name of a recording must end in .csv; got {path.suffix!r}", file=path)
    require_overwritable_sidecar(path)
    data = _format_csv(recording, path).encode("utf-8")
    metadata = {key: value for key, value in recording.metadata.items() if key != "source"}
    metadata["sha256"] = hashlib.sha256(data).hexdigest()
    try:
        metadata = convert_to_json_types(metadata)
    except TypeError as error:
        raise InputError(f"the metadata cannot be written as JSON ({error}); keep text, finite numbers, lists and maps",
                         file=path, field="metadata") from error
    with located_and_converted_errors(file=path):
        require_valid_json_values(metadata, "metadata")
    # A crash between the two leaves a sidecar whose SHA-256 does not match, which the reader reports.
    write_bytes(path, data)
    write_text(path.with_suffix(".json"), json.dumps(metadata, indent=2, ensure_ascii=False) + "\n")


def require_overwritable_sidecar(path: Path) -> None:
    """Refuse to overwrite a ``NAME.json`` that is not the sidecar of a recording, that is, without ``sha256``.

    Raises:
        InputError: such a file exists.
    """
    sidecar = path.with_suffix(".json")
    if not sidecar.exists():
        return
    try:
        found = read_json_value(sidecar, "the sidecar of a recording")
    except InputError:
        found = None
    if not isinstance(found, dict) or "sha256" not in found:
        raise InputError(f"is not the sidecar of a recording (it has no sha256), and {path.name} would replace it with "
                         "the sidecar of the recording; move the file or choose another name", file=sidecar)


def _format_csv(recording: Recording, path: Path) -> str:
    """Return the text of the CSV file, with units of `_FILE_UNITS` and all digits."""
    header: list[str] = []
    cells: list[Iterable[str]] = []
    for name in (name for name in CHANNELS if name in recording):
        unit = _FILE_UNITS[CHANNELS[name]]
        factor, offset = get_si_factor_and_offset(unit)
        values = (recording.channel(name) - offset) / factor
        if not np.isfinite(values).all():
            raise InputError(f"must be finite in {unit}, the unit of this channel in the file; got a value that is too "
                             "large. Check the scale of the channel", file=path, field=name)
        header.append(f"{name} [{unit}]")
        cells.append(map(repr, values.tolist()))
    for name in (name for name in LABELS if name in recording.labels):
        labels = [str(label) for label in recording.labels[name].tolist()]
        for label in labels:
            if not label.isprintable() or label != label.strip():
                raise InputError(f"label {label!r} has line breaks, control characters or blanks at its ends; expected "
                                 "plain words", file=path, field=name)
        header.append(name)
        cells.append(labels)
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(zip(*cells, strict=True))
    return stream.getvalue()


def _read_sidecar(path: Path, digest: str) -> dict[str, Any]:
    """Return the metadata in the sidecar of a CSV file; empty if the file has no sidecar.

    Args:
        path: CSV file.
        digest: SHA-256 of the CSV file, which the sidecar must state.
    """
    sidecar = path.with_suffix(".json")
    if path.suffix.lower() != ".csv" or not sidecar.exists():
        return {}
    metadata = read_json_value(sidecar, f"the sidecar of {path.name} (JSON)")
    if not isinstance(metadata, dict):
        raise InputError(f"expected an object {{...}} with the metadata of {path.name}; correct or rename this file",
                         file=sidecar)
    if metadata.get("sha256", digest) != digest:
        raise InputError(f"{path.name} was changed after it was recorded, expected the SHA-256 given here; restore "
                         "it, or delete this key to accept the change", file=sidecar, field="sha256")
    return metadata


def _require_channels_of_kind(recording: Recording, kind: str | None, path: Path) -> None:
    """Require the channels of the kind of test; if the kind is None, a motion and a load, or those of moduli.

    Raises:
        InputError: a channel is missing.
    """
    has = ", ".join(recording.channels)
    if kind is not None:
        KINDS.find(kind, "kind").require_channels(recording.channels, f"this file has {has}", file=path)
        return
    if has_modulus_channels(recording.channels):
        return
    for words, names in (("a motion", tuple(MOTIONS)), ("a load", LOADS)):
        if not any(name in recording for name in names):
            raise InputError(f"the column with {words} is missing, expected {', '.join(names[:-1])} or {names[-1]}; "
                             f"this file has {has}", file=path)
