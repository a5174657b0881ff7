"""Saved state of a simulator between two steps, and check of its origin."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from numbers import Real
from typing import Any

from tissue_sim.errors import InputError
from tissue_sim.material.effect import ToolHistory
from tissue_sim.model import Model
from tissue_sim.pose import Pose
from tissue_sim.realtime.inertia_limits import ToolReversalDetector
from tissue_sim.realtime.pending_path import LastEquilibrium, PendingPath
from tissue_sim.realtime.tool_track import ToolTrack
from tissue_sim.tool_force import ToolForce


@dataclass(frozen=True)
class StateOrigin:
    """Origin of a saved state. A simulator restores states whose origin equals the origin of the states that it saves.

    Attributes:
        solver: name.
        mesh: digest of the undeformed mesh.
        experiment: specimen, tool, interfaces, approach and laws of contact, as text.
        material: law, effects and layers, without the values of parameters, as text.
    """

    solver: str
    mesh: str
    experiment: str
    material: str

    @classmethod
    def from_model(cls, solver: str, mesh: str, model: Model) -> StateOrigin:
        """Make the origin of saved states from solver name, digest of the mesh, and model."""
        experiment = {each.name: getattr(model.experiment, each.name) for each in fields(model.experiment)
                      if each.name != "protocol"}
        return cls(solver, mesh, repr(experiment), format_material_structure_as_text(model.material))

    def require_equal_origin(self, other: StateOrigin) -> None:
        """Raise an error unless a state has the same solver, mesh, experiment and material structure.

        Raises:
            InputError: another solver, mesh, experiment or structure of the material.
        """
        for name, what in (("solver", "solver"), ("experiment", "specimen, tool or interface"),
                           ("material", "law or with other effects or layers"), ("mesh", "mesh")):
            if getattr(self, name) != getattr(other, name):
                raise InputError(f"must be of the same model and mesh; this state is of another {what}. Restore the "
                                 "state in the simulator that saved it, or in a clone() of that simulator.",
                                 field="state")


def format_material_structure_as_text(value: Any) -> str:
    """Return law, effects and layers of a material as text, without numbers and names, to compare two structures."""
    if is_dataclass(value):
        inner = [f"{each.name}={format_material_structure_as_text(getattr(value, each.name))}" for each in fields(value)
                 if each.name not in ("name", "bulk", "parameters", "density", "source")]
        return f"{type(value).__name__}({', '.join(inner)})"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {format_material_structure_as_text(entry)}" for key,
                               entry in sorted(value.items())) + "}"
    if isinstance(value, str):
        return repr(value)
    if isinstance(value, Sequence):
        return "[" + ", ".join(map(format_material_structure_as_text, value)) + "]"
    return "None" if value is None else "number" if isinstance(value, Real) else type(value).__name__


@dataclass(frozen=True, eq=False)
class SimulatorState:
    """State of a simulator between two steps; see `Simulator.save`."""

    origin: StateOrigin
    solver: Any
    answer: ToolForce
    equilibrium: LastEquilibrium
    tool: ToolTrack
    pose: Pose
    leaps: bool
    pending: PendingPath
    lingers: float
    share: float
    begins: bool
    largest_force: float
    motion_check: ToolReversalDetector
    history: ToolHistory
    error: float | None
