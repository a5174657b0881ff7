"""3D picture of the page: the specimen coloured by a field, the tool, the force arrow and the contact lines.

A property assignment of viser costs 50 us per array, because viser rebuilds type hints, compares the array with the
previous one and copies it twice; a position costs the same, because it is compared with tolerances. A frame has twenty
new arrays and three new positions, so this module puts them directly into the message queue that the setters use. The
queue is a private part of the viser version that pyproject.toml pins; the browser tests check its behaviour by
reloading the page.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import viser
from viser import _messages

from scenes.field_labels import LABELS
from scenes.viewer.bands import (
    PALETTE,
    compute_displayed_srgb,
    compute_field_quantile_range,
    find_surface_srgb,
    keep_or_choose_band_levels,
)
from scenes.viewer.frame import SessionFrame
from scenes.viewer.page.readouts import Reply, make_browser_reply_function
from scenes.viewer.revolution import TriangulatedSurface, WedgeOpening
from scenes.viewer.scene import Scene
from scenes.viewer.solid_body import Wedge
from scenes.viewer.tool_picture import (
    DrawableTissue,
    compute_arrow_foot_above_tool_tip,
    make_base_plate,
    make_drawable_body,
    make_drawn_tool_surface,
    make_force_arrow_or_none,
    make_scale_bar_lines_and_length,
    rotate_force_arrow,
)
from tissue_sim.fem.axisymmetric.discretisation import build_mesh
from tissue_sim.fem.axisymmetric.fields import build_half_section
from tissue_sim.fem.result_views import DrawableFields, TissueGeometry
from tissue_sim.fem.solid.discretisation import build_mesh as build_solid_mesh
from tissue_sim.fem.solid.fields import build_solid_geometry
from tissue_sim.pose import Pose
from tissue_sim.snapshot import Snapshot


def send_scene_node_arrays(handle: viser.SceneNodeHandle, **arrays: np.ndarray) -> None:
    """Replace arrays of a node in all browsers, including those that connect later.

    Args:
        handle: Handle of the node. Its properties do not change: they return the arrays that were assigned last.
        arrays: Property name -> array in the type of the property. The caller must not modify the arrays afterwards.
    """
    handle._impl.api._queue_scene_message(_messages.SceneNodeUpdateMessage(handle.name, arrays))


def send_scene_node_position(handle: viser.SceneNodeHandle, position: tuple[float, float, float]) -> None:
    """Move a node in all browsers, including those that connect later; do nothing if the position is unchanged.

    Args:
        handle: Handle of the node.
        position: Position (x, y, z) relative to the parent node, browser units.
    """
    known = handle._impl.position
    if tuple(known) != position:
        known[:] = position
        handle._impl.api._queue_scene_message(_messages.SetPositionMessage(handle.name, position))


@dataclass(frozen=True)
class PictureOptions:
    """Display options of the picture.

    Attributes:
        field: Displayed field, a key of `scenes.field_labels.LABELS`.
        cut: Angle of the removed wedge, degrees.
        turn: Rotation of the wedge about the tool's axis, degrees; 0 opens the wedge towards -y.
        ahead: Distance of the edge of the wedge from the tool's axis towards the opening, for a solid in 3D, mm.
        mesh_lines: Whether to draw the element edges.
        outline: Whether to draw the outline of the undeformed specimen.
        hold: Whether to keep the present colour levels.
    """

    field: str = "von_mises"
    cut: float = 120.0
    turn: float = 0.0
    ahead: float = 0.0
    mesh_lines: bool = False
    outline: bool = True
    hold: bool = False


@dataclass(frozen=True)
class PictureColours:
    """Colours of the parts of the picture, RGB, 0 to 255.

    Attributes:
        tool: Tool.
        base: Base plate.
        arrow: Force arrow.
        contact: Contact lines.
        tissue: Tissue without fields.
        mesh_lines: Element edges.
        outline: Outline of the undeformed specimen.
        scale_bar: Scale bar.
    """

    tool: tuple[int, int, int] = (176, 184, 194)
    base: tuple[int, int, int] = (120, 126, 134)
    arrow: tuple[int, int, int] = (213, 94, 0)
    contact: tuple[int, int, int] = (230, 20, 110)
    tissue: tuple[int, int, int] = (204, 150, 135)
    mesh_lines: tuple[int, int, int] = (255, 255, 255)
    outline: tuple[int, int, int] = (128, 128, 128)
    scale_bar: tuple[int, int, int] = (20, 20, 20)


@dataclass(frozen=True)
class LightSettings:
    """Lights of the picture: an ambient light, and a directional one that comes from the side on which the cut opens.

    Attributes:
        full: Total intensity on a section face, in which the face has exactly its own colour (pi in three.js).
        directional: Intensity of the directional light, which shows the shape of the surfaces.
        horizontal: Horizontal component of the direction towards the directional light.
        vertical: Vertical component of that direction.
    """

    full: float = np.pi
    directional: float = 1.1
    horizontal: float = 0.8
    vertical: float = 0.6


@dataclass(frozen=True)
class PictureResolutionSettings:
    """Resolution of the surfaces and of the force arrow; larger numbers give a finer picture and more data per frame.

    Attributes:
        segments: Segments of the tissue in a full turn about the axis.
        low_graphics_segments: The same for a browser without a graphics card.
        static_segments: The same for parts that are sent once, such as the tool.
        arrow_lengths: Number of different lengths of the force arrow.
        arrow_directions: Number of different values of each lateral component of its direction.
    """

    segments: int = 48
    low_graphics_segments: int = 32
    static_segments: int = 96
    arrow_lengths: int = 60
    arrow_directions: int = 40


#: Colours of the picture.
COLOURS = PictureColours()
#: Lights of the picture.
LIGHTS = LightSettings()
#: Resolution of the picture.
RESOLUTION = PictureResolutionSettings()


#: Longest side of the specimen, browser units; the browser's camera clips nearer and farther objects.
SIZE = 2.0
#: Smallest descent of a mouse ray, as a fraction of its length, with which it is intersected with a horizontal plane.
_MIN_RAY_DESCENT = 0.1
#: Directions in which the mouse drags the tool of a solid in 3D: label on the page -> name.
DRAGS = {"in the view plane": "freely", "along its axis": "depth", "sideways": "sideways"}
#: Mantissas of the full-scale force of the arrow, N, times powers of ten.
_ROUND = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)


class ScenePicture:
    """Scene nodes of the picture; each frame sends only the nodes that have changed.

    Args:
        server: Server of the page.
        scene: First scene, whose specimen sets the scale.
        low_graphics: Use fewer segments, for browsers without a graphics card.

    Attributes:
        levels: Levels between the colour bands, in the unit of the field's label; None before the first picture.
        scale: Browser units per metre.
        colours: RGB of the bands as they appear on the screen.
        drag_way: Direction in which the mouse drags the tool, a key of `DRAGS`.
    """

    def __init__(self, server: viser.ViserServer, scene: Scene, *, low_graphics: bool):
        self._nodes = server.scene
        self._add_lights()
        self.levels: np.ndarray | None = None
        specimen = scene.experiment.specimen
        self.scale = SIZE / max(2.0 * specimen.outer_radius, specimen.height)
        self._segments = RESOLUTION.low_graphics_segments if low_graphics else RESOLUTION.segments
        colours = [find_surface_srgb(colour) for colour in PALETTE]
        self.colours = [compute_displayed_srgb(colour) for colour in colours]
        self._bands = [self._add_hidden_scene_mesh(f"/tissue/band_{k}", colour) for k, colour in enumerate(colours)]
        self._surface = self._add_hidden_scene_mesh("/tissue/surface", COLOURS.tissue)
        #: Frames of the tool, of the force arrow, and of the base, on which the specimen stands.
        self._tool_frame, self._force_frame, self._ground = (self._nodes.add_frame(name, show_axes=False)
                                                             for name in ("/tool", "/force", "/ground"))
        self._tool = self._add_hidden_scene_mesh("/tool/body", COLOURS.tool)
        # The arrow has its own frame, because the tool's frame is rotated with the tool.
        self._arrow = self._add_hidden_scene_mesh("/force/arrow", COLOURS.arrow)
        self._base = self._add_hidden_scene_mesh("/ground/base", COLOURS.base)
        self._force_label = self._nodes.add_label("/force/label", "", anchor="bottom-left", visible=False)
        self._mesh_lines = self._add_hidden_scene_lines("/tissue/mesh", COLOURS.mesh_lines, 1.0)
        self._outline = self._add_hidden_scene_lines("/ground/undeformed", COLOURS.outline, 1.5)
        self._contact = self._add_hidden_scene_lines("/contact", COLOURS.contact, 4.0)
        self._scale_bar = self._add_hidden_scene_lines("/ground/scale", COLOURS.scale_bar, 2.5)
        self._scale_length = self._nodes.add_label("/ground/scale_length", "", anchor="top-center")
        #: Pose, material and options of the drawn tissue.
        self._drawn: tuple | None = None
        #: Field arrays, or vertices, of the drawn tissue.
        self._state: tuple[np.ndarray, ...] | None = None
        #: Whether the tool can move sideways.
        self._in_space = False
        #: Length, full scale, direction and experiment of the drawn arrow.
        self._drawn_arrow: tuple | None = None
        #: Experiment and options of the drawn parts that do not move with the tissue.
        self._drawn_static: tuple | None = None
        self._geometry_drawn: object = None
        self._body: DrawableTissue | None = None
        #: Force of an arrow of full length, N.
        self._full_force = 1.0
        #: Pose of the drawn tool.
        self._pose = Pose.at_depth(0.0)
        self.drag_way = next(iter(DRAGS))

    def register_drag_callback(self, aim: Callable[[float, tuple[float, float] | None, Reply | None], None]) -> None:
        """Register the function that moves the tool when a user drags it.

        Args:
            aim: Called with depth and lateral position as `Session.set_hand_target` defines them, and a reply
                function, which is None after the first call of a drag so that a refusal is shown once.
        """
        #: Client -> vector from the tool to the grabbed point, and height of that point, browser units.
        grabbed: dict[int, tuple[np.ndarray, float]] = {}
        awaiting_first_reply: set[int] = set()

        async def move_dragged_tool(event) -> None:  # viser runs coroutines in the order of the events
            client = event.client_id
            if event.phase == "start":
                grabbed[client] = (np.array(event.start_position) - self._tool_frame.position, event.start_position[2])
                awaiting_first_reply.add(client)
            if event.phase == "end":
                grabbed.pop(client, None)
            elif client in grabbed:
                reply = None
                if client in awaiting_first_reply:
                    awaiting_first_reply.discard(client)
                    reply = make_browser_reply_function(event)
                offset, height = grabbed[client]
                end = np.array(event.end_position)
                if self._in_space and DRAGS[self.drag_way] == "sideways":
                    end = _intersect_height_or_keep_point(event.client.camera.position, end, height)
                aim(*self._compute_dragged_depth_and_lateral((end - offset) / self.scale), reply)

        self._tool.on_drag("left")(move_dragged_tool)

    def set_drag_direction(self, mode: str) -> None:
        """Choose the direction in which the mouse drags the tool, a key of `DRAGS`."""
        self.drag_way = mode

    def _compute_dragged_depth_and_lateral(self, tip: np.ndarray) -> tuple[float, tuple[float, float] | None]:
        """Convert the dragged position of the tool's end to the arguments of `Session.set_hand_target`.

        Args:
            tip: Dragged position of the tool's end, m, shape (3,). The drag mode projects it first.

        Returns:
            Depth along the tool's axis, m, and the x and y at which that axis crosses the undeformed surface, m; None
            instead of x and y if the tool cannot move sideways.
        """
        now, axis = np.array(self._pose.position), -np.array(self._pose.rotation_matrix)[:, 2]
        lean = axis[:2] / max(-axis[2], 0.1)
        if self._in_space and DRAGS[self.drag_way] == "sideways":
            tip = np.append(tip[:2], now[2])
        elif not self._in_space or DRAGS[self.drag_way] == "depth":
            tip = now + axis * ((tip - now) @ axis)
        depth = -float(tip[2]) / max(-axis[2], 0.1)
        if not self._in_space:
            return depth, None
        return depth, (float(tip[0] + lean[0] * tip[2]), float(tip[1] + lean[1] * tip[2]))

    def draw_frame(self, frame: SessionFrame, options: PictureOptions) -> bool:
        """Send the parts of the picture that differ from the last frame; return whether anything was sent."""
        snapshot = frame.snapshot
        opening = _make_wedge_opening(options.cut, self._segments, options.turn)
        static = (frame.scene.experiment, options.cut, options.turn, options.ahead, options.outline)
        changed = static != self._drawn_static
        if snapshot is None:
            if changed:
                self._draw_scene_before_first_state(frame.scene, opening, options)
                self._drawn_static = static
            return changed
        fields = snapshot.drawable_fields
        surface, self._in_space = frame.surface, snapshot.is_three_dimensional
        if fields is not None and fields.geometry() is not self._geometry_drawn:
            changed = True
        if changed:
            geometry = _build_undeformed_geometry(frame.scene) if fields is None else fields.geometry()
            body = self._get_cached_drawable_body(geometry)
            self._draw_static_parts(body, frame.scene, opening, options)
            self._drawn_static = static
        to_draw = snapshot.pose, None if fields is None else fields.material, options
        state: tuple[np.ndarray, ...] = ()
        if fields is not None:
            state = fields.arrays()
        elif surface is not None:
            state = (surface.vertices,)
        if changed or to_draw != self._drawn or not _are_arrays_equal(state, self._state):
            if fields is None:
                self._draw_plain_tissue(surface)
            else:
                self._draw_coloured_tissue(fields, snapshot, frame.scene, opening, options)
            self._move_tool_arrow_and_base(snapshot, frame.scene)
            self._drawn, self._state, changed = to_draw, state, True
        return self._update_force_arrow_and_return_changed(_newest_force_vector_or_zero(frame), frame.scene) or changed

    def _draw_coloured_tissue(self, fields: DrawableFields, snapshot: Snapshot, scene: Scene, opening: WedgeOpening,
                              options: PictureOptions) -> None:
        """Draw the tissue in the colours of a field, with contact lines and element edges."""
        body, positions = self._get_cached_drawable_body(fields.geometry()), snapshot.node_positions
        wedge = Wedge(opening, snapshot.pose, 1e-3 * options.ahead)
        _, factor = LABELS[options.field]
        values, at_points, sampled = body.evaluate_field_at_nodes_and_samples(fields, options.field, positions, wedge)
        before = self.levels if self._drawn is not None and options.field == self._drawn[2].field else None
        self.levels = levels = before if before is not None and options.hold else keep_or_choose_band_levels(
            before, *compute_field_quantile_range(at_points * factor, sampled, options.field, factor))
        surfaces = body.compute_band_surfaces(positions, values * factor, levels, wedge)
        for handle, surface in zip(self._bands, surfaces, strict=True):
            self._send_or_hide_scene_mesh(handle, surface)
        _set_scene_node_visibility(self._surface, False)
        contact_lines = body.find_contact_lines_or_none(positions, scene.experiment.tool, wedge)
        self._send_or_hide_scene_lines(self._contact, contact_lines)
        edge_lines = body.compute_element_edge_lines(positions, wedge) if options.mesh_lines else None
        self._send_or_hide_scene_lines(self._mesh_lines, edge_lines)

    def _draw_plain_tissue(self, surface: TriangulatedSurface | None) -> None:
        """Draw the surface of tissue without fields in one colour; hide the tissue if it has no surface."""
        for handle in (*self._bands, self._contact, self._mesh_lines):
            _set_scene_node_visibility(handle, False)
        self._send_or_hide_scene_mesh(self._surface, surface)

    def _move_tool_arrow_and_base(self, snapshot: Snapshot, scene: Scene) -> None:
        """Move the tool to its pose, the force arrow above the tool, and the base under the specimen."""
        self._pose = pose = snapshot.pose
        x, y, z = pose.position
        send_scene_node_position(self._tool_frame, (self.scale * x, self.scale * y, self.scale * z))
        foot = compute_arrow_foot_above_tool_tip(scene.experiment.tool, scene.experiment.specimen)
        (_, _, u), (_, _, v), (_, _, w) = pose.rotation_matrix
        send_scene_node_position(self._force_frame, (self.scale * (x + u * foot), self.scale * (y + v * foot),
                                                     self.scale * (z + (w - 1.0) * foot)))
        if not np.array_equal(self._tool_frame.wxyz, pose.orientation):
            self._tool_frame.wxyz = pose.orientation
        # `datum` is the height of the first touch, which lies lower if the specimen has sagged under its own weight.
        if self._ground.position[2] != -snapshot.datum * self.scale:
            self._ground.position = (0.0, 0.0, -snapshot.datum * self.scale)

    def _get_cached_drawable_body(self, geometry: TissueGeometry) -> DrawableTissue:
        """Return the drawable body of a geometry, and keep it until the geometry changes."""
        if self._body is None or self._geometry_drawn is not geometry:
            self._body, self._geometry_drawn, self._drawn = make_drawable_body(geometry), geometry, None
        return self._body

    def _draw_scene_before_first_state(self, scene: Scene, opening: WedgeOpening, options: PictureOptions) -> None:
        """Draw the undeformed specimen while the simulation starts."""
        geometry = _build_undeformed_geometry(scene)
        body, nodes = self._get_cached_drawable_body(geometry), geometry.nodes
        wedge = Wedge(opening, Pose.at_depth(0.0))
        surfaces = body.compute_band_surfaces(nodes, np.zeros(len(nodes)), np.arange(len(self._bands) + 1.0), wedge)
        for handle, surface in zip(self._bands, surfaces, strict=True):
            self._send_or_hide_scene_mesh(handle, surface)
        for hidden in (self._surface, self._contact, self._mesh_lines, self._arrow, self._force_label):
            _set_scene_node_visibility(hidden, False)
        self._drawn_arrow = None
        self._move_tool_arrow_and_base(Snapshot(scene.experiment.tool_pose(0.0), 0.0, None), scene)
        self._draw_static_parts(body, scene, opening, options)

    def _draw_static_parts(self, body: DrawableTissue, scene: Scene, opening: WedgeOpening,
                           options: PictureOptions) -> None:
        """Draw the parts that do not move with the tissue: light, tool shape, base, outline and scale bar."""
        specimen, tool = scene.experiment.specimen, scene.experiment.tool
        light = np.array([LIGHTS.horizontal * np.cos(opening.facing), LIGHTS.horizontal * np.sin(opening.facing),
                          LIGHTS.vertical])
        if tuple(self._directional_light.position) != tuple(light):
            self._directional_light.position = tuple(light)
        if opening.section_face_vectors:
            # Ambient and directional light on a section face add up to `full`: the face has the colours of the bar.
            incidence = max(0.0, float(light[:2] @ opening.section_face_vectors[0][1]))
            self._ambient_light.intensity = LIGHTS.full - LIGHTS.directional * incidence
        # A wedge that is moved away from the tool's axis does not cut the tool.
        cut, segments = 0.0 if self._in_space and options.ahead else options.cut, RESOLUTION.static_segments
        tool_opening = _make_wedge_opening(cut, segments, options.turn)
        self._send_or_hide_scene_mesh(self._tool, make_drawn_tool_surface(tool, specimen, tool_opening))
        self._send_or_hide_scene_mesh(self._base, make_base_plate(specimen, _make_wedge_opening(0.0, segments)))
        covered = specimen.outer_radius if tool.is_plate else tool.radius or 0.0
        wedge, tool_extent = Wedge(opening, Pose.at_depth(0.0)), (covered, scene.max_tool_displacement)
        outline = body.make_undeformed_outline(wedge, tool_extent) if options.outline else None
        self._send_or_hide_scene_lines(self._outline, outline)
        bar, length = make_scale_bar_lines_and_length(specimen)
        self._send_or_hide_scene_lines(self._scale_bar, bar)
        self._scale_length.text = f"{1e3 * length:g} mm"
        self._scale_length.position = tuple(self.scale * bar[0].mean(axis=0))

    def _update_force_arrow_and_return_changed(self, force: np.ndarray, scene: Scene) -> bool:
        """Draw the arrow and the label of a force (x, y, z), N, shape (3,); return whether either has changed."""
        magnitude = float(np.linalg.norm(force))
        while magnitude > self._full_force:
            self._full_force = _next_arrow_full_scale(self._full_force)
        signed = magnitude if force[2] >= 0.0 else -magnitude
        directions = RESOLUTION.arrow_directions
        lateral = tuple((np.round(force[:2] / max(magnitude, 1e-300) * directions) / directions).tolist())
        text = f"{round(signed, 2) + 0.0:.2f} N"
        # Length and direction are rounded to invisible steps, so that most frames do not send a new arrow.
        full, lengths = self._full_force, RESOLUTION.arrow_lengths
        to_draw = (round(signed / full * lengths), full, lateral, scene.experiment)
        if text == self._force_label.text and to_draw == self._drawn_arrow:
            return False
        self._force_label.text = text
        if to_draw != self._drawn_arrow:
            self._drawn_arrow = to_draw
            arrow = make_force_arrow_or_none(to_draw[0] / lengths * full, full, scene.experiment.tool,
                                             scene.experiment.specimen)
            _set_scene_node_visibility(self._force_label, arrow is not None)
            if arrow is not None and any(lateral):
                arrow = rotate_force_arrow(arrow, lateral)
            self._send_or_hide_scene_mesh(self._arrow, None if arrow is None else arrow.surface)
            if arrow is not None:
                x, y, z = (max(arrow.start, arrow.tip, key=lambda end: end[2]) * self.scale).tolist()
                send_scene_node_position(self._force_label, (x, y, z))
        return True

    def _add_hidden_scene_mesh(self, name: str, colour: tuple[int, int, int]) -> viser.MeshHandle:
        empty = np.zeros((3, 3), np.float32)
        return self._nodes.add_mesh_simple(name, empty, np.array([[0, 1, 2]], np.uint32), color=colour, side="double",
                                           cast_shadow=False, receive_shadow=False, visible=False, scale=self.scale)

    def _add_hidden_scene_lines(self, name: str, colour: tuple[int, int, int],
                                pixels: float) -> viser.LineSegmentsHandle:
        return self._nodes.add_line_segments(name, np.zeros((1, 2, 3), np.float32), colour, thickness=pixels,
                                             thickness_units="screen", visible=False, scale=self.scale)

    def _send_or_hide_scene_mesh(self, handle: viser.MeshHandle, surface: TriangulatedSurface | None) -> None:
        """Send the triangles of a surface; hide the node if there are none."""
        if surface is None or not len(surface.faces):
            _set_scene_node_visibility(handle, False)
            return
        send_scene_node_arrays(handle, vertices=surface.vertices, faces=surface.faces)
        _set_scene_node_visibility(handle, True)

    def _send_or_hide_scene_lines(self, handle: viser.LineSegmentsHandle, lines: np.ndarray | None) -> None:
        """Send lines, shape (lines, 2, 3); hide the node if there are none."""
        has_lines = lines is not None and len(lines) > 0
        if has_lines:
            send_scene_node_arrays(handle, points=np.ascontiguousarray(lines, np.float32))
        _set_scene_node_visibility(handle, has_lines)

    def _add_lights(self) -> None:
        nodes = self._nodes
        nodes.configure_environment_map(hdri=None)
        nodes.configure_default_lights(enabled=False)
        self._ambient_light = nodes.add_light_ambient("/light/ambient", intensity=LIGHTS.full)
        self._directional_light = nodes.add_light_directional(
            "/light/key", intensity=LIGHTS.directional, position=(0.0, -LIGHTS.horizontal, LIGHTS.vertical))


@lru_cache(maxsize=8)
def _make_wedge_opening(degrees: float, segments: int, turn: float = 0.0) -> WedgeOpening:
    """Return the cached opening for an angle and a rotation, both in degrees; rotation 0 opens it towards -y."""
    return WedgeOpening(np.radians(degrees), np.radians(turn - 90.0), segments=segments)


def _are_arrays_equal(arrays: tuple[np.ndarray, ...], others: tuple[np.ndarray, ...] | None) -> bool:
    return others is not None and len(arrays) == len(others) and all(map(np.array_equal, arrays, others))


def _intersect_height_or_keep_point(camera: np.ndarray, point: np.ndarray, height: float) -> np.ndarray:
    """Intersect the ray from a camera through a point with a horizontal plane.

    Args:
        camera: Position of the camera, shape (3,).
        point: Point on the ray, shape (3,).
        height: z of the plane.

    Returns:
        The intersection; `point` itself if the ray is nearly horizontal or leads away from the plane.
    """
    ray = point - camera
    descent = height - float(camera[2])
    if abs(ray[2]) < _MIN_RAY_DESCENT * np.linalg.norm(ray) or descent * ray[2] <= 0.0:
        return point
    return camera + descent / ray[2] * ray


def _newest_force_vector_or_zero(frame: SessionFrame) -> np.ndarray:
    """Return the newest force of the tissue on the tool (x, y, z), N, shape (3,); zero before the first tick."""
    now = frame.readouts
    return np.zeros(3) if now is None else np.array([*now.across, now.force])


def _build_undeformed_geometry(scene: Scene) -> TissueGeometry:
    """Return the geometry of the undeformed specimen: a half section for a cylinder, otherwise a solid in 3D."""
    if scene.reduced is not None:
        return build_solid_geometry(scene.reduced.mesh)
    if scene.experiment.specimen.is_round:
        return build_half_section(build_mesh(scene.experiment, "realtime", layers=scene.material.layers))
    return build_solid_geometry(build_solid_mesh(scene.experiment, "realtime", scene.material.layers))


def _set_scene_node_visibility(handle: viser.SceneNodeHandle, visible: bool) -> None:
    """Assign the visibility only if it changes, because each assignment sends a message."""
    if handle.visible != visible:
        handle.visible = visible


def _next_arrow_full_scale(number: float) -> float:
    """Return the smallest element of `_ROUND` times a power of ten that is larger than a number."""
    decade = 10.0 ** np.floor(np.log10(number) + 1e-9)
    return next(float(step * decade) for step in (*_ROUND, 10.0) if step * decade > number * (1 + 1e-9))
