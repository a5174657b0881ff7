"""How deep and how far aside a tool may go."""

from __future__ import annotations

import numpy as np

from scenes.viewer.scene import Scene
from tissue_sim.errors import InputError
from tissue_sim.experiment.experiment import Experiment
from tissue_sim.experiment.protocol import Protocol
from tissue_sim.snapshot import Snapshot


def within_top(experiment: Experiment, snapshot: Snapshot, across: tuple[float, float]) -> tuple[float, float]:
    """The place that is nearest to one, on the way to the middle, at which the whole tool is over the top.

    Args:
        experiment: with the tool.
        snapshot: of the tissue; its undeformed top is what its mesh says, or else that of the specimen.
        across: x and y, m.
    """
    from scipy.spatial import ConvexHull

    tool, mesh = experiment.tool, getattr(snapshot.fields, "mesh", None)
    radius = 0.0 if tool.is_plate else tool.radius or 0.0
    if mesh is not None and "top" in getattr(mesh, "sets", {}) and mesh.nodes.shape[1] == 3:
        top = mesh.nodes[mesh.sets["top"], :2]
    else:
        angles = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
        top = experiment.specimen.outer_radius * np.column_stack([np.cos(angles), np.sin(angles)])
    hull = ConvexHull(top)
    middle = top[hull.vertices].mean(axis=0)
    way = np.asarray(across, dtype=float) - middle
    # Of each side its outward normal, and how far it is from the middle.
    normals, far = hull.equations[:, :2], -(hull.equations[:, :2] @ middle + hull.equations[:, 2])
    gains = normals @ way
    ahead = gains > 0.0
    share = min(1.0, float((np.maximum(far[ahead] - radius, 0.0) / gains[ahead]).min(initial=1.0)))
    x, y = (middle + share * way).tolist()
    return x, y


def within_reach(scene: Scene, snapshot: Snapshot, across: tuple[float, float]) -> tuple[float, float]:
    """The place within the reach of a scene that is nearest to one over the top; see `within_top`."""
    x, y = (min(max(value, low), high) for value, (low, high) in zip(
        within_top(scene.experiment, snapshot, across), scene.reach, strict=True))
    return x, y


def require_within_reach(scene: Scene, protocol: Protocol, field: str) -> None:
    """Raises InputError: a motion along the axis that goes deeper than a scene is made for, or lifts what cannot be."""
    deepest, mesh = float(protocol.displacement.max()), scene.deepest
    # A measured depth trembles.
    if deepest > 1.01 * mesh:
        raise InputError(f"goes to {deepest * 1e3:.4g} mm, and the mesh is made for {mesh * 1e3:.4g} mm; start the "
                         "viewer with a larger --depth-mm", field=field)
    if scene.highest == 0.0 and float(protocol.displacement.min()) < -0.01 * mesh:
        raise InputError("lifts the tool, and a reduced solid that it holds cannot be lifted; leave approach and "
                         "retract out", field=field)
