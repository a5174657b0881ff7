"""Figures of three-dimensional simulations: a section through the tool axis and an oblique view of the surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scenes.colour_scale import choose_colour_scale
from scenes.field_labels import LABELS
from tissue_sim.errors import InputError
from tissue_sim.experiment.tools.tool import Tool
from tissue_sim.fem.result_views import DrawableFields, SolidGeometry
from tissue_sim.mesh.sections import intersect_tetrahedra_at_zero_level, intersect_triangles_at_zero_level
from tissue_sim.pose import Pose

#: Grey of rigid bodies, a colour of matplotlib.
RIGID = "0.72"
#: Line style of the undeformed outline: offset, then lengths of dash and gap, points.
_DASHED = (0, (4, 3))


@dataclass(frozen=True)
class SurfaceViewSettings:
    """Camera and light of the surface picture.

    Attributes:
        azimuth_deg: direction of the camera about z, from +x.
        elevation_deg: angle of the camera above the horizontal plane.
        light: vector from the scene towards the light, of any length.
        shadow_brightness: fraction of a colour that remains on faces turned away from the light; 1 switches shading
            off.
        edge_angle_deg: faces that meet at a larger angle form a sharp edge and are shaded separately.
        on_plane: nodes closer to the cutting plane than this fraction of the size of the mesh lie on the plane.
    """

    azimuth_deg: float = -62.0
    elevation_deg: float = 26.0
    light: tuple[float, float, float] = (0.25, -0.55, 0.8)
    shadow_brightness: float = 0.55
    edge_angle_deg: float = 35.0
    on_plane: float = 1e-9


_VIEW = SurfaceViewSettings()


def draw_section_through_tool_axis(axes, fields: DrawableFields, name: str, sample: int, pose: Pose,
                                   tool: Tool) -> None:
    """Draw the deformed section in the plane through the tool's axis and the x axis.

    The panel also shows the element edges, the undeformed outline (dashed), the base, the tool and the colour bar.

    Args:
        axes: matplotlib axes.
        fields: fields of the simulation.
        name: field of the colours, a key of `LABELS`.
        sample: index of the sample.
        pose: pose of the tool at this sample.
        tool: tool of the experiment.
    """
    from matplotlib.collections import LineCollection
    from matplotlib.tri import Triangulation

    geometry, scale = _require_solid_geometry(fields), choose_colour_scale(fields, name, sample)
    nodes = compute_deformed_nodes_in_scene_frame(fields, sample)
    heights = compute_distance_from_section_plane(nodes, pose)
    crossings, triangles = intersect_tetrahedra_at_zero_level(geometry.list_tetrahedra(), heights)
    points = crossings.interpolate_nodal_values(nodes)
    values = crossings.interpolate_nodal_values(fields.at_nodes(name, sample) * LABELS[name][1])
    # The picture is seen from -y; the reversed order of the corners turns the triangles towards the viewer.
    picture = axes.tripcolor(Triangulation(1e3 * points[:, 0], 1e3 * points[:, 2], triangles[:, ::-1]), values,
                             shading="gouraud", cmap="viridis", vmin=scale.low, vmax=scale.high)
    picture.set_in_layout(False)  # faster: the layout would measure each triangle
    crossings = intersect_triangles_at_zero_level(geometry.list_side_triangles(), heights)
    edges = _project_line_ends_to_xz_mm(crossings.interpolate_nodal_values(nodes))
    axes.add_collection(LineCollection(edges, colors="white", linewidths=0.3, alpha=0.4))
    outside = geometry.surface_triangles
    crossings = intersect_triangles_at_zero_level(outside, heights)
    edges = _project_line_ends_to_xz_mm(crossings.interpolate_nodal_values(nodes))
    axes.add_collection(LineCollection(edges, colors="0.15", linewidths=1.0))
    undeformed = geometry.nodes - [0.0, 0.0, fields.datum]
    outline = intersect_triangles_at_zero_level(outside,
                                                compute_distance_from_section_plane(undeformed, pose)
                                                ).interpolate_nodal_values(undeformed)
    axes.add_collection(LineCollection(_project_line_ends_to_xz_mm(outline), colors="0.4", linewidths=0.9,
                                       linestyles=[_DASHED]))
    low, high = 1e3 * nodes.min(axis=0), 1e3 * np.maximum(nodes.max(axis=0), undeformed.max(axis=0))
    width, plate = 0.59 * np.ptp(1e3 * nodes[:, 0]), 0.04 * (high - low).max()
    middle = 0.5 * (low[0] + high[0])
    axes.fill_between([middle - width, middle + width], low[2], low[2] - plate, color=RIGID, linewidth=0)
    if tool.is_plate:
        height = 1e3 * pose.position[2]
        axes.fill_between([middle - width, middle + width], height, height + plate, color=RIGID, linewidth=0)
    else:
        outline = compute_needle_profile(tool, nodes, pose)
        both = np.concatenate([outline, (outline * [-1.0, 1.0])[::-1]])
        tip, rotation = np.array(pose.position), np.array(pose.rotation_matrix)
        drawn = 1e3 * (tip + np.column_stack([both[:, 0], np.zeros(len(both)), both[:, 1]]) @ rotation.T)
        axes.fill(drawn[:, 0], drawn[:, 2], color=RIGID, edgecolor="0.4", linewidth=0.6)
    set_axis_scales_and_labels(axes, "x [mm]")
    axes.figure.colorbar(picture, ax=axes, label=scale.label, extend=scale.colour_bar_extension, shrink=0.85)


def draw_deformed_surface(axes, fields: DrawableFields, name: str, sample: int, pose: Pose, tool: Tool) -> None:
    """Draw the deformed surface with its element edges, and the tool, in an oblique view from above.

    Arguments and colours are those of `draw_section_through_tool_axis`.
    """
    from matplotlib import colormaps
    from matplotlib.collections import LineCollection

    geometry, scale = _require_solid_geometry(fields), choose_colour_scale(fields, name, sample)
    nodes = compute_deformed_nodes_in_scene_frame(fields, sample)
    points, triangles = _split_vertex_numbers_at_sharp_edges(nodes, geometry.surface_triangles)
    values = fields.at_nodes(name, sample)[points] * LABELS[name][1]
    colour = (values - scale.low) / (scale.high - scale.low) if scale.high > scale.low else np.zeros_like(values)
    bodies = [(nodes[points], triangles, colormaps["viridis"](np.clip(colour, 0.0, 1.0))[:, :3])]
    if not tool.is_plate:
        outline = compute_needle_profile(tool, nodes, pose)
        vertices, faces = make_surface_of_revolution(outline)
        vertices = np.array(pose.position) + vertices @ np.array(pose.rotation_matrix).T
        split, faces = _split_vertex_numbers_at_sharp_edges(vertices, faces)
        bodies.append((vertices[split], faces, np.full((len(split), 3), float(RIGID))))
    _draw_shaded_bodies(axes, bodies)
    # Only edges of element faces that are turned towards the viewer are drawn.
    edges = geometry.face_edges.reshape(-1, 2)
    lines = nodes[edges]
    ends = _sum_vertex_normals(nodes, geometry.surface_triangles, len(nodes))[edges]
    lines = lines[(ends @ _compute_view_direction() > 0.0).all(axis=1)]
    if not tool.is_plate:
        lines = lines[~_find_hidden_point_mask(lines.mean(axis=1), *bodies[1][:2])]
    thickness = min(0.4, 8.0 / np.sqrt(len(lines) + 1))
    axes.add_collection(LineCollection(list(1e3 * _rotate_to_camera_axes(lines)[..., :2]), colors="white",
                                       linewidths=thickness, alpha=0.55))
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.set_axis_off()
    axes.set_title("surface from above", loc="left", fontsize=10)


def compute_deformed_nodes_in_scene_frame(fields: DrawableFields, sample: int) -> np.ndarray:
    """Return the deformed coordinates of the nodes in the frame of the scene, m, shape (nodes, 3)."""
    return fields.geometry().nodes + fields.displacement(sample) - [0.0, 0.0, fields.datum]


def _require_solid_geometry(fields: DrawableFields) -> SolidGeometry:
    geometry = fields.geometry()
    if not isinstance(geometry, SolidGeometry):
        raise InputError("this figure requires fields of a three-dimensional solid", field="fields")
    return geometry


def compute_distance_from_section_plane(points: np.ndarray, pose: Pose) -> np.ndarray:
    """Return the signed distances of points, shape (n, 3), m, from the plane through the tool's axis and the x axis.

    Returns:
        Distances along y, m, shape (n,); exactly 0 for points on the plane up to rounding.
    """
    heights = points[:, 1] - pose.position[1]
    heights[np.abs(heights) < _VIEW.on_plane * np.ptp(points)] = 0.0
    return heights


def choose_drawn_tool_pose(fields: DrawableFields, sample: int, pose: Pose, tool: Tool) -> Pose:
    """Return the pose at which the tool is drawn: the commanded pose, or a pose on the tissue surface above it.

    A compliant load train keeps the tool above its commanded pose; there the tool would be drawn inside the tissue.

    Args:
        fields: fields of the simulation.
        sample: index of the sample.
        pose: commanded pose of the tool.
        tool: tool of the experiment.
    """
    surface, top = compute_deformed_nodes_in_scene_frame(fields, sample), _require_solid_geometry(fields).top
    surface = surface if top is None else surface[top]
    if tool.is_plate:
        return Pose((0.0, 0.0, float(surface[:, 2].max())))
    rotation = np.array(pose.rotation_matrix)
    local = (surface - np.array(pose.position)) @ rotation
    gap = float(tool.profile.gap(np.column_stack([np.hypot(local[:, 0], local[:, 1]), local[:, 2]])).min())
    if gap > -1e-3 * tool.require_radius():
        return pose
    x, y, z = np.array(pose.position) - gap * rotation[:, 2]
    return Pose((float(x), float(y), float(z)), pose.orientation)


def compute_needle_profile(tool: Tool, nodes: np.ndarray, pose: Pose) -> np.ndarray:
    """Return the profile of a needle from its tip to the axis above the tissue.

    Args:
        tool: tool of the experiment.
        nodes: deformed nodes of the tissue, m, shape (nodes, 3); the profile ends above them.
        pose: pose of the tool.

    Returns:
        Points (r, z) relative to the tip, m, shape (n, 2).
    """
    top = nodes[:, 2].max() - pose.position[2] + 0.35 * np.ptp(nodes[:, 2])
    outline = tool.profile.sample_outline_up_to_height(top / max(pose.rotation_matrix[2][2], 0.2))
    return np.concatenate([outline, [[0.0, outline[-1, 1]]]])


def make_surface_of_revolution(outline: np.ndarray, segments: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """Return the surface of revolution of a profile.

    Args:
        outline: points (r, z) of the profile from the axis at the bottom to the axis at the top, shape (n, 2).
        segments: number of vertices around the axis.

    Returns:
        Vertices, shape (n segments, 3), and triangles with outward normals, shape (2 (n - 1) segments, 3).
    """
    angles = np.linspace(0.0, 2.0 * np.pi, segments, endpoint=False)
    ring = np.column_stack([np.cos(angles), np.sin(angles)])
    vertices = np.concatenate([np.column_stack([r * ring, np.full(segments, z)]) for r, z in outline])
    column = np.arange(segments)
    following = (column + 1) % segments
    faces = []
    for k in range(len(outline) - 1):
        low, high = segments * k, segments * (k + 1)
        faces += [np.column_stack([low + column, low + following, high + following]),
                  np.column_stack([low + column, high + following, high + column])]
    return vertices, np.concatenate(faces)


def set_axis_scales_and_labels(axes, across: str) -> None:
    """Set equal scales and the axis labels: `across` on the horizontal axis, z on the vertical axis."""
    axes.set_aspect("equal")
    axes.set_xlabel(across)
    axes.set_ylabel("z [mm]")
    axes.spines[["top", "right"]].set_visible(False)


def _project_line_ends_to_xz_mm(points: np.ndarray) -> list[np.ndarray]:
    """Project end points (x, y, z) of k lines, m, shape (2 k, 3), to k arrays of (x, z), mm, shape (2, 2)."""
    return list(1e3 * points[:, [0, 2]].reshape(-1, 2, 2))


def _compute_view_direction() -> np.ndarray:
    """Return the unit vector from the scene towards the camera."""
    azimuth, elevation = np.radians([_VIEW.azimuth_deg, _VIEW.elevation_deg])
    return np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])


def _rotate_to_camera_axes(points: np.ndarray) -> np.ndarray:
    """Rotate points, shape (..., 3), into the axes of the picture: right, up and towards the camera.

    The origin stays the same.
    """
    direction, azimuth = _compute_view_direction(), np.radians(_VIEW.azimuth_deg)
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    return points @ np.stack([right, np.cross(direction, right), direction]).T


def _draw_shaded_bodies(axes, bodies: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> None:
    """Draw shaded bodies with the painter's algorithm: the triangle farthest from the camera first.

    Args:
        axes: matplotlib axes.
        bodies: vertices, m, shape (n, 3), triangles, shape (t, 3), and colours of the vertices, shape (n, 3), of each
            body.
    """
    from matplotlib.collections import TriMesh
    from matplotlib.tri import Triangulation

    light = np.array(_VIEW.light) / np.linalg.norm(_VIEW.light)
    positions, triangles, colours, offset = [], [], [], 0
    for vertices, faces, colour in bodies:
        normals = _sum_vertex_normals(vertices, faces, len(vertices))
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
        shadow = _VIEW.shadow_brightness
        brightness = shadow + (1.0 - shadow) * np.clip(normals @ light, 0.0, 1.0)
        a, b, c = np.moveaxis(vertices[faces], 1, 0)
        faces = faces[np.cross(b - a, c - a) @ _compute_view_direction() > 0.0]
        positions.append(vertices)
        triangles.append(faces + offset)
        colours.append(colour * brightness[:, None])
        offset += len(vertices)
    points, all_triangles = _rotate_to_camera_axes(np.concatenate(positions)), np.concatenate(triangles)
    order = np.argsort(points[all_triangles, 2].mean(axis=1))
    x, y = 1e3 * points[:, 0], 1e3 * points[:, 1]
    mesh = TriMesh(Triangulation(x, y, all_triangles[order]))
    mesh.set_facecolor([(red, green, blue, 1.0) for red, green, blue in np.concatenate(colours).tolist()])
    mesh.set_in_layout(False)  # faster: the layout would measure each triangle
    axes.add_collection(mesh)
    axes.update_datalim(np.column_stack([x, y]))


def _find_hidden_point_mask(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return for each point, shape (n, 3), whether a triangle lies between it and the camera, bool, shape (n,)."""
    seen, corners = _rotate_to_camera_axes(points), _rotate_to_camera_axes(vertices)[faces]
    hidden = np.zeros(len(points), dtype=bool)
    for a, b, c in corners:
        doubled_area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if doubled_area <= 0.0:
            continue
        # Barycentric coordinates of the points in the projected triangle.
        u = ((seen[:, 0] - a[0]) * (c[1] - a[1]) - (seen[:, 1] - a[1]) * (c[0] - a[0])) / doubled_area
        v = ((b[0] - a[0]) * (seen[:, 1] - a[1]) - (b[1] - a[1]) * (seen[:, 0] - a[0])) / doubled_area
        inside = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0)
        hidden |= inside & (a[2] + u * (b[2] - a[2]) + v * (c[2] - a[2]) > seen[:, 2])
    return hidden


