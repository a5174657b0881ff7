"""Metadata that a simulated recording stores about its test."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tissue_sim.experiment.experiment import Experiment


def make_kind_specimen_tool_metadata(kind: str, experiment: Experiment) -> dict[str, Any]:
    """Describe test kind, specimen and tool for the sidecar of a recording.

    With these entries a reader can tell, for example, the indentation with a cone from one with a flat punch.

    Args:
        kind: name of the test kind, a key of `tissue_sim.experiment.kinds.kind.KINDS`.
        experiment: simulated experiment.

    Returns:
        JSON entries ``kind``, ``specimen`` and ``tool``; of an oblique or eccentric indentation also ``approach`` with
        ``offset_mm`` and ``tilt_deg``. Lengths in mm.
    """
    tool = experiment.tool
    sizes = {} if tool.is_plate or tool.radius is None else {"radius_mm": tool.radius * 1e3}
    line = experiment.approach
    approach = {} if line is None else {"approach": {"offset_mm": line.offset * 1e3,
                                                     "tilt_deg": math.degrees(line.angle)}}
    specimen = experiment.specimen
    return {"kind": kind, "specimen": {"shape": specimen.shape, **specimen.values_by_file_key},
            "tool": {"shape": tool.shape, **sizes}, **approach}
