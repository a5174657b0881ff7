"""Pictures of a solid in space: a cut through the plane of the tool, and the surface seen obliquely."""

from __future__ import annotations

import numpy as np

from scenes.colour_scale import colour_scale
from scenes.field_labels import LABELS
from tissue_sim.experiment.tools.tool import Tool
from tissue_sim.fem.solid.fields import SolidFields
from tissue_sim.mesh.sections import section, section_lines
from tissue_sim.mesh.subdivision import side_edges, surface_triangles, tetrahedra
from tissue_sim.pose import Pose

RIGID = "0.72"
_DASHED = (0, (4, 3))
#: From where the surface is seen, degrees: about z from +x, and above the horizon.
_AZIMUTH, _ELEVATION = -62.0, 26.0
#: Share of a colour that is left where the light, from this direction, does not fall.
_SHADE, _LIGHT = 0.55, np.array([0.25, -0.55, 0.8]) / np.linalg.norm([0.25, -0.55, 0.8])
#: Surfaces that meet at a larger angle are an edge, and are shaded so.
_EDGE = np.cos(np.radians(35.0))
#: Nodes nearer to a plane than this share of the mesh's size lie on it.
_ON_PLANE = 1e-9


def draw_cut(axes, fields: SolidFields, name: str, sample: int, pose: Pose, tool: Tool) -> None:
    """The deformed section in the plane through the tool's axis and x, with element edges, the undeformed outline and
    the tool.

    Args:
        axes: of matplotlib.
        fields: of the simulation.
        name: in `LABELS`.
        sample: of the simulation.
        pose: of the tool then.
        tool: its shape.
    """
    from matplotlib.collections import LineCollection
    from matplotlib.tri import Triangulation

    mesh, scale = fields.mesh, colour_scale(fields, name, sample)
    place = deformed(fields, sample)
    heights = above_plane(place, pose)
    crossings, triangles = section(mesh.connectivity[:, tetrahedra(mesh.element)].reshape(-1, 4), heights)
    points = crossings.carry(place)
    values = crossings.carry(fields.at_nodes(name, sample) * LABELS[name][1])
    # Seen from -y, to which the triangles do not look.
    picture = axes.tripcolor(Triangulation(1e3 * points[:, 0], 1e3 * points[:, 2], triangles[:, ::-1]), values,
                             shading="gouraud", cmap="viridis", vmin=scale.low, vmax=scale.high)
    picture.set_in_layout(False)  # it stays inside the frame; its size is asked of each triangle
    sides = surface_triangles(mesh.element, mesh.connectivity[:, mesh.element.faces].reshape(
        -1, mesh.element.faces.shape[1]))
    edges = _in_plane(section_lines(sides, heights).carry(place))
    axes.add_collection(LineCollection(edges, colors="white", linewidths=0.3, alpha=0.4))
    outside = surface_triangles(mesh.element, np.concatenate(list(mesh.faces.values())))
    axes.add_collection(LineCollection(_in_plane(section_lines(outside, heights).carry(place)), colors="0.15",
                                       linewidths=1.0))
    before = mesh.nodes - [0.0, 0.0, fields.datum]
    axes.add_collection(LineCollection(_in_plane(section_lines(outside, above_plane(before, pose)).carry(before)),
                                       colors="0.4", linewidths=0.9, linestyles=[_DASHED]))
    low, high = 1e3 * place.min(axis=0), 1e3 * np.maximum(place.max(axis=0), before.max(axis=0))
    width, plate = 0.59 * np.ptp(1e3 * place[:, 0]), 0.04 * (high - low).max()
    middle = 0.5 * (low[0] + high[0])
    axes.fill_between([middle - width, middle + width], low[2], low[2] - plate, color=RIGID, linewidth=0)
    if tool.is_plate:
        height = 1e3 * pose.position[2]
        axes.fill_between([middle - width, middle + width], height, height + plate, color=RIGID, linewidth=0)
    else:
        outline = tool_outline(tool, place, pose)
        both = np.concatenate([outline, (outline * [-1.0, 1.0])[::-1]])
        tip, rotation = np.array(pose.position), np.array(pose.rotation)
        drawn = 1e3 * (tip + np.column_stack([both[:, 0], np.zeros(len(both)), both[:, 1]]) @ rotation.T)
        axes.fill(drawn[:, 0], drawn[:, 2], color=RIGID, edgecolor="0.4", linewidth=0.6)
    finish(axes, "x [mm]")
    axes.figure.colorbar(picture, ax=axes, label=scale.label, extend=scale.extend, shrink=0.85)


