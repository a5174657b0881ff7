"""Compare the tool and the kind of test in the metadata of a recording with the expected ones."""

from __future__ import annotations

from collections.abc import Mapping
from math import isclose

from tissue_sim.recording.recording import Recording

#: Largest relative difference of equal radii.
_RADIUS_TOLERANCE = 0.01


def get_recorded_tool_if_different_or_empty(recording: Recording, shape: str, radius: float | None) -> str:
    """Return the tool in the metadata if it differs from the expected shape or radius (m); else an empty text."""
    stated = recording.metadata.get("tool")
    if not isinstance(stated, Mapping) or "shape" not in stated:
        return ""
    measured = stated.get("radius_mm")
    tool, other = str(stated["shape"]), stated["shape"] != shape
    if isinstance(measured, (int, float)):
        tool += f" of {measured:g} mm radius"
        other |= radius is not None and not isclose(measured, radius * 1e3, rel_tol=_RADIUS_TOLERANCE)
    return tool if other else ""


def get_recorded_kind_if_different_or_empty(recording: Recording, kind: str) -> str:
    """Return the kind of test in the metadata if it differs from the expected kind; else an empty text."""
    stated = recording.metadata.get("kind", kind)
    return "" if stated == kind else str(stated)
