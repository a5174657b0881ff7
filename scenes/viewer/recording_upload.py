"""Reading of uploaded recordings: files of tissue_sim, and files of test machines whose columns are recognised."""

from __future__ import annotations

import hashlib
import re
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath
from typing import Any

from scenes.viewer.measurement import Measurement, build_measurement_from_replicates
from scenes.viewer.shell import LARGEST_UPLOAD
from tissue_sim.bounded import run_in_sandbox
from tissue_sim.decode import read_json_value
from tissue_sim.errors import InputError
from tissue_sim.files import read_bytes
from tissue_sim.recording.file import read_recording, write_recording
from tissue_sim.recording.formats.guesses import ColumnGuess, TableGroup
from tissue_sim.recording.recording import Recording

#: First line of a recording file of tissue_sim.
_OWN = re.compile(rb"^[^\n]*\b(displacement|force) \[")


@dataclass(frozen=True, eq=False)
class UploadedRecordingOrSidecar:
    """Uploaded recording, or uploaded sidecar of a recording.

    Attributes:
        name: File name without unsafe characters.
        content: Content of the file in the format of tissue_sim.
        measured: The recording; None for a sidecar.
        sidecar: Metadata of the sidecar; None for a recording.
        understood: Sentences about the interpretation of a test-machine file.
        origin: Name and SHA-256 of the test-machine file from which the recording was converted; otherwise None.
    """

    name: str
    content: bytes
    measured: Measurement | None = None
    sidecar: Mapping[str, Any] | None = None
    understood: tuple[str, ...] = ()
    origin: Mapping[str, str] | None = None

    @property
    def file_stem(self) -> str:
        """File name without suffix, which a recording and its sidecar share."""
        return Path(self.name).stem


def read_uploaded_recordings_or_sidecar(name: str, content: bytes) -> tuple[UploadedRecordingOrSidecar, ...]:
    """Read an uploaded file; any thread may call this function.

    Args:
        name: Name of the file on the user's computer: ``NAME.csv``, its sidecar ``NAME.json``, or a file of a test
            machine, which may contain several recordings.
        content: Content of the file.

    Returns:
        The recordings of the file, or its sidecar.

    Raises:
        InputError: The file is too large, cannot be read, or contains no force over a displacement.
    """
    name = re.sub(r"[^\w .()+-]", "_", PureWindowsPath(name).name).strip(" .")[-100:] or "unnamed"
    if len(content) > LARGEST_UPLOAD:
        raise InputError(f"must be at most {LARGEST_UPLOAD / 1e6:g} MB; got {len(content) / 1e6:.1f} MB. Upload a "
                         "shorter recording.", file=name)
    with tempfile.TemporaryDirectory(prefix="tissue_sim_") as folder:
        path = Path(folder) / name
        path.write_bytes(content)
        try:
            match path.suffix.lower():
                case ".json":
                    return (_make_sidecar_upload(path, content),)
                case ".csv" if _OWN.match(content[:1000]):
                    recording = read_recording(path).with_metadata(source=name)
                    return (UploadedRecordingOrSidecar(name, content, build_measurement_from_replicates([recording])),)
                case _:
                    return _convert_machine_file_to_uploads(path,
                                                            {"file": name,
                                                             "sha256": hashlib.sha256(content).hexdigest()})
        except InputError as error:
            raise InputError(error.problem, file=name, line=error.line, field=error.field) from None


def _make_sidecar_upload(path: Path, content: bytes) -> UploadedRecordingOrSidecar:
    """Return the upload of a sidecar; raise an `InputError` unless the file contains a JSON object."""
    metadata = read_json_value(path, "the sidecar of a recording (JSON)")
    if not isinstance(metadata, dict):
        raise InputError("must be a JSON object {...} with the metadata of a recording. Upload the file that was "
                         "written next to the recording.")
    return UploadedRecordingOrSidecar(path.name, content, sidecar=metadata)


def _convert_machine_file_to_uploads(path: Path, origin: Mapping[str, str]) -> tuple[UploadedRecordingOrSidecar, ...]:
    """Convert the recordings of a test-machine file to the format of tissue_sim; number them if there are several."""
    # Imported here so that the page starts without the file parsers.
    from tissue_sim.recording.formats.understanding import interpret_file

    found = run_in_sandbox(interpret_file, path, file=path)
    recordings = [(reading, recording) for reading in found.readings
                  for recording in _require_channels_and_get_recordings(reading)]
    uploads = []
    for number, (reading, recording) in enumerate(recordings, start=1):
        stem = path.stem if len(recordings) == 1 else f"{path.stem}_{number}"
        own = path.with_name(f"{stem}.csv") if path.suffix != ".csv" else path.with_name(f"{stem}.own.csv")
        kept = Recording({name: recording.channel(name) for name in ("time", "displacement", "force")
                          if name in recording}, {}, {"name": stem})
        write_recording(kept, own)
        uploads.append(UploadedRecordingOrSidecar(f"{stem}.csv", read_bytes(own, "a recording"),
                                                  build_measurement_from_replicates(
                                                      [kept.with_metadata(source=path.name)]),
                                                  understood=(_describe_column_channels(reading, found.format),
                                                              *reading.remarks, *found.warnings),
                                                  origin=origin))
    return tuple(uploads)


def _require_channels_and_get_recordings(reading: TableGroup) -> tuple[Recording, ...]:
    """Return all recordings of a reading that has displacement, force and their units.

    Raises:
        InputError: Displacement, force or a unit is missing.
    """
    channels = {column.channel for column in reading.columns}
    if not {"displacement", "force"} <= channels:
        raise InputError(f"must contain displacement and force; got {' and '.join(sorted(channels - {'time'}))}. Use "
                         "tissue-sim calibrate for other quantities.")
    if reading.missing_information_texts:
        raise InputError(
            f"does not state {', '.join(reading.missing_information_texts)}. Write the unit into the header, as "
            "in 'Load (N)', or use tissue-sim import.")
    return reading.recordings


def _describe_column_channels(reading: TableGroup, machine: str) -> str:
    """Return a sentence that states which column was read as which channel."""
    columns = ", ".join(f"{column.channel} from {_describe_column_header_unit_and_sign(column)}"
                        for column in reading.columns)
    return f"{columns}{'' if machine == 'table' else f' (a file of {machine})'}"


def _describe_column_header_unit_and_sign(column: ColumnGuess) -> str:
    """Return header (or number), unit and a changed sign of a column as text."""
    sign = ", its sign changed" if column.sign < 0 else ""
    return f"{repr(column.header) if column.header else f'column {column.place}'} in {column.unit}{sign}"
