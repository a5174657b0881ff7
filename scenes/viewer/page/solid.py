"""The 3D picture: the specimen in iso-bands, the tool, its force, where they touch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import viser

from scenes.field_labels import LABELS
from scenes.viewer.colours import PALETTE, field_range, steady_levels
from scenes.viewer.cut_away import CutAway
from scenes.viewer.frame import Frame
from scenes.viewer.page.notices import Reply, answer_to
from scenes.viewer.page.scene_updates import send_arrays, send_position
from scenes.viewer.revolution import Opening, Surface
from scenes.viewer.scene import Scene
from scenes.viewer.tone import seen_colour, surface_colour
from scenes.viewer.tool_picture import base_plate, contact_picture, force_arrow, scale_bar, tool_mesh
from tissue_sim.fem.axisymmetric.discretisation import build_mesh
from tissue_sim.fem.axisymmetric.fields import Fields
from tissue_sim.fem.fields import extrapolate
from tissue_sim.mesh import Mesh
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
_FULL, _KEY, _KEY_DIRECTION = np.pi, 1.1, np.array([0.0, -0.8, 0.6])
#: Segments of a whole turn of the tissue, for a browser without a graphics card, and of what is sent once only.
FINE, COARSE, STILL = 48, 32, 96
#: Steps in the length of the arrow.
_ARROW_STEPS = 60
#: Forces that an arrow of full length stands for, times powers of ten.
_ROUND = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)


@dataclass(frozen=True)
class Look:
    """How the specimen is shown.

    Attributes:
        field: a name in `scenes.field_labels.LABELS`.
        cut: angle of the wedge that is left out, degrees.
        mesh_lines, outline: whether to show the element edges, and the undeformed specimen.
        hold: keep the colours' levels as they are.
    """

    field: str = "von_mises"
    cut: float = 120.0
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
        self.scale = SIZE / max(2.0 * specimen.radius, specimen.height)
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
        self._state: np.ndarray | None = None
        self._pushed: tuple | None = None
        self._standing: tuple | None = None
        self._cut_away: CutAway | None = None
        self._full_force = 1.0

    def on_drag(self, aim: Callable[[float, Reply | None], None]) -> None:
        """Call `aim` with the depth, m, to which somebody drags the tool; once a drag with whom to tell why not."""
        grabbed: dict[int, float] = {}
        untold: set[int] = set()

        async def drag(event) -> None:  # a coroutine: its phases come in order
            client = event.client_id
            if event.phase == "start":
                grabbed[client] = event.start_position[2] - self._tool_frame.position[2]
                untold.add(client)
            if event.phase == "end":
                grabbed.pop(client, None)
            elif client in grabbed:
                reply = None
                if client in untold:
                    untold.discard(client)
                    reply = answer_to(event)
                aim(-(event.end_position[2] - grabbed[client]) / self.scale, reply)

        self._tool.on_drag("left")(drag)

    def show(self, frame: Frame, look: Look) -> bool:
        """Write what has changed since the last time; whether anything has."""
        snapshot = frame.snapshot
        opening = _opening(look.cut, self._segments_of_turn)
        stands = (frame.scene.experiment, look.cut, look.outline)
        changed = stands != self._standing
        if snapshot is None:
            if changed:
                self._wait(frame.scene, opening, look)
                self._standing = stands
            return changed
        # Other solvers' fields have no section that could be drawn.
        fields = snapshot.fields if isinstance(snapshot.fields, Fields) else None
        surface = frame.surface
        if changed:
            cut_away = self._take_mesh(_undeformed(frame.scene) if fields is None else fields.mesh)
            self._stand(cut_away, frame.scene, opening, look)
            self._standing = stands
        seen = snapshot.pose, None if fields is None else fields.material, look
        state = fields.states if fields is not None else np.zeros(0) if surface is None else surface.vertices
        if changed or seen != self._drawn or self._state is None or not np.array_equal(state, self._state):
            if fields is None:
                self._draw_surface(surface)
            else:
                self._draw(fields, snapshot, frame.scene, opening, look)
            self._place(snapshot)
            self._drawn, self._state, changed = seen, state, True
        force = frame.readouts.force if frame.readouts else 0.0
        return self._push(force, frame.scene) or changed

    def _draw(self, fields: Fields, snapshot: Snapshot, scene: Scene, opening: Opening, look: Look) -> None:
        cut_away = self._take_mesh(fields.mesh)
        _, factor = LABELS[look.field]
        at_points = fields.at_points(look.field) * factor
        values = fields.at_nodes(look.field) * factor if look.field == "displacement" else extrapolate(fields.mesh,
                                                                                                       at_points)
        before = self.levels if self._drawn is not None and look.field == self._drawn[2].field else None
        self.levels = levels = before if before is not None and look.hold else steady_levels(
            before, *field_range(at_points, fields, look.field, factor))
        place = snapshot.place
        for handle, surface in zip(self._bands, cut_away.bands(place, values, levels, opening), strict=True):
            self._fill(handle, surface)
        contact = contact_picture(cut_away.surface_line(place), scene.experiment.tool, snapshot.depth, opening)
        self._lines(self._contact, None if contact is None else contact.lines)
        self._lines(self._mesh_lines, cut_away.mesh_lines(place, opening) if look.mesh_lines else None)

    def _draw_surface(self, surface: Surface | None) -> None:
        """Tissue of a solver that has no section to draw, in one colour; where it has no triangles, no tissue."""
        for handle in (*self._bands, self._contact, self._mesh_lines):
            _show(handle, False)
        self._fill(self._surface, surface)

    def _place(self, snapshot: Snapshot) -> None:
        """The tool at its pose, and the ground where the specimen stands."""
        pose = snapshot.pose
        x, y, z = pose.position
        for moved in (self._tool_frame, self._force_frame):
            send_position(moved, (self.scale * x, self.scale * y, self.scale * z))
        if not np.array_equal(self._tool_frame.wxyz, pose.orientation):
            self._tool_frame.wxyz = pose.orientation
        # Where a specimen has sagged under its own weight, the tool touches it lower.
        if self._ground.position[2] != -snapshot.datum * self.scale:
            self._ground.position = (0.0, 0.0, -snapshot.datum * self.scale)

    def _take_mesh(self, mesh: Mesh) -> CutAway:
        if self._cut_away is None or self._cut_away.mesh is not mesh:
            self._cut_away, self._drawn = CutAway.of(mesh), None
        return self._cut_away

    def _wait(self, scene: Scene, opening: Opening, look: Look) -> None:
        """The undeformed specimen, while its simulation starts."""
        cut_away = self._take_mesh(_undeformed(scene))
        place = cut_away.mesh.nodes
        surfaces = cut_away.bands(place, np.zeros(len(place)), np.arange(len(self._bands) + 1.0), opening)
        for handle, surface in zip(self._bands, surfaces, strict=True):
            self._fill(handle, surface)
        for hidden in (self._surface, self._contact, self._mesh_lines, self._arrow, self._force):
            _show(hidden, False)
        self._pushed = None
        self._place(Snapshot(Pose.at_depth(0.0), 0.0, None))
        self._stand(cut_away, scene, opening, look)

    def _stand(self, cut_away: CutAway, scene: Scene, opening: Opening, look: Look) -> None:
        """What does not move with the tissue."""
        specimen, tool = scene.experiment.specimen, scene.experiment.tool
        if opening.faces:
            # The section faces get the light in which a surface has just its own colour, that of the bar.
            faces_it = max(0.0, float(_KEY_DIRECTION[:2] @ opening.faces[0][1]))
            self._ambient.intensity = _FULL - _KEY * faces_it
        self._fill(self._tool, tool_mesh(tool, specimen, _opening(look.cut, STILL)))
        self._fill(self._base, base_plate(specimen, _opening(0.0, STILL)))
        covered = specimen.radius if tool.is_plate else tool.radius or 0.0
        self._lines(self._outline, cut_away.undeformed_outline(opening, tool=(covered, scene.deepest))
                    if look.outline else None)
        bar, length = scale_bar(specimen)
        self._lines(self._scale_bar, bar)
        self._scale_length.text = f"{1e3 * length:g} mm"
        self._scale_length.position = tuple(self.scale * bar[0].mean(axis=0))

    def _push(self, force: float, scene: Scene) -> bool:
        """The arrow of the force; whether it has changed."""
        while abs(force) > self._full_force:
            self._full_force = _next_round(self._full_force)
        text = f"{round(force, 2) + 0.0:.2f} N"
        # Rounded to steps too small to see, so that not every frame needs a new arrow.
        full = self._full_force
        pushed = (round(force / full * _ARROW_STEPS), full, scene.experiment)
        if text == self._force.text and pushed == self._pushed:
            return False
        self._force.text = text
        if pushed != self._pushed:
            self._pushed = pushed
            arrow = force_arrow(pushed[0] / _ARROW_STEPS * full, full, scene.experiment.tool, scene.experiment.specimen)
            _show(self._force, arrow is not None)
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
        nodes.add_light_directional("/light/key", intensity=_KEY, position=tuple(_KEY_DIRECTION))


@lru_cache(maxsize=8)
def _opening(degrees: float, segments: int) -> Opening:
    """One object for one cut, since it keeps its angles."""
    return Opening(np.radians(degrees), segments=segments)


def _undeformed(scene: Scene) -> Mesh:
    """A section of the undeformed specimen."""
    return build_mesh(scene.experiment, "realtime", layers=scene.material.layers)


def _show(handle: viser.SceneNodeHandle, visible: bool) -> None:
    if handle.visible != visible:
        handle.visible = visible


def _next_round(number: float) -> float:
    """The next round one."""
    decade = 10.0 ** np.floor(np.log10(number) + 1e-9)
    return next(float(step * decade) for step in (*_ROUND, 10.0) if step * decade > number * (1 + 1e-9))