def _sum_vertex_normals(vertices: np.ndarray, faces: np.ndarray, count: int) -> np.ndarray:
    """Return the sum of the triangle normals, weighted by area, at each of `count` vertices, shape (count, 3)."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    normals = np.repeat(np.cross(b - a, c - a), 3, axis=0)
    return np.column_stack([np.bincount(faces.ravel(), normals[:, axis], count) for axis in range(3)])


def _split_vertex_numbers_at_sharp_edges(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Duplicate the vertices along sharp edges, so that smooth shading stops there.

    Connected components of triangles that meet at less than `SurfaceViewSettings.edge_angle_deg` share vertices.

    Args:
        vertices: coordinates, shape (n, 3).
        triangles: vertex numbers, shape (t, 3).

    Returns:
        Old number of each new vertex, shape (m,), and the triangles in new numbers, shape (t, 3).
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    ends = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    owner = np.repeat(np.arange(len(triangles)), 3)
    order = np.lexsort(ends.T)
    ends, owner = ends[order], owner[order]
    first = np.flatnonzero((ends[1:] == ends[:-1]).all(axis=1))
    one, other = owner[first], owner[first + 1]
    smooth = np.einsum("ti,ti->t", normals[one], normals[other]) > np.cos(np.radians(_VIEW.edge_angle_deg))
    links = coo_array((np.ones(smooth.sum()), (one[smooth], other[smooth])), shape=(len(triangles),) * 2)
    _, group = connected_components(links, directed=False)
    keys, numbers = np.unique(group[:, None].astype(np.int64) * len(vertices) + triangles, return_inverse=True)
    return keys % len(vertices), numbers.reshape(-1, 3)
