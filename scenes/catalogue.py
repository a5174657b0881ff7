"""Catalogue of the scenes and simulated tests, and the metadata of their simulated recordings.

Scenes are the kinds of test that use a tool, which can therefore be moved interactively. Simulated tests are these and
the kinds whose specimen is gripped.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

from tissue_sim.experiment.kinds.kind import KINDS, TestKind

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
        ``offset_mm`` and ``tilt_deg``. Lengths in mm. A gripped specimen has no tool.
    """
    specimen = experiment.specimen
    entries = {"kind": kind, "specimen": {"shape": specimen.shape, **specimen.values_by_file_key}}
    if experiment.grip is not None:
        return entries
    tool = experiment.tool
    sizes = {} if tool.is_plate or tool.radius is None else {"radius_mm": tool.radius * 1e3}
    line = experiment.approach
    approach = {} if line is None else {"approach": {"offset_mm": line.offset * 1e3,
                                                     "tilt_deg": math.degrees(line.angle)}}
    return {**entries, "tool": {"shape": tool.shape, **sizes}, **approach}


class _MappingOfTestKinds(Mapping[str, TestKind]):
    """Read-only mapping, name -> kind of test, of those `KINDS` that satisfy a condition; installed ones are included.

    Args:
        has: condition.
    """

    def __init__(self, has: Callable[[TestKind], bool]):
        self._has = has

    def __getitem__(self, name: str) -> TestKind:
        kind = KINDS[name]
        if not self._has(kind):
            raise KeyError(name)
        return kind

    def __iter__(self) -> Iterator[str]:
        return (name for name, kind in KINDS.items() if self._has(kind))

    def __len__(self) -> int:
        return sum(1 for _ in self)


#: Scenes by name.
SCENES: Mapping[str, TestKind] = _MappingOfTestKinds(lambda kind: not kind.has_gripped_ends)
#: Simulated tests by name.
SIMULATED: Mapping[str, TestKind] = _MappingOfTestKinds(lambda kind: kind.is_simulated)
