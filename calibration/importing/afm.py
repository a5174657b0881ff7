"""Files of atomic force microscopes and nanoindenters: their curves are replicates of an indentation."""

from __future__ import annotations

import zipfile
from pathlib import Path

from tissue_sim.files import ZIP_MAGIC, read_bytes, read_first_bytes_or_empty
from tissue_sim.recording.file import read_recordings
from tissue_sim.recording.formats.guesses import FileInterpretation, KindGuess, TableGroup
from tissue_sim.settings import make_shallow_read_only_copy

_SUFFIXES = (".jpk-force", ".jpk-force-map", ".jpk-qi-data", ".jpk-qi-series", ".ibw", ".spm")
#: How the texts of AFM Workshop and of afmformats begin.
_HEADS = (b"Force-Distance Curve", b"# afmformats")


def is_afm_file(path: Path) -> bool:
    """Return whether a file contains force curves of an AFM.

    AFM files are recognised by their suffix or their first bytes; a zip archive that is no spreadsheet counts as AFM.
    """
    if path.suffix.lower() in _SUFFIXES:
        return True
    head = read_first_bytes_or_empty(path, 64)
    if head.startswith(_HEADS):
        return True
    if not head.startswith(ZIP_MAGIC):
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    # Python cannot list this archive: it is damaged, unreadable, or of a newer version of the zip format, for which
    # zipfile raises NotImplementedError. The reader of the file then reports the reason.
    except (zipfile.BadZipFile, OSError, NotImplementedError):
        return False
    return not any(name in ("[Content_Types].xml", "content.xml") or name.startswith("xl/") for name in names)


def read_afm_file_as_indentation_replicates(path: Path) -> FileInterpretation:
    """Read a file of force curves of an AFM, and interpret the curves as replicates of a needle indentation.

    Raises:
        InputError: as `tissue_sim.recording.formats.afm.read_afm`.
    """
    read_bytes(path, "force curves of an AFM")
    recordings = read_recordings(path, format="afm")
    kind = KindGuess("needle_indentation", "force curves of an AFM press a tip into the specimen")
    reading = TableGroup("", (), (), make_shallow_read_only_copy({"format": "afm"}), recordings, kind, 1)
    return FileInterpretation(path, "afm", "afm", None, None, None, (reading,))