def draw_surface(axes, fields: SolidFields, name: str, sample: int, pose: Pose, tool: Tool) -> None:
    """The deformed surface with the edges of its elements, and the tool, as one sees them from above; arguments as of
    `draw_cut`, and its colours."""
    from matplotlib import colormaps
    from matplotlib.collections import LineCollection

    mesh, scale = fields.mesh, colour_scale(fields, name, sample)
    place = deformed(fields, sample)
    sides = np.concatenate(list(mesh.faces.values()))
    points, triangles = _with_edges(place, surface_triangles(mesh.element, sides))
    values = fields.at_nodes(name, sample)[points] * LABELS[name][1]
    share = (values - scale.low) / (scale.high - scale.low) if scale.high > scale.low else np.zeros_like(values)
    bodies = [(place[points], triangles, colormaps["viridis"](np.clip(share, 0.0, 1.0))[:, :3])]
    if not tool.is_plate:
        outline = tool_outline(tool, place, pose)
        vertices, faces = revolved(outline)
        vertices = np.array(pose.position) + vertices @ np.array(pose.rotation).T
        apart, faces = _with_edges(vertices, faces)
        bodies.append((vertices[apart], faces, np.full((len(apart), 3), float(RIGID))))
    _paint(axes, bodies)
    # Edges of the elements that look to the viewer.
    lines = place[sides[:, side_edges(mesh.element)].reshape(-1, 2)]
    normals = _sums(place, surface_triangles(mesh.element, sides), len(place))
    lines = lines[(normals[sides[:, side_edges(mesh.element)].reshape(-1, 2)] @ _toward() > 0.0).all(axis=1)]
    if not tool.is_plate:
        lines = lines[~_hidden(lines.mean(axis=1), *bodies[1][:2])]
    thickness = min(0.4, 8.0 / np.sqrt(len(lines) + 1))
    axes.add_collection(LineCollection(list(1e3 * _seen(lines)[..., :2]), colors="white", linewidths=thickness,
                                       alpha=0.55))
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.set_axis_off()
    axes.set_title("the surface from above", loc="left", fontsize=10)


def deformed(fields: SolidFields, sample: int) -> np.ndarray:
    """Where the nodes are, m, in the frame of the scene, shape (nodes, 3)."""
    return fields.mesh.nodes + fields.displacement(sample) - [0.0, 0.0, fields.datum]


def above_plane(place: np.ndarray, pose: Pose) -> np.ndarray:
    """Height of places over the plane through the tool's axis and x, m, shape (n,); 0 where they lie on it."""
    heights = place[:, 1] - pose.position[1]
    heights[np.abs(heights) < _ON_PLANE * np.ptp(place)] = 0.0
    return heights


def tool_pose(fields: SolidFields, sample: int, pose: Pose, tool: Tool) -> Pose:
    """Where the tool is: at this pose, but above tissue that it would be in, where the load train gives way."""
    if tool.is_plate:
        return Pose((0.0, 0.0, float(deformed(fields, sample)[fields.mesh.sets["top"], 2].max())))
    place = deformed(fields, sample)[fields.mesh.sets["top"]]
    rotation = np.array(pose.rotation)
    local = (place - np.array(pose.position)) @ rotation
    inside = float(tool.profile.gap(np.column_stack([np.hypot(local[:, 0], local[:, 1]), local[:, 2]])).min())
    if inside > -1e-3 * tool.require_radius():
        return pose
    x, y, z = np.array(pose.position) - inside * rotation[:, 2]
    return Pose((float(x), float(y), float(z)), pose.orientation)


def tool_outline(tool: Tool, place: np.ndarray, pose: Pose) -> np.ndarray:
    """(r, z) of what is drawn of a needle, from its deepest point to the axis above the tissue, m, shape (n, 2)."""
    top = place[:, 2].max() - pose.position[2] + 0.35 * np.ptp(place[:, 2])
    outline = tool.profile.outline(top / max(pose.rotation[2][2], 0.2))
    return np.concatenate([outline, [[0.0, outline[-1, 1]]]])


