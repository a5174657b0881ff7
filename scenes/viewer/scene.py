"""What is looked at: an experiment of some kind, a material and measurements of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import tissue_sim as ts
from scenes.catalogue import SCENES
from scenes.viewer.measurement import Measurement, measurement
from tissue_sim.experiment.kinds.kind import TestKind

#: Of a material that comes from no file.
BUILT_IN = "silicone of the study"
#: How far above the touch a tool may be lifted, m.
CLEARANCE = 5e-3


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything that the pictures depend on but for the motion of the tool.

    Attributes:
        kind: of test.
        experiment: with specimen, tool and interfaces; its protocol is what the model's curve is computed for where
            nothing was measured, and its largest depth is where the slider ends.
        material: as it is now.
        source: where the material comes from, for people.
        measurements: by the name of the kind that they belong to.
        solver: name in `tissue_sim.fem.solver.SOLVERS`.
        rig: that the model's curve is measured with; the tool that is felt moves without it.
        reduced: the solid that the solver ``"reduced"`` steps; else None.
        compared: a curve of this kind of test to begin with, beside the model's, and its name.
    """

    kind: TestKind
    experiment: ts.Experiment
    material: ts.Material
    source: str = BUILT_IN
    measurements: Mapping[str, Measurement] = field(default_factory=dict)
    solver: str = "axisymmetric"
    rig: ts.Rig = field(default_factory=ts.Rig)
    compared: tuple[str, ts.Recording] | None = None
    reduced: ts.ReducedModel | None = None

    @property
    def model(self) -> ts.Model:
        """Experiment and material."""
        return ts.Model(self.experiment, self.material)

    @property
    def measurement(self) -> Measurement | None:
        """That of this scene; None where there is none."""
        return self.measurements.get(self.kind.name)

    @property
    def deepest(self) -> float:
        """Largest tool displacement, m."""
        return self.experiment.protocol.depth

    @property
    def half_width(self) -> float:
        """How far from its axis the undeformed specimen reaches, m."""
        return self.experiment.specimen.outer_radius

    @property
    def reach(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """From where to where the tool's axis may be at the height of the touch, along x, and along y, m; of a reduced
        solid where the tool stays in its box on its whole way down, or else where it comes nearest to that."""
        if self.reduced is None:
            return self._edges
        (x, y, _), aside = self.experiment.tool_pose(0.0).position, self.reduced.box.sideways
        # A tool that leans goes aside as it goes down.
        (end, *_) = self.experiment.tool_pose(self.deepest).position
        low, high = x - aside - min(end - x, 0.0), x + aside - max(end - x, 0.0)
        if low > high:
            low = high = 0.5 * (low + high)
        return (low, high), (y - aside, y + aside)

    @cached_property
    def _edges(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Where the top ends along x, and along y, m."""
        specimen = self.experiment.specimen
        return ((-_edge(specimen, -1.0, 0.0), _edge(specimen, 1.0, 0.0)),
                (-_edge(specimen, 0.0, -1.0), _edge(specimen, 0.0, 1.0)))

    @property
    def highest(self) -> float:
        """Smallest tool displacement, m: above the tissue, but of a reduced solid that the tool holds."""
        return 0.0 if self.reduced is not None and self.reduced.lifting else -CLEARANCE

    def with_scene(self, name: str, *, tool: ts.Tool | None = None, friction: str | float | None = None) -> Scene:
        """Another kind of test, tool or interface of the tool's face, on the same specimen with the same protocol.

        Args:
            name: of a scene in `scenes.SCENES`.
            tool: None: the one at hand where it fits the kind, else the kind's own.
            friction: None: the one at hand for the same kind, else the kind's own.

        Raises:
            InputError: no such scene, or what does not fit it.
        """
        if self.reduced is not None:
            raise ts.InputError("a reduced solid has the test, tool and interfaces that it was made of; look at others "
                                "without it", field="scene")
        if name not in SCENES:
            raise ts.InputError(f"no scene {name!r}; known: {', '.join(SCENES)}", field="scene")
        kind, before = SCENES[name], self.experiment
        if tool is None:
            tool = before.tool if kind.fits(before.tool) else kind.require_tool()
        if not kind.fits(tool):
            raise ts.InputError(f"{kind.title.lower()} is not done with the tool {tool.shape!r}", field="tool")
        changes: dict[str, Any] = kind.interfaces(tool)
        if kind is self.kind:
            changes = {key: getattr(before, key) for key in changes}
        if friction is not None:
            changes["friction"] = friction
        return replace(self, kind=kind, experiment=replace(before, tool=tool, **changes))


def read_measurements(paths: Sequence[str | Path], scene: str) -> dict[str, Measurement]:
    """Recordings by the scene that they belong to: the kind of test in their sidecar, or else `scene`.

    Raises:
        InputError: an unreadable file, or one of a kind that is no scene.
    """
    by_kind: dict[str, list[ts.Recording]] = {}
    for path in paths:
        recording = ts.read_recording(path)
        kind = str(recording.metadata.get("kind", scene))
        if kind not in SCENES:
            raise ts.InputError(f"is of kind {kind!r}, for which there is no scene; known: {', '.join(SCENES)}",
                                file=path, field="kind")
        by_kind.setdefault(kind, []).append(recording)
    return {kind: measurement(recordings) for kind, recordings in by_kind.items()}


def _edge(specimen: ts.Specimen, x: float, y: float) -> float:
    """How far its top goes from the axis in a direction, m."""
    low, high = 0.0, specimen.outer_radius
    if specimen.margin(high * x, high * y) >= 0.0:
        return high
    while high - low > 1e-9 * specimen.outer_radius:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if specimen.margin(middle * x, middle * y) >= 0.0 else (low, middle)
    return high
