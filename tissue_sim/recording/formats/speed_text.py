"""Find the speed of a test in the text above a table."""

from __future__ import annotations

import re
from collections.abc import Sequence

from tissue_sim.recording.formats.table import TableRow

#: Unit of a speed, without blanks, lower case -> m/s.
_SPEED_UNITS = {"mm/min": 1e-3 / 60.0, "mmmin-1": 1e-3 / 60.0, "mm/s": 1e-3, "mm/sec": 1e-3, "mms-1": 1e-3,
                "um/s": 1e-6, "µm/s": 1e-6, "μm/s": 1e-6, "cm/min": 1e-2 / 60.0, "cm/s": 1e-2, "m/s": 1.0,
                "in/min": 0.0254 / 60.0, "in/s": 0.0254}
#: Pattern of a number with a decimal point or comma.
_NUMBER = r"(\d+(?:[.,]\d+)?)"
#: Pattern of a unit of length.
_LENGTH = r"(?:mm|cm|um|µm|μm|in|m)"
#: ``0.5 mm/s``, ``30 mm min-1``.
_SPEED = re.compile(rf"(?<![\w.,]){_NUMBER}\W{{0,3}}({_LENGTH} ?/? ?(?:min|sec|s)(?:-1|\b))", re.IGNORECASE)
#: ``Speed (mm/min): 30``.
_UNIT_FIRST = re.compile(rf"[\[(]({_LENGTH}/(?:min|sec|s))[\])]\W{{0,3}}{_NUMBER}(?![\w.,])", re.IGNORECASE)
#: Words for speeds of other parts of a test than the loading.
_OTHER_SPEED = re.compile(r"\b(approach|return|retract\w*|unload\w*|pre\w*|jog|max\w*|data|rück\w*|"
                          r"vor(kraft|last|weg|spann)\w*|anfahr\w*|retour)\b", re.IGNORECASE)


def find_loading_speeds_and_their_lines(rows: Sequence[TableRow]) -> dict[float, str]:
    """Return speed of loading, m/s -> line, for each speed that the rows state."""
    found: dict[float, str] = {}
    for row in rows:
        line = " ".join(cell for cell in row.cells if cell).replace("⁻¹", "-1").replace("·", " ")
        if _OTHER_SPEED.search(line):
            continue
        pairs = [(number, unit) for number, unit in _SPEED.findall(line)]
        pairs += [(number, unit) for unit, number in _UNIT_FIRST.findall(line)]
        for number, unit in pairs:
            factor = _SPEED_UNITS.get(unit.casefold().replace(" ", ""), 0.0)
            # Twelve digits: 30 mm/min and 0.5 mm/s are the same speed.
            value = float(f"{float(number.replace(',', '.')) * factor:.12g}")
            if value > 0:
                found.setdefault(value, line)
    return found
