"""What the sidecar of a simulated recording says of its test."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tissue_sim.experiment.experiment import Experiment


def what_was_done(kind: str, experiment: Experiment) -> dict[str, Any]:
    """The kind of test, specimen and tool, so that none compares a cone with a flat punch unawares."""
    tool = experiment.tool
    sizes = {} if tool.is_plate or tool.radius is None else {"radius_mm": tool.radius * 1e3}
    approach = experiment.approach
    way = {} if approach is None else {"approach": {"offset_mm": approach.offset * 1e3,
                                                    "tilt_deg": math.degrees(approach.angle)}}
    specimen = experiment.specimen
    return {"kind": kind, "specimen": {"shape": specimen.shape, **specimen.stated},
            "tool": {"shape": tool.shape, **sizes}, **way}