def revolved(outline: np.ndarray, segments: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """A line (r, z) from the axis below to the axis above, shape (n, 2), turned around it: vertices, and triangles
    whose normals point away from the body."""
    angles = np.linspace(0.0, 2.0 * np.pi, segments, endpoint=False)
    ring = np.column_stack([np.cos(angles), np.sin(angles)])
    vertices = np.concatenate([np.column_stack([r * ring, np.full(segments, z)]) for r, z in outline])
    here = np.arange(segments)
    beside = (here + 1) % segments
    faces = []
    for k in range(len(outline) - 1):
        low, high = segments * k, segments * (k + 1)
        faces += [np.column_stack([low + here, low + beside, high + beside]),
                  np.column_stack([low + here, high + beside, high + here])]
    return vertices, np.concatenate(faces)


def finish(axes, across: str) -> None:
    """Equal scales, and what they are."""
    axes.set_aspect("equal")
    axes.set_xlabel(across)
    axes.set_ylabel("z [mm]")
    axes.spines[["top", "right"]].set_visible(False)


def _in_plane(points: np.ndarray) -> list[np.ndarray]:
    """Ends of lines, shape (2 k, 3), m, as k lines (2, 2), mm."""
    return list(1e3 * points[:, [0, 2]].reshape(-1, 2, 2))


def _toward() -> np.ndarray:
    azimuth, elevation = np.radians([_AZIMUTH, _ELEVATION])
    return np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])


def _seen(points: np.ndarray) -> np.ndarray:
    """To the right, up, and towards the viewer, shape (..., 3)."""
    toward = _toward()
    right = np.array([-np.sin(np.radians(_AZIMUTH)), np.cos(np.radians(_AZIMUTH)), 0.0])
    return points @ np.stack([right, np.cross(toward, right), toward]).T


def _paint(axes, bodies: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> None:
    """Bodies of vertices, triangles and a colour at each vertex, those that are further away first."""
    from matplotlib.collections import TriMesh
    from matplotlib.tri import Triangulation

    places, triangles, colours, before = [], [], [], 0
    for vertices, faces, colour in bodies:
        normals = _sums(vertices, faces, len(vertices))
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
        light = _SHADE + (1.0 - _SHADE) * np.clip(normals @ _LIGHT, 0.0, 1.0)
        a, b, c = np.moveaxis(vertices[faces], 1, 0)
        faces = faces[np.cross(b - a, c - a) @ _toward() > 0.0]
        places.append(vertices)
        triangles.append(faces + before)
        colours.append(colour * light[:, None])
        before += len(vertices)
    points, all_triangles = _seen(np.concatenate(places)), np.concatenate(triangles)
    order = np.argsort(points[all_triangles, 2].mean(axis=1))
    x, y = 1e3 * points[:, 0], 1e3 * points[:, 1]
    mesh = TriMesh(Triangulation(x, y, all_triangles[order]))
    mesh.set_facecolor([(red, green, blue, 1.0) for red, green, blue in np.concatenate(colours).tolist()])
    mesh.set_in_layout(False)  # it stays inside the frame; its size is asked of each triangle
    axes.add_collection(mesh)
    axes.update_datalim(np.column_stack([x, y]))


def _hidden(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Which points stand behind a triangle, seen from the viewer, shape (n,)."""
    seen, corners = _seen(points), _seen(vertices)[faces]
    hidden = np.zeros(len(points), dtype=bool)
    for a, b, c in corners:
        twice = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if twice <= 0.0:
            continue
        u = ((seen[:, 0] - a[0]) * (c[1] - a[1]) - (seen[:, 1] - a[1]) * (c[0] - a[0])) / twice
        v = ((b[0] - a[0]) * (seen[:, 1] - a[1]) - (b[1] - a[1]) * (seen[:, 0] - a[0])) / twice
        inside = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0)
        hidden |= inside & (a[2] + u * (b[2] - a[2]) + v * (c[2] - a[2]) > seen[:, 2])
    return hidden


def _sums(vertices: np.ndarray, faces: np.ndarray, count: int) -> np.ndarray:
    """Of the normals of the triangles at each vertex, shape (count, 3)."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    normals = np.repeat(np.cross(b - a, c - a), 3, axis=0)
    return np.column_stack([np.bincount(faces.ravel(), normals[:, axis], count) for axis in range(3)])


def _with_edges(place: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Triangles that share vertices only where they meet smoothly: the old number of each vertex, shape (m,), and the
    triangles between them."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    a, b, c = np.moveaxis(place[triangles], 1, 0)
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    ends = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    owner = np.repeat(np.arange(len(triangles)), 3)
    order = np.lexsort(ends.T)
    ends, owner = ends[order], owner[order]
    first = np.flatnonzero((ends[1:] == ends[:-1]).all(axis=1))
    one, other = owner[first], owner[first + 1]
    smooth = np.einsum("ti,ti->t", normals[one], normals[other]) > _EDGE
    links = coo_array((np.ones(smooth.sum()), (one[smooth], other[smooth])), shape=(len(triangles),) * 2)
    _, group = connected_components(links, directed=False)
    keys, numbers = np.unique(group[:, None].astype(np.int64) * len(place) + triangles, return_inverse=True)
    return keys % len(place), numbers.reshape(-1, 3)
