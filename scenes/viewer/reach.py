"""Limits of the tool's depth and lateral position."""

from __future__ import annotations

import numpy as np

from scenes.viewer.scene import Scene
from tissue_sim.errors import InputError
from tissue_sim.experiment.experiment import Experiment
from tissue_sim.experiment.protocol import Protocol
from tissue_sim.fem.result_views import SolidGeometry
from tissue_sim.snapshot import Snapshot


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
        InputError: The motion is deeper than the scene's mesh allows, or lifts a tool that is attached to a reduced
            solid.
    """
    deepest, mesh_depth = float(protocol.displacement.max()), scene.max_tool_displacement
    # The tolerance of 1 % allows for noise of measured displacements.
    if deepest > 1.01 * mesh_depth:
        raise InputError(f"must have a depth of at most {mesh_depth * 1e3:.4g} mm, because the mesh is made for "
                         f"{mesh_depth * 1e3:.4g} mm; got {deepest * 1e3:.4g} mm. Restart the viewer with a larger "
                         "--depth-mm.", field=field)
    if scene.min_tool_displacement == 0.0 and float(protocol.displacement.min()) < -0.01 * mesh_depth:
        raise InputError("must not lift the tool: a reduced solid that it holds cannot be lifted. Remove approach and "
                         "retract.", field=field)
