"""What a recording says of where it comes from."""

from __future__ import annotations

from collections.abc import Mapping
from math import isclose

from tissue_sim.recording.recording import Recording

#: Radii that differ by no more than this share are one radius.
_SAME = 0.01


def other_tool(recording: Recording, shape: str, radius: float | None) -> str:
    """With which tool it was measured, where its metadata say another shape or radius than these (m); else empty."""
    said = recording.metadata.get("tool")
    if not isinstance(said, Mapping) or "shape" not in said:
        return ""
    measured = said.get("radius_mm")
    tool, other = str(said["shape"]), said["shape"] != shape
    if isinstance(measured, (int, float)):
        tool += f" of {measured:g} mm radius"
        other |= radius is not None and not isclose(measured, radius * 1e3, rel_tol=_SAME)
    return tool if other else ""


def other_kind(recording: Recording, kind: str) -> str:
    """Of which kind of test its metadata say that it is, where that is not this one; else empty."""
    said = recording.metadata.get("kind", kind)
    return "" if said == kind else str(said)
