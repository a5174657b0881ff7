"""Read kind of test, specimen and tool from the sidecar of a recording, so that the user need not state them."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from tissue_sim.decode import read_json_value
from tissue_sim.errors import InputError
from tissue_sim.experiment.kinds.kind import KINDS
from tissue_sim.files import read_bytes
from tissue_sim.recording.formats.guesses import FileInterpretation, KindGuess, TableGroup
from tissue_sim.settings import make_shallow_read_only_copy


def read_matching_sidecar_or_empty(path: Path) -> Mapping[str, Any]:
    """Return the metadata in the sidecar ``NAME.json`` of a recording ``NAME.csv``.

    The result is empty without a sidecar, or if the digest in the sidecar differs from that of the recording.
    """
    sidecar = path.with_suffix(".json")
    if path.suffix.lower() != ".csv" or not sidecar.is_file():
        return {}
    with suppress(InputError):
        said = read_json_value(sidecar, "the sidecar of a recording")
        digest = hashlib.sha256(read_bytes(path, "a recording")).hexdigest()
        if isinstance(said, Mapping) and said.get("sha256") == digest:
            return said
    return {}


def find_test_kind_in_sidecar(said: Mapping[str, Any]) -> str | None:
    """Return the kind of test that a sidecar states; None if the kind is absent or not registered."""
    kind = said.get("kind")
    return kind if isinstance(kind, str) and kind in KINDS else None


def copy_interpretation_with_sidecar_data(found: FileInterpretation, said: Mapping[str, Any], *,
                                          kind_stated: bool) -> FileInterpretation:
    """Return a copy of the interpretation of a file with the kind of test, specimen sizes and tool of its sidecar.

    Args:
        found: interpretation of the file.
        said: metadata, see `read_matching_sidecar_or_empty`.
        kind_stated: whether the user states the kind.
    """
    if not said:
        return found
    reason, kind = f"in {found.file.with_suffix('.json').name}", find_test_kind_in_sidecar(said)
    specimen = said.get("specimen")
    sizes = {key: value for key, value in specimen.items() if key == "shape" or isinstance(value, int | float)} \
        if isinstance(specimen, Mapping) else {}
    tool = said.get("tool")
    about = {"tool": tool.get("shape"), "tool_radius_mm": tool.get("radius_mm")} if isinstance(tool, Mapping) else \
        {"tool": tool, "tool_radius_mm": said.get("tool_radius_mm")}
    about = {key: value for key, value in about.items() if value is not None}

    def add_sidecar_data_to_reading(reading: TableGroup) -> TableGroup:
        """Return a copy of a reading with the kind of test, the specimen sizes and the tool that the sidecar states."""
        guess = reading.kind if kind is None or kind_stated else KindGuess(kind, reason)
        return replace(reading, kind=guess, specimen=make_shallow_read_only_copy(sizes),
                       recordings=tuple(each.with_metadata(**about) for each in reading.recordings))

    return replace(found, readings=tuple(map(add_sidecar_data_to_reading, found.readings)))
