"""The 3D picture: the specimen in iso-bands, the tool, its force, where they touch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import viser

from scenes.field_labels import LABELS
from scenes.viewer.bodies import Body, body_of, drawable
from scenes.viewer.colours import PALETTE, field_range, steady_levels
from scenes.viewer.frame import Frame
from scenes.viewer.page.notices import Reply, answer_to
from scenes.viewer.page.scene_updates import send_arrays, send_position
from scenes.viewer.revolution import Opening, Surface
from scenes.viewer.scene import Scene
from scenes.viewer.tone import seen_colour, surface_colour
from scenes.viewer.tool_picture import (
    arrow_foot,
    base_plate,
    force_arrow,
    scale_bar,
    tool_mesh,
    turned_arrow,
)
from scenes.viewer.wedge import Wedge
from tissue_sim.fem.axisymmetric.discretisation import build_mesh
from tissue_sim.fem.solid.discretisation import build_mesh as build_solid_mesh
from tissue_sim.mesh import Mesh
from tissue_sim.mesh.solid import SolidMesh
from tissue_sim.pose import Pose
from tissue_sim.snapshot import Snapshot

#: Longest side of the specimen in the unit of the browser, whose camera has near and far planes.
SIZE = 2.0
#: RGB.
METAL, BASE, ARROW, CONTACT = (176, 184, 194), (120, 126, 134), (213, 94, 0), (230, 20, 110)
#: Of tissue without fields.
TISSUE = (204, 150, 135)
MESH_LINES, OUTLINE, SCALE_BAR = (255, 255, 255), (128, 128, 128), (20, 20, 20)
#: Light from all sides in which a surface has its own colour, and a light that shows its shape, from where the cut
#: opens: it falls on both section faces alike.
_FULL, _KEY, _KEY_ACROSS, _KEY_UP = np.pi, 1.1, 0.8, 0.6
#: Segments of a whole turn of the tissue, for a browser without a graphics card, and of what is sent once only.
FINE, COARSE, STILL = 48, 32, 96
#: Steps in the length of the arrow.
_ARROW_STEPS = 60
#: Steps in what of its direction lies across the axis.
_ARROW_TURNS = 40
#: A ray that falls less than this share of its length meets no height that a mouse could mean.
_LEAST_FALL = 0.1
#: How a mouse moves the tool of a solid in space, in words for people.
DRAGS = {"in the picture's plane": "freely", "along its axis": "depth", "sideways": "sideways"}
#: Forces that an arrow of full length stands for, times powers of ten.
_ROUND = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)


@dataclass(frozen=True)
class Look:
    """How the specimen is shown.

    Attributes:
        field: a name in `scenes.field_labels.LABELS`.
        cut: angle of the wedge that is left out, degrees.
        turn: of that wedge about the tool's axis from where it opens towards -y, degrees.
        ahead: of a solid in space, how far the wedge begins from that axis, to where it opens, mm.
        mesh_lines, outline: whether to show the element edges, and the undeformed specimen.
        hold: keep the colours' levels as they are.
    """

    field: str = "von_mises"
    cut: float = 120.0
    turn: float = 0.0
    ahead: float = 0.0
    mesh_lines: bool = False
    outline: bool = True
    hold: bool = False


class Solid:
    """The scene nodes and what they show; writes what has changed and nothing else.

    Attributes:
        levels: of the colours, in the unit of the label; None before the first picture.
        scale: units of the browser in a metre.
    """

    def __init__(self, server: viser.ViserServer, scene: Scene, *, low_graphics: bool):
        self._nodes = server.scene
        self._light()
        self.levels: np.ndarray | None = None
        specimen = scene.experiment.specimen
        self.scale = SIZE / max(2.0 * specimen.outer_radius, specimen.height)
        self._segments_of_turn = COARSE if low_graphics else FINE
        surface_colours = [surface_colour(colour) for colour in PALETTE]
        #: As they are seen, for the colour bar.
        self.colours = [seen_colour(colour) for colour in surface_colours]
        self._bands = [self._mesh(f"/tissue/band_{k}", colour) for k, colour in enumerate(surface_colours)]
        self._surface = self._mesh("/tissue/surface", TISSUE)
        #: Of the tool, and of what the specimen stood on before it sagged.
        self._tool_frame, self._force_frame, self._ground = (self._nodes.add_frame(name, show_axes=False)
                                                             for name in ("/tool", "/force", "/ground"))
        self._tool = self._mesh("/tool/body", METAL)
        # Along z wherever the tool is turned to.
        self._arrow = self._mesh("/force/arrow", ARROW)
        self._base = self._mesh("/ground/base", BASE)
        self._force = self._nodes.add_label("/force/label", "", anchor="bottom-left", visible=False)
        self._mesh_lines = self._segments("/tissue/mesh", MESH_LINES, 1.0)
        self._outline = self._segments("/ground/undeformed", OUTLINE, 1.5)
        self._contact = self._segments("/contact", CONTACT, 4.0)
        self._scale_bar = self._segments("/ground/scale", SCALE_BAR, 2.5)
        self._scale_length = self._nodes.add_label("/ground/scale_length", "", anchor="top-center")
        #: Pose, material and look of the picture; its states, or vertices; what stands; length of the arrow in
        #: `_ARROW_STEPS`.
        self._drawn: tuple | None = None
        self._state: tuple[np.ndarray, ...] | None = None
        #: Whether the tool may go aside.
        self._in_space = False
        self._pushed: tuple | None = None
        self._standing: tuple | None = None
        self._mesh_drawn: object = None
        self._body: Body | None = None
        self._full_force = 1.0
        #: Of the tool in the picture, and how a mouse moves it: a key of `DRAGS`.
        self._pose, self.drag_way = Pose.at_depth(0.0), next(iter(DRAGS))

    def on_drag(self, aim: Callable[[float, tuple[float, float] | None, Reply | None], None]) -> None:
        """Call `aim` with the place to which somebody drags the tool, as `Session.aim` takes it; once a drag with whom
        to tell why not."""
        #: Of each browser: from the tool to where it was grabbed, and how high that was.
        grabbed: dict[int, tuple[np.ndarray, float]] = {}
        untold: set[int] = set()

        async def drag(event) -> None:  # a coroutine: its phases come in order
            client = event.client_id
            if event.phase == "start":
                grabbed[client] = (np.array(event.start_position) - self._tool_frame.position, event.start_position[2])
                untold.add(client)
            if event.phase == "end":
                grabbed.pop(client, None)
            elif client in grabbed:
                reply = None
                if client in untold:
                    untold.discard(client)
                    reply = answer_to(event)
                held, height = grabbed[client]
                end = np.array(event.end_position)
                if self._in_space and DRAGS[self.drag_way] == "sideways":
                    end = _at_height(event.client.camera.position, end, height)
                aim(*self._aimed((end - held) / self.scale), reply)

        self._tool.on_drag("left")(drag)

    def drag_by(self, way: str) -> None:
        """Let a mouse move the tool so: a key of `DRAGS`."""
        self.drag_way = way

    def _aimed(self, tip: np.ndarray) -> tuple[float, tuple[float, float] | None]:
        """Depth along the tool's axis, and where that axis meets the height of the touch, of a tool whose end is drawn
        here, m; what the way of dragging leaves as it is stays."""
        now, axis = np.array(self._pose.position), -np.array(self._pose.rotation)[:, 2]
        lean = axis[:2] / max(-axis[2], 0.1)
        if self._in_space and DRAGS[self.drag_way] == "sideways":
            tip = np.append(tip[:2], now[2])
        elif not self._in_space or DRAGS[self.drag_way] == "depth":
            tip = now + axis * ((tip - now) @ axis)
        depth = -float(tip[2]) / max(-axis[2], 0.1)
        if not self._in_space:
            return depth, None
        return depth, (float(tip[0] + lean[0] * tip[2]), float(tip[1] + lean[1] * tip[2]))

    def show(self, frame: Frame, look: Look) -> bool:
        """Write what has changed since the last time; whether anything has."""
        snapshot = frame.snapshot
        opening = _opening(look.cut, self._segments_of_turn, look.turn)
        stands = (frame.scene.experiment, look.cut, look.turn, look.ahead, look.outline)
        changed = stands != self._standing
        if snapshot is None:
            if changed:
                self._wait(frame.scene, opening, look)
                self._standing = stands
            return changed
        # Other solvers' fields may have nothing that could be drawn.
        fields: Any = snapshot.fields if drawable(snapshot.fields) else None
        surface, self._in_space = frame.surface, snapshot.in_space
        if fields is not None and fields.mesh is not self._mesh_drawn:
            changed = True
        if changed:
            body = self._take_mesh(_undeformed(frame.scene) if fields is None else fields.mesh)
            self._stand(body, frame.scene, opening, look)
            self._standing = stands
        seen = snapshot.pose, None if fields is None else fields.material, look
        state: tuple[np.ndarray, ...] = ()
        if fields is not None:
            state = fields.arrays()
        elif surface is not None:
            state = (surface.vertices,)
        if changed or seen != self._drawn or not _same(state, self._state):
            if fields is None:
                self._draw_surface(surface)
            else:
                self._draw(fields, snapshot, frame.scene, opening, look)
            self._place(snapshot, frame.scene)
            self._drawn, self._state, changed = seen, state, True
        return self._push(_force(frame), frame.scene) or changed

    def _draw(self, fields: Any, snapshot: Snapshot, scene: Scene, opening: Opening, look: Look) -> None:
        body, place = self._take_mesh(fields.mesh), snapshot.place
        wedge = Wedge(opening, snapshot.pose, 1e-3 * look.ahead)
        _, factor = LABELS[look.field]
        values, at_points, seen = body.values(fields, look.field, place, wedge)
        before = self.levels if self._drawn is not None and look.field == self._drawn[2].field else None
        self.levels = levels = before if before is not None and look.hold else steady_levels(
            before, *field_range(at_points * factor, seen, look.field, factor))
        for handle, surface in zip(self._bands, body.bands(place, values * factor, levels, wedge), strict=True):
            self._fill(handle, surface)
        _show(self._surface, False)
        self._lines(self._contact, body.contact_lines(place, scene.experiment.tool, wedge))
        self._lines(self._mesh_lines, body.mesh_lines(place, wedge) if look.mesh_lines else None)

    def _draw_surface(self, surface: Surface | None) -> None:
        """Tissue of a solver that has no section to draw, in one colour; where it has no triangles, no tissue."""
        for handle in (*self._bands, self._contact, self._mesh_lines):
            _show(handle, False)
        self._fill(self._surface, surface)

    def _place(self, snapshot: Snapshot, scene: Scene) -> None:
        """The tool at its pose, the force over it, and the ground where the specimen stands."""
        self._pose = pose = snapshot.pose
        x, y, z = pose.position
        send_position(self._tool_frame, (self.scale * x, self.scale * y, self.scale * z))
        foot = arrow_foot(scene.experiment.tool, scene.experiment.specimen)
        (_, _, u), (_, _, v), (_, _, w) = pose.rotation
        send_position(self._force_frame, (self.scale * (x + u * foot), self.scale * (y + v * foot),
                                          self.scale * (z + (w - 1.0) * foot)))
        if not np.array_equal(self._tool_frame.wxyz, pose.orientation):
            self._tool_frame.wxyz = pose.orientation
        # Where a specimen has sagged under its own weight, the tool touches it lower.
        if self._ground.position[2] != -snapshot.datum * self.scale:
            self._ground.position = (0.0, 0.0, -snapshot.datum * self.scale)

    def _take_mesh(self, mesh: Any) -> Body:
        if self._body is None or self._mesh_drawn is not mesh:
            self._body, self._mesh_drawn, self._drawn = body_of(mesh), mesh, None
        return self._body

    def _wait(self, scene: Scene, opening: Opening, look: Look) -> None:
        """The undeformed specimen, while its simulation starts."""
        mesh = _undeformed(scene)
        body, place = self._take_mesh(mesh), mesh.nodes
        waits = Wedge(opening, Pose.at_depth(0.0))
        surfaces = body.bands(place, np.zeros(len(place)), np.arange(len(self._bands) + 1.0), waits)
        for handle, surface in zip(self._bands, surfaces, strict=True):
            self._fill(handle, surface)
        for hidden in (self._surface, self._contact, self._mesh_lines, self._arrow, self._force):
            _show(hidden, False)
        self._pushed = None
        self._place(Snapshot(scene.experiment.tool_pose(0.0), 0.0, None), scene)
        self._stand(body, scene, opening, look)

    def _stand(self, body: Body, scene: Scene, opening: Opening, look: Look) -> None:
        """What does not move with the tissue."""
        specimen, tool = scene.experiment.specimen, scene.experiment.tool
        # From where the cut opens.
        light = np.array([_KEY_ACROSS * np.cos(opening.facing), _KEY_ACROSS * np.sin(opening.facing), _KEY_UP])
        if tuple(self._key.position) != tuple(light):
            self._key.position = tuple(light)
        if opening.faces:
            # The section faces get the light in which a surface has just its own colour, that of the bar.
            faces_it = max(0.0, float(light[:2] @ opening.faces[0][1]))
            self._ambient.intensity = _FULL - _KEY * faces_it
        # A cut that does not go through its axis leaves it whole.
        cut = 0.0 if self._in_space and look.ahead else look.cut
        self._fill(self._tool, tool_mesh(tool, specimen, _opening(cut, STILL, look.turn)))
        self._fill(self._base, base_plate(specimen, _opening(0.0, STILL)))
        covered = specimen.outer_radius if tool.is_plate else tool.radius or 0.0
        wedge = Wedge(opening, Pose.at_depth(0.0))
        self._lines(self._outline, body.outline(wedge, (covered, scene.deepest)) if look.outline else None)
        bar, length = scale_bar(specimen)
        self._lines(self._scale_bar, bar)
        self._scale_length.text = f"{1e3 * length:g} mm"
        self._scale_length.position = tuple(self.scale * bar[0].mean(axis=0))

    def _push(self, force: np.ndarray, scene: Scene) -> bool:
        """The arrow of the force (x, y, z), N; whether it has changed."""
        size = float(np.linalg.norm(force))
        while size > self._full_force:
            self._full_force = _next_round(self._full_force)
        signed = size if force[2] >= 0.0 else -size
        aside = tuple((np.round(force[:2] / max(size, 1e-300) * _ARROW_TURNS) / _ARROW_TURNS).tolist())
        text = f"{round(signed, 2) + 0.0:.2f} N"
        # Rounded to steps too small to see, so that not every frame needs a new arrow.
        full = self._full_force
        pushed = (round(signed / full * _ARROW_STEPS), full, aside, scene.experiment)
        if text == self._force.text and pushed == self._pushed:
            return False
        self._force.text = text
        if pushed != self._pushed:
            self._pushed = pushed
            arrow = force_arrow(pushed[0] / _ARROW_STEPS * full, full, scene.experiment.tool, scene.experiment.specimen)
            _show(self._force, arrow is not None)
            if arrow is not None and any(aside):
                arrow = turned_arrow(arrow, aside)
            self._fill(self._arrow, None if arrow is None else arrow.surface)
            if arrow is not None:
                x, y, z = (max(arrow.start, arrow.tip, key=lambda end: end[2]) * self.scale).tolist()
                send_position(self._force, (x, y, z))
        return True

    def _mesh(self, name: str, colour: tuple[int, int, int]) -> viser.MeshHandle:
        empty = np.zeros((3, 3), np.float32)
        return self._nodes.add_mesh_simple(name, empty, np.array([[0, 1, 2]], np.uint32), color=colour, side="double",
                                           cast_shadow=False, receive_shadow=False, visible=False, scale=self.scale)

    def _segments(self, name: str, colour: tuple[int, int, int], pixels: float) -> viser.LineSegmentsHandle:
        return self._nodes.add_line_segments(name, np.zeros((1, 2, 3), np.float32), colour, thickness=pixels,
                                             thickness_units="screen", visible=False, scale=self.scale)

    def _fill(self, handle: viser.MeshHandle, surface: Surface | None) -> None:
        if surface is None or not len(surface.faces):
            _show(handle, False)
            return
        send_arrays(handle, vertices=surface.vertices, faces=surface.faces)
        _show(handle, True)

    def _lines(self, handle: viser.LineSegmentsHandle, lines: np.ndarray | None) -> None:
        full = lines is not None and len(lines) > 0
        if full:
            send_arrays(handle, points=np.ascontiguousarray(lines, np.float32))
        _show(handle, full)

    def _light(self) -> None:
        nodes = self._nodes
        nodes.configure_environment_map(hdri=None)
        nodes.configure_default_lights(enabled=False)
        self._ambient = nodes.add_light_ambient("/light/ambient", intensity=_FULL)
        self._key = nodes.add_light_directional("/light/key", intensity=_KEY, position=(0.0, -_KEY_ACROSS, _KEY_UP))


@lru_cache(maxsize=8)
def _opening(degrees: float, segments: int, turn: float = 0.0) -> Opening:
    """One object for one cut, since it keeps its angles."""
    return Opening(np.radians(degrees), np.radians(turn - 90.0), segments=segments)


def _same(arrays: tuple[np.ndarray, ...], others: tuple[np.ndarray, ...] | None) -> bool:
    return others is not None and len(arrays) == len(others) and all(map(np.array_equal, arrays, others))


def _at_height(camera: np.ndarray, seen: np.ndarray, height: float) -> np.ndarray:
    """Where the ray from a camera through a point comes to a height; the point itself where it hardly does."""
    ray = seen - camera
    fall = height - float(camera[2])
    if abs(ray[2]) < _LEAST_FALL * np.linalg.norm(ray) or fall * ray[2] <= 0.0:
        return seen
    return camera + fall / ray[2] * ray


def _force(frame: Frame) -> np.ndarray:
    """On the tool, N, shape (3,)."""
    now = frame.readouts
    return np.zeros(3) if now is None else np.array([*now.across, now.force])


def _undeformed(scene: Scene) -> Mesh | SolidMesh:
    """The undeformed specimen: a section of a round one, and else a solid."""
    if scene.reduced is not None:
        return scene.reduced.mesh
    if scene.experiment.specimen.is_round:
        return build_mesh(scene.experiment, "realtime", layers=scene.material.layers)
    return build_solid_mesh(scene.experiment, "realtime", scene.material.layers)


def _show(handle: viser.SceneNodeHandle, visible: bool) -> None:
    if handle.visible != visible:
        handle.visible = visible


def _next_round(number: float) -> float:
    """The next round one."""
    decade = 10.0 ** np.floor(np.log10(number) + 1e-9)
    return next(float(step * decade) for step in (*_ROUND, 10.0) if step * decade > number * (1 + 1e-9))
