"""Read compression tests of an Instron 5900 in the format of the tissue phantom database (Dawood et al. 2026).

Lines such as ``Cylinder Diameter: 50mm;`` precede a header with Time, Compression, Load and derived columns.
Compression and load are positive in compression. The derived strains and stresses are not read, because their signs in
the header and their unit in the README of the data set are wrong.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from tissue_sim.files import read_text
from tissue_sim.recording.formats.blocks import find_table_header_and_data_rows, iterate_table_for_each_delimiter
from tissue_sim.recording.formats.columns import read_single_recording
from tissue_sim.recording.formats.long_text import try_splitting_off_trailing_numbers
from tissue_sim.recording.formats.number_text import is_number_with_either_mark, parse_number_preferring_point_or_nan
from tissue_sim.recording.recording import Recording
from tissue_sim.units import get_si_factor_and_offset, split_header_with_brackets

#: Channel -> header.
COLUMNS = {"time": "Time", "displacement": "Compression", "force": "Load"}
#: "key: value".
_PAIR = re.compile(r"^(?P<key>[^:]+):(?P<value>.*?)[;,\s]*$")
#: A length with its unit.
_LENGTH = re.compile(r"^(?P<number>\d+(\.\d*)?)\s*(?P<unit>mm|cm|m)$")


def read_instron(path: str | Path) -> Recording:
    """Read time, displacement and force; the metadata have radius, height, speed, machine and load cell.

    Raises:
        InputError: no header with Time, Compression and Load, or an invalid cell; with file and line.
    """
    path = Path(path)
    text = read_text(path, "an Instron export with the columns Time, Compression and Load")
    _, header, _ = find_table_header_and_data_rows(
        iterate_table_for_each_delimiter(try_splitting_off_trailing_numbers(text)[0], file=path),
        list(COLUMNS.values()), file=path)
    lines = [line.strip() for line in text.splitlines()[:header.line - 1] if line.strip(" ;,\t")]
    return read_single_recording(path, COLUMNS, skip_lines=header.line - 1, metadata=_parse_header_metadata(lines))


def _parse_header_metadata(lines: list[str]) -> dict:
    """Return the metadata in the lines above the header."""
    pairs = {match["key"].strip().casefold(): match["value"].strip() for match in map(_PAIR.match, lines) if match}
    metadata: dict[str, Any] = {"format": "instron"}
    if lines and not _PAIR.match(lines[0]):
        metadata["title"] = lines[0].strip(" ;,")
    specimen = {}
    for key, name, factor in (("cylinder diameter", "radius_mm", 0.5), ("cylinder height", "height_mm", 1.0)):
        match = _LENGTH.match(pairs.get(key, ""))
        if match:
            # Rounded to whole nanometres: 25 mm must not become 25.000000000000004 mm.
            specimen[name] = round(float(match["number"]) * get_si_factor_and_offset(match["unit"])[0] * 1e3 * factor,
                                   6)
    if specimen:
        metadata["specimen"] = {"shape": "cylinder", **specimen}
    for key, value in pairs.items():
        name, unit = split_header_with_brackets(key)
        if name == "speed" and unit == "mm/min" and is_number_with_either_mark(value):
            metadata["speed_mm_s"] = parse_number_preferring_point_or_nan(value) / 60.0
        elif name in ("machine", "load cell"):
            metadata[name.replace(" ", "_")] = value
    return metadata
