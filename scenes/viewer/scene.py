"""Scene of the viewer: an experiment of some kind, a material, measurements, and limits of the tool's position."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

import tissue_sim as ts
from scenes.catalogue import SCENES
from scenes.viewer.measurement import Measurement, build_measurement_from_replicates
from tissue_sim.errors import InputError
from tissue_sim.experiment.experiment import Experiment
from tissue_sim.experiment.kinds.kind import TestKind
from tissue_sim.experiment.protocol import Protocol
from tissue_sim.fem.result_views import SolidGeometry
from tissue_sim.snapshot import Snapshot

#: Source of the default material, which is not read from a file.
BUILT_IN = "silicone of the study"
#: Largest height of the tool above the undeformed surface, m.
CLEARANCE = 5e-3


@dataclass(frozen=True, eq=False)
class Scene:
    """Input of a simulation in the viewer, except for the motion of the tool.

    Attributes:
        kind: Kind of test.
        experiment: Specimen, tool, interfaces and protocol. The largest depth of the protocol is the end of the depth
            slider; without a measurement, the model curve is computed for this protocol.
        material: Present material.
        source: Origin of the material for display, such as a file name.
        measurements: Name of a kind of test -> measurement.
        solver: Name in `tissue_sim.fem.solver.SOLVERS`.
        rig: Measuring rig of the model curve; the live simulation has an ideal rig.
        compared: Name and recording of a curve that is shown next to the model curve at the start; otherwise None.
        reduced: Reduced model for the solver ``"reduced"``; otherwise None.
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
        """Experiment and material as a model."""
        return ts.Model(self.experiment, self.material)

    @property
    def measurement(self) -> Measurement | None:
        """Measurement of this kind of test; None if there is none."""
        return self.measurements.get(self.kind.name)

    @property
    def max_tool_displacement(self) -> float:
        """Largest tool displacement, m."""
        return self.experiment.protocol.depth

    @property
    def specimen_outer_radius(self) -> float:
        """Largest distance of the undeformed specimen from its axis, m."""
        return self.experiment.specimen.outer_radius

    @property
    def allowed_tool_xy_ranges(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Range of x and range of y at which the tool's axis may cross the undeformed surface, m.

        Without a reduced model, the ranges end at the edges of the specimen's top. With a reduced model, the tool stays
        inside the box of the model on its whole path to the largest depth; if that is impossible, the range of x is one
        value, at which the path leaves the box equally far on both sides.
        """
        if self.reduced is None:
            return self._specimen_top_ranges
        (x, y, _), half_width = self.experiment.tool_pose(0.0).position, self.reduced.box.sideways
        # An inclined tool moves along x as it goes deeper.
        (end, *_) = self.experiment.tool_pose(self.max_tool_displacement).position
        low, high = x - half_width - min(end - x, 0.0), x + half_width - max(end - x, 0.0)
        if low > high:
            low = high = 0.5 * (low + high)
        return (low, high), (y - half_width, y + half_width)

    @cached_property
    def _specimen_top_ranges(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Range of x and range of y of the specimen's top along the two axes, m."""
        specimen = self.experiment.specimen
        return ((-_compute_top_edge_radius_in_direction(specimen, -1.0, 0.0),
                 _compute_top_edge_radius_in_direction(specimen, 1.0, 0.0)),
                (-_compute_top_edge_radius_in_direction(specimen, 0.0, -1.0),
                 _compute_top_edge_radius_in_direction(specimen, 0.0, 1.0)))

    @property
    def min_tool_displacement(self) -> float:
        """Smallest tool displacement, m: `CLEARANCE` above the tissue; 0 if the tool is attached to a reduced solid."""
        return 0.0 if self.reduced is not None and self.reduced.lifting else -CLEARANCE

    def with_test_and_tool(self, name: str, *, tool: ts.Tool | None = None,
                           friction: str | float | None = None) -> Scene:
        """Return the scene with another kind of test, tool or interface; specimen and protocol stay the same.

        Args:
            name: Name of a scene in `scenes.SCENES`.
            tool: New tool; None: the present tool if it fits the kind of test, otherwise the default of the kind.
            friction: New interface of the tool's face; None: the present one for the same kind of test, otherwise the
                default of the kind.

        Raises:
            InputError: The scene does not exist, the tool does not fit it, or the scene has a reduced model.
        """
        if self.reduced is not None:
            raise ts.InputError("cannot be changed for a reduced solid, which is valid for one test, one tool and one "
                                "interface. Start the viewer without the reduced solid.", field="scene")
        if name not in SCENES:
            raise ts.InputError(f"must be one of {', '.join(SCENES)}; got {name!r}", field="scene")
        kind, before = SCENES[name], self.experiment
        if tool is None:
            tool = before.tool if kind.allows_tool(before.tool) else kind.require_tool()
        if not kind.allows_tool(tool):
            raise ts.InputError(f"must fit the scene {kind.title.lower()}; got a {tool.shape!r} tool. Choose another "
                                "tool or scene.", field="tool")
        changes: dict[str, Any] = kind.make_default_interfaces_by_field(tool)
        if kind is self.kind:
            changes = {key: getattr(before, key) for key in changes}
        if friction is not None:
            changes["friction"] = friction
        return replace(self, kind=kind, experiment=replace(before, tool=tool, has_lateral_wall=kind.has_lateral_wall,
                                                           **changes))


def read_measurements_by_kind(paths: Sequence[str | Path], scene: str) -> dict[str, Measurement]:
    """Read recordings and group them into one measurement per kind of test.

    Args:
        paths: Recording files.
        scene: Kind of test of recordings whose sidecar does not state one.

    Returns:
        Name of a kind of test -> measurement.

    Raises:
        InputError: A file cannot be read, or its kind of test is not a scene of the viewer.
    """
    by_kind: dict[str, list[ts.Recording]] = {}
    for path in paths:
        recording = ts.read_recording(path)
        kind = str(recording.metadata.get("kind", scene))
        if kind not in SCENES:
            remedy = "Correct kind in the sidecar" if "kind" in recording.metadata else "State --scene"
            raise ts.InputError(f"the kind of test of a recording must be one of {', '.join(SCENES)}; got {kind!r}. "
                                f"{remedy}", file=path, field="kind")
        by_kind.setdefault(kind, []).append(recording)
    return {kind: build_measurement_from_replicates(recordings) for kind, recordings in by_kind.items()}


def _compute_top_edge_radius_in_direction(specimen: ts.Specimen, x: float, y: float) -> float:
    """Return the distance of the top's edge from the axis in the direction of the unit vector (x, y), m."""
    low, high = 0.0, specimen.outer_radius
    if specimen.margin(high * x, high * y) >= 0.0:
        return high
    while high - low > 1e-9 * specimen.outer_radius:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if specimen.margin(middle * x, middle * y) >= 0.0 else (low, middle)
    return high


def limit_lateral_position_to_top(experiment: Experiment, snapshot: Snapshot,
                                  across: tuple[float, float]) -> tuple[float, float]:
    """Move a lateral position towards the middle of the specimen until the whole tool is above the top surface.

    Args:
        experiment: Experiment with the tool and the specimen.
        snapshot: Snapshot of the tissue; if its fields have a top in 3D, that top is used, otherwise the circle
            with the radius of the specimen.
        across: x and y, m.

    Returns:
        x and y, m.
    """
    from scipy.spatial import ConvexHull

    tool, fields = experiment.tool, snapshot.drawable_fields
    radius = 0.0 if tool.is_plate else tool.radius or 0.0
    geometry = None if fields is None else fields.geometry()
    if isinstance(geometry, SolidGeometry) and geometry.top is not None:
        top = geometry.nodes[geometry.top, :2]
    else:
        angles = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
        top = experiment.specimen.outer_radius * np.column_stack([np.cos(angles), np.sin(angles)])
    hull = ConvexHull(top)
    middle = top[hull.vertices].mean(axis=0)
    offset = np.asarray(across, dtype=float) - middle
    # Outward normal of each side of the hull, and its distance from the middle.
    normals, distances = hull.equations[:, :2], -(hull.equations[:, :2] @ middle + hull.equations[:, 2])
    approach = normals @ offset
    approached = approach > 0.0
    fraction = min(1.0, float((np.maximum(distances[approached] - radius, 0.0)
                               / approach[approached]).min(initial=1.0)))
    x, y = (middle + fraction * offset).tolist()
    return x, y


def limit_lateral_position_to_top_and_range(scene: Scene, snapshot: Snapshot,
                                            across: tuple[float, float]) -> tuple[float, float]:
    """Limit a lateral position of the tool, x and y in m, to the top surface and to `Scene.allowed_tool_xy_ranges`.

    `limit_lateral_position_to_top` computes the limits of the top surface.
    """
    x, y = (min(max(value, low), high) for value, (low, high) in zip(
        limit_lateral_position_to_top(scene.experiment, snapshot, across), scene.allowed_tool_xy_ranges, strict=True))
    return x, y


def require_depths_within_scene(scene: Scene, protocol: Protocol, field: str) -> None:
    """Check that a motion stays within the depths of a scene, with a tolerance of 1 %.

    Args:
        scene: The scene.
        protocol: Motion along the axis of the tool.
        field: Name of the motion in messages.

    Raises:
        InputError: The protocol prescribes a force, is deeper than the scene's mesh allows, or lifts a tool that is
            attached to a reduced solid.
    """
    protocol.require_displacement_control("the viewer", field)
    deepest, mesh_depth = float(protocol.displacement.max()), scene.max_tool_displacement
    # The tolerance of 1 % allows for noise of measured displacements.
    if deepest > 1.01 * mesh_depth:
        raise InputError(f"must have a depth of at most {mesh_depth * 1e3:.4g} mm, because the mesh is made for "
                         f"{mesh_depth * 1e3:.4g} mm; got {deepest * 1e3:.4g} mm. Restart the viewer with a larger "
                         "--depth-mm.", field=field)
    if scene.min_tool_displacement == 0.0 and float(protocol.displacement.min()) < -0.01 * mesh_depth:
        raise InputError("must not lift the tool: a reduced solid that it holds cannot be lifted. Remove approach and "
                         "retract.", field=field)
