"""Files with recordings that were uploaded: our own, and those of test machines, which are understood from what they
hold."""

from __future__ import annotations

import hashlib
import re
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath
from typing import Any

from scenes.viewer.measurement import Measurement, measurement
from scenes.viewer.shell import LARGEST_UPLOAD
from tissue_sim.bounded import bounded
from tissue_sim.decode import read_json
from tissue_sim.errors import InputError
from tissue_sim.files import read_bytes
from tissue_sim.recording.file import read_recording, write_recording
from tissue_sim.recording.formats.guesses import ColumnGuess, Reading
from tissue_sim.recording.recording import Recording

#: In the first line of our own files.
_OWN = re.compile(rb"^[^\n]*\b(displacement|force) \[")


@dataclass(frozen=True, eq=False)
class Upload:
    """A recording that was uploaded, or the sidecar of one.

    Attributes:
        name: of the file, made safe. content: its bytes, as our own files have them.
        measured: the recording in it; None of a sidecar. sidecar: the metadata in it; None of a recording.
        understood: how a file of another program was read, sentences.
        origin: of such a recording the name of the file that was uploaded and its SHA-256, as a provenance has them.
    """

    name: str
    content: bytes
    measured: Measurement | None = None
    sidecar: Mapping[str, Any] | None = None
    understood: tuple[str, ...] = ()
    origin: Mapping[str, str] | None = None

    @property
    def stem(self) -> str:
        """What a recording and its sidecar share."""
        return Path(self.name).stem


def read_recording_upload(name: str, content: bytes) -> tuple[Upload, ...]:
    """What is in an uploaded file, in any thread.

    Args:
        name: of the file on the user's machine: ``NAME.csv``, ``NAME.json`` that belongs to it, or a file of a test
            machine, which may hold several recordings.
        content: its bytes.

    Raises:
        InputError: too large, or what `tissue_sim.read_recording`, the understanding of other files and `measurement`
            refuse.
    """
    name = re.sub(r"[^\w .()+-]", "_", PureWindowsPath(name).name).strip(" .")[-100:] or "unnamed"
    if len(content) > LARGEST_UPLOAD:
        raise InputError(f"has {len(content) / 1e6:.1f} MB, expected a recording of at most "
                         f"{LARGEST_UPLOAD / 1e6:g} MB", file=name)
    with tempfile.TemporaryDirectory(prefix="tissue_sim_") as folder:
        path = Path(folder) / name
        path.write_bytes(content)
        try:
            match path.suffix.lower():
                case ".json":
                    return (_sidecar(path, content),)
                case ".csv" if _OWN.match(content[:1000]):
                    return (Upload(name, content, measurement([read_recording(path).with_metadata(source=name)])),)
                case _:
                    return _of_a_machine(path, {"file": name, "sha256": hashlib.sha256(content).hexdigest()})
        except InputError as error:
            raise InputError(error.problem, file=name, line=error.line, field=error.field) from None


def _sidecar(path: Path, content: bytes) -> Upload:
    found = read_json(path, "the sidecar of a recording (JSON)")
    if not isinstance(found, dict):
        raise InputError("expected an object {...} with the metadata of a recording")
    return Upload(path.name, content, sidecar=found)


def _of_a_machine(path: Path, origin: Mapping[str, str]) -> tuple[Upload, ...]:
    """The recordings of any other file, in our own form; replicates are numbered."""
    # Only here: the page starts without it.
    from tissue_sim.recording.formats.understanding import understand

    found = bounded(understand, path, file=path)
    recordings = [(reading, recording) for reading in found.readings for recording in _complete(reading)]
    uploads = []
    for number, (reading, recording) in enumerate(recordings, start=1):
        stem = path.stem if len(recordings) == 1 else f"{path.stem}_{number}"
        own = path.with_name(f"{stem}.csv") if path.suffix != ".csv" else path.with_name(f"{stem}.own.csv")
        kept = Recording({name: recording.channel(name) for name in ("time", "displacement", "force")
                          if name in recording}, {}, {"name": stem})
        write_recording(kept, own)
        uploads.append(Upload(f"{stem}.csv", read_bytes(own, "a recording"),
                              measurement([kept.with_metadata(source=path.name)]),
                              understood=(_columns(reading, found.format), *reading.remarks, *found.warnings),
                              origin=origin))
    return tuple(uploads)


def _complete(reading: Reading) -> tuple[Recording, ...]:
    """Its recordings.

    Raises:
        InputError: they are none of a force over a displacement, or a unit is missing.
    """
    channels = {column.channel for column in reading.columns}
    if not {"displacement", "force"} <= channels:
        raise InputError(f"holds {' and '.join(sorted(channels - {'time'}))}, and a test of this page has displacement "
                         "and force; use tissue-sim calibrate")
    if reading.missing:
        raise InputError(f"does not say {', '.join(reading.missing)}; write it into the header, as in 'Load (N)', or "
                         "use tissue-sim import")
    return reading.recordings


def _columns(reading: Reading, machine: str) -> str:
    """Which column is what, in a sentence."""
    said = ", ".join(f"{column.channel} from {_place(column)}" for column in reading.columns)
    return f"{said}{'' if machine == 'table' else f' (a file of {machine})'}"


def _place(column: ColumnGuess) -> str:
    turned = ", its sign changed" if column.sign < 0 else ""
    return f"{repr(column.header) if column.header else f'column {column.place}'} in {column.unit}{turned}"
