"""First touch of a tool on a solid: height at which the tool touches the surface between the nodes.

Points and normals are evaluated on curved faces of elements.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tissue_sim.errors import ConvergenceError, InputError
from tissue_sim.fem.contact.pairs import ContactPair
from tissue_sim.fem.contact.surface_geometry import NearestSurfaceGeometry, find_nearest_surface_geometry
from tissue_sim.fem.solid.contact import ToolFrame
from tissue_sim.mesh.solid import SolidMesh
from tissue_sim.mesh.solid_element import SolidElement
from tissue_sim.pose import Pose, compute_pose_distance

#: Highest power of a coordinate in the polynomial of a face.
_DEGREE = 4
#: Half of the step of the finite differences for a normal.
_HALF_STEP = 1e-4


class FacePolynomialMaps:
    """Faces of elements in 3D as polynomial maps from the unit square to positions.

    Args:
        element: element type.
        nodes: coordinates of the nodes of each face in the order of the element, m, shape (m, nodes of a face, 3).

    Attributes:
        squares: positions of a lattice on the square, shape (q, 2).
        lattice: lattice points of each face including its corners, m, shape (m, q, 3).
        middles: middle of each face, m, shape (m, 3).
        radii: radius of a ball around the middle that contains the lattice of the face, m, shape (m,).
        bulges: bound of the distance of a face from planes through its lattice points, m, shape (m,).
    """

    def __init__(self, element: SolidElement, nodes: np.ndarray):
        corners = element.reference_nodes[element.local_face_node_indices[0][element.corner_indices_within_face]]
        # For a triangle one edge of the square is collapsed to one corner.
        corners = corners if len(corners) == 4 else corners[[0, 0, 1, 2]]
        line = np.linspace(0.0, 1.0, _DEGREE + 1)
        u, v = (each.ravel() for each in np.meshgrid(line, line, indexing="ij"))
        self.squares = np.stack([u, v], axis=-1)
        reference = np.stack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v], axis=-1) @ corners
        values = element.evaluate_shape_functions_and_gradients(reference)[0][:, element.local_face_node_indices[0]]
        self.lattice = np.einsum("qn,mni->mqi", values, nodes)
        self.middles = self.lattice[:, len(u) // 2]
        self.radii = np.linalg.norm(self.lattice - self.middles[:, None], axis=-1).max(axis=1)
        # The distance of a curve from the chord of two neighbouring points is an eighth of the second difference.
        grid = self.lattice.reshape(-1, _DEGREE + 1, _DEGREE + 1, 3)
        bends = [np.linalg.norm(np.diff(grid, 2, axis=axis), axis=-1).max(axis=(1, 2)) for axis in (1, 2)]
        self.bulges = 0.25 * (bends[0] + bends[1])
        powers = np.linalg.inv(np.vander(line, increasing=True))
        self._factors = np.einsum("ai,bj,mijd->mabd", powers, powers, grid, optimize=True)

    def evaluate_face_positions(self, sides: np.ndarray, places: np.ndarray) -> np.ndarray:
        """Evaluate the polynomials of k faces at q points each; return the positions, m, shape (k, q, 3).

        Args:
            sides: numbers of the faces, shape (k,).
            places: positions on the squares, shape (k, q, 2).
        """
        u, v = np.moveaxis(places[..., None] ** np.arange(_DEGREE + 1), 2, 0)
        products = (u[..., :, None] * v[..., None, :]).reshape(*places.shape[:2], -1)
        return products @ self._factors[sides].reshape(len(sides), -1, 3)

    def compute_unit_normal(self, side: int, place: np.ndarray) -> np.ndarray:
        """Return the outward unit normal of face `side` at the position `place` in the unit square, shape (3,)."""
        # The normal is undefined on the collapsed edge of a triangle: keep a distance from the edges.
        u, v = np.clip(place, 2.0 * _HALF_STEP, 1.0 - 2.0 * _HALF_STEP)
        around = np.array([[[u - _HALF_STEP, v], [u + _HALF_STEP, v], [u, v - _HALF_STEP], [u, v + _HALF_STEP]]])
        left, right, below, above = self.evaluate_face_positions(np.array([side]), around)[0]
        normal = np.cross(right - left, above - below)
        return normal / np.linalg.norm(normal)


@dataclass(frozen=True)
class TouchSettings:
    """Settings of the search for the first touch. Lengths are relative to the height of the mesh.

    Attributes:
        most_approaches: largest number of steps of the tool on its way down.
        passed: depth below the mesh at which the tool has passed it, 1.
        line_points: number of points of a line in which the minimum is sought.
        rounds: number of refinements between the neighbours of the best point.
        most_lifts: largest number of secant steps of the height.
        least_slope: smallest derivative of the gap with respect to the height, 1.
        slack: gap below which a point touches in one evaluation, 1.
        found: gap below which the search has converged, 1.
        lift: height above the touch at which the curvature of the tool is measured, 1.
        sharp: curvature times the height of the mesh above which the tool is sharp, 1.
    """

    most_approaches: int = 1000
    passed: float = 100.0
    line_points: int = 9
    rounds: int = 14
    most_lifts: int = 30
    least_slope: float = 1e-2
    slack: float = 1e-12
    found: float = 1e-10
    lift: float = 1e-6
    sharp: float = 1e4


@dataclass(frozen=True)
class FirstTouchPositionTolerances:
    """Largest distances between the first touch of the tool and the position of the mesh.

    Attributes:
        same_position: distance between two first touches, over the radius of the tool, below which they are the same,
            1.
        face_offset: largest distance of a flat tool from the position of a mesh that cannot be moved, over the radius
            of the tool, 1.
    """

    same_position: float = 1e-6
    face_offset: float = 0.01


_SETTINGS = TouchSettings()
#: Tolerances of every solid.
PLACEMENT = FirstTouchPositionTolerances()


@dataclass(frozen=True)
class FirstTouch:
    """Position of a first touch on the top of a solid.

    Attributes:
        height: of the scene's origin in the frame of the mesh, m.
        side: index of the touched face of the top; -1 if the mesh has no faces.
        place: local coordinates of the touched point in the unit square of the face, shape (2,).
        normal: common normal of tool and surface, shape (3,).
    """

    height: float
    side: int = -1
    place: np.ndarray | None = None
    normal: np.ndarray | None = None

    def differentiate_height_by_mesh_parameter(self, mesh: SolidMesh, ways: np.ndarray) -> float:
        """Return the derivative of `height` with respect to one parameter of the mesh, m per unit of the parameter.

        The touch must be on a face of the mesh.

        Args:
            mesh: mesh of the solid.
            ways: derivatives of the nodal positions with respect to the parameter, m per unit, shape (nodes, 3).
        """
        assert self.place is not None and self.normal is not None
        side = mesh.faces["top"][[self.side]]
        face = FacePolynomialMaps(mesh.element, ways[side])
        way = face.evaluate_face_positions(np.array([0]), self.place[None, None])[0, 0]
        return float(way @ self.normal / self.normal[2])


def find_first_touch(mesh: SolidMesh, places: np.ndarray, pairs: Sequence[ContactPair], start: Pose) -> FirstTouch:
    """Find the height at which a tool that moves downwards first touches the top.

    The surface between the nodes counts. Contact acts at nodes only, but depths measured from the first node that a
    round tool touches would make its force depend on its position between nodes, by several percent.

    Args:
        mesh: mesh of the solid.
        places: positions of its nodes, m, shape (nodes, 3).
        pairs: contact pairs; the last one has the outline of the whole tool.
        start: pose of the tool.

    Raises:
        InputError: the tool does not come down on the specimen.
        ConvergenceError: the search did not converge.
    """
    moving = [pair for pair in pairs if pair.moves]
    if not moving:
        return FirstTouch(0.0)
    tool = _ConvexTool(moving[-1], start, float(np.ptp(mesh.nodes[:, 2])))
    top = places[mesh.sets["top"]]
    if "top" not in mesh.faces:
        return FirstTouch(tool.find_touch_height(top))
    sides = FacePolynomialMaps(mesh.element, places[mesh.faces["top"]])
    datum = tool.find_touch_height(np.concatenate([top, sides.middles]))
    # Other faces cannot be nearer than the point that was met first.
    reaches = sides.radii + sides.bulges + _SETTINGS.slack * tool.scale
    near = np.flatnonzero(tool.compute_gaps(sides.middles, datum) <= reaches)
    heights = sides.lattice[near, :, 2]
    if np.ptp(heights) <= _SETTINGS.slack * tool.scale:
        # The lowest point of the tool touches a flat top.
        datum += float(heights.max()) - tool.find_lowest_point_height(datum)
    found = _NearestFacePoint(sides, near, tool, datum)
    if found.is_all:
        return found.make_first_touch(datum)
    missed, slope = found.gap, 1.0
    # Secant method: over one flat face the distance is a linear function of the height.
    for _ in range(_SETTINGS.most_lifts):
        if abs(missed) <= _SETTINGS.found * tool.scale:
            return found.make_first_touch(datum)
        lift = -missed / slope
        datum, before = datum + lift, missed
        found = _NearestFacePoint(sides, near, tool, datum)
        missed = found.gap
        slope = max((missed - before) / lift, _SETTINGS.least_slope)
    raise ConvergenceError(f"the search for the first touch ended with a gap of {abs(missed) * 1e3:.2g} mm. Check "
                           "whether the top of the mesh is folded")


class FirstTouchHeightAndSolverMaker:
    """Height of the first touch of a tool on the top of a solid, and the solver for a first touch at another pose.

    Args:
        places: positions of the nodes of the top without a tool, m, shape (n, 3).
        pairs: contact pairs; the last one has the outline of the whole tool.
        datum: height of the scene's origin in the frame of the mesh, m.
        is_level: whether the top is flat and has not settled.
        margin: returns the distance of a point from the edge of the top, m.
        touch_height: returns the height of the scene's origin at which a tool at a pose touches, m; raises InputError
            outside of the top.
        remake: returns the solver for a first touch at a pose, or None if no solver can be made; None: never remake.

    Attributes:
        is_level: whether the top is flat and has not settled.
    """

    def __init__(self, places: np.ndarray, pairs: Sequence[ContactPair], datum: float, is_level: bool,
                 margin: Callable[[float, float], float], touch_height: Callable[[Pose], float],
                 remake: Callable[[Pose, Any], Any] | None):
        profiles = [pair.profile for pair in pairs if pair.moves][-1:]
        self.radius = max((float(each.vertices[:, 0].max()) + each.rounding for each in profiles), default=0.0)
        self._highest = float(places[:, 2].max()) - datum
        self._datum, self.is_level, self._margin = datum, is_level, margin
        self._touch_height, self._remake = touch_height, remake

    @property
    def can_move_mesh(self) -> bool:
        """Whether the mesh can be made for another position of the first touch."""
        return self._remake is not None

    def is_at_mesh_position(self, start: Pose, pose: Pose) -> bool:
        """Whether a first touch at a pose needs no other mesh than the first touch at `start`."""
        return compute_pose_distance(start, pose, self.radius) <= PLACEMENT.same_position * self.radius

    def height_above_tissue(self, pose: Pose) -> float:
        """Return the distance that the tool must go down until it touches the undeformed tissue, m.

        See `ToolInAirInterface.height_above_tissue`.
        """
        x, y, z = pose.position
        _, a, b, _ = pose.orientation
        sine = 2.0 * math.sqrt(max(0.0, (a * a + b * b) * (1.0 - a * a - b * b)))
        lowest = z - self.radius * sine - self._highest
        if lowest > 0.0:
            return lowest
        if self.is_level and sine == 0.0 and self._margin(x, y) >= self.radius:
            return z
        try:
            return z + self._datum - self._touch_height(Pose((x, y, 0.0), pose.orientation))
        except InputError:
            return math.inf  # outside the top

    def make_solver_for_touch_pose_or_none(self, pose: Pose, solver: Any) -> Any:
        """Return the solver for a first touch at a pose; None if no such solver can be made.

        Args:
            pose: pose of the tool at the first touch.
            solver: solver whose material and density are copied to the new solver.
        """
        return None if self._remake is None else self._remake(pose, solver)


class _ConvexTool:
    """Distances from a convex tool, for a scene whose origin is at the height `datum` in the frame of the mesh.

    Args:
        pair: contact pair with the outline of the whole tool.
        start: pose in the scene.
        scale: height of the mesh, m.
    """

    def __init__(self, pair: ContactPair, start: Pose, scale: float):
        # Restrictions of nodes to parts of the tool have no meaning before the first touch.
        self._pair, self._start, self.scale = replace(pair, first_line=0, closed=False), start, scale

    def find_nearest_points(self, points: np.ndarray, datum: float) -> NearestSurfaceGeometry:
        """Return the surface points nearest to given points, m, shape (n, 3)."""
        at = ToolFrame(self._start, datum).transform_to_tool(points)
        return find_nearest_surface_geometry(self._pair, at, pressed_in=False)

    def compute_gaps(self, points: np.ndarray, datum: float) -> np.ndarray:
        """Return the signed distances of points, m, shape (..., 3), from the tool, m, shape (...); negative inside."""
        return self.find_nearest_points(points.reshape(-1, 3), datum).gap.reshape(points.shape[:-1])

    def compute_normals(self, points: np.ndarray, datum: float) -> np.ndarray:
        """Return outward normals of the tool at the points nearest to given ones, in the frame of the mesh, (n, 3)."""
        return self.find_nearest_points(points, datum).normal @ ToolFrame(self._start, datum).rotation.T

    def find_lowest_point_height(self, datum: float) -> float:
        """Return the height of the lowest point of the tool in the frame of the mesh, m."""
        frame = ToolFrame(self._start, datum)
        across, up = float(np.hypot(*frame.rotation[2, :2])), float(frame.rotation[2, 2])
        profile = self._pair.profile
        return float(frame.origin[2]) + float((profile.vertices @ [-across, up]).min()) - profile.rounding

    def is_sharp_at(self, point: np.ndarray, datum: float) -> bool:
        """Whether the tool has an edge or a tip where it touches a point, m, shape (3,)."""
        away = datum + _SETTINGS.lift * self.scale
        curvature = self.find_nearest_points(point[None], away).curvature[0]
        return float(np.abs(curvature).max()) * self.scale > _SETTINGS.sharp

    def find_touch_height(self, points: np.ndarray) -> float:
        """Return the height `datum`, m, at which the descending tool touches the first of the points, m, (n, 3)."""
        if abs(self.compute_gaps(points, 0.0).min()) < _SETTINGS.slack * self.scale:
            return 0.0
        from scipy.optimize import brentq

        # Each step is at most the distance between tool and tissue, so that the tool does not pass the tissue.
        high = self.scale + float(points[:, 2].max())
        for _ in range(_SETTINGS.most_approaches):
            if high < -_SETTINGS.passed * self.scale:
                break
            low = high - max(float(self.compute_gaps(points, high).min()), 1e-5 * self.scale)
            if self.compute_gaps(points, low).min() <= 0.0:
                return brentq(lambda height: float(self.compute_gaps(points, height).min()), low, high, xtol=1e-15)
            high = low
        raise InputError("the tool comes down outside of the specimen, or between all of its nodes. Move the tool, or "
                         "use a finer mesh", field="approach")


class _NearestFacePoint:
    """Point of some faces that is nearest to a tool, or deepest inside of it.

    On a flat face the distance from a convex tool is a convex function. A face is searched if it can be nearer than the
    nearest lattice point, by the supporting plane of the tool at the nearest lattice point of the face.

    Args:
        sides: all faces.
        near: indices of the candidate faces.
        tool: the tool.
        datum: height of the scene's origin, m.

    Attributes:
        gap: distance, m.
        point: position, m, shape (3,).
        is_all: whether the tool touches here, and a plane separates it from all faces: the common tangent plane, or a
            horizontal one.
    """

    def __init__(self, sides: FacePolynomialMaps, near: np.ndarray, tool: _ConvexTool, datum: float):
        self._sides, self._tool = sides, tool
        points = sides.lattice[near]
        gaps = tool.compute_gaps(points, datum)
        best = gaps.argmin(axis=1)
        least, rows = gaps.min(axis=1), np.arange(near.size)
        first = int(least.argmin())
        self.gap, self._side, self._place = float(least[first]), int(near[first]), sides.squares[best[first]]
        self.point = points[first, best[first]]
        normals = tool.compute_normals(points[rows, best], datum)
        bounds = least + np.einsum("kqi,ki->kq", points - points[rows, best][:, None], normals).min(axis=1)
        bounds -= sides.bulges[near]
        slack, under = _SETTINGS.slack * tool.scale, points - self.point
        beyond = (under @ normals[first]).min(axis=1) - sides.bulges[near]
        above = under[..., 2].max(axis=1) + sides.bulges[near]
        self.is_all = abs(self.gap) <= slack and bool(beyond.min() >= -slack or (
            above.max() <= slack and tool.find_lowest_point_height(datum) >= self.point[2] - slack))
        if self.is_all:
            return
        searched = near[bounds < self.gap - _SETTINGS.slack * tool.scale]
        if searched.size:
            found, place = _minimise_gap_on_each_face(sides, searched, tool, datum)
            first = int(found.argmin())
            if found[first] < self.gap:
                self.gap, self._side, self._place = float(found[first]), int(searched[first]), place[first]
                self.point = sides.evaluate_face_positions(searched[[first]], place[first][None, None])[0, 0]

    def make_first_touch(self, datum: float) -> FirstTouch:
        """Return the first touch at this point, for a height `datum` of the scene's origin, m.

        The normal is that of the surface at an edge or a tip of the tool, else that of the tool.
        """
        sharp = self._tool.is_sharp_at(self.point, datum)
        normal = (self._sides.compute_unit_normal(self._side, self._place) if sharp
                  else -self._tool.compute_normals(self.point[None], datum)[0])
        return FirstTouch(datum, self._side, self._place, normal)


def _minimise_gap_on_each_face(sides: FacePolynomialMaps, numbers: np.ndarray, tool: _ConvexTool,
                               datum: float) -> tuple[np.ndarray, np.ndarray]:
    """Find on each face the point that is nearest to the tool.

    The minimum along lines of one direction is a convex function of the line, so that both directions are searched in
    the same way.

    Returns:
        Distances, m, shape (k,), and local coordinates of the points, shape (k, 2).
    """
    def compute_distances(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return signed distances from the tool, m, shape of `v`, at the local coordinates (u, v) of each face."""
        squares = np.stack([np.broadcast_to(u[..., None], v.shape), v], axis=-1)
        positions = sides.evaluate_face_positions(numbers, squares.reshape(len(numbers), -1, 2))
        return tool.compute_gaps(positions, datum).reshape(v.shape)

    def find_minima_along_v_lines(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return for each u the smallest distance over v, m, and the v of this distance, shape of `u` each."""
        return _minimise_convex_on_unit_interval(lambda v: compute_distances(u, v), u.shape, end)

    end = _SETTINGS.slack * tool.scale
    found, u = _minimise_convex_on_unit_interval(lambda u: find_minima_along_v_lines(u)[0], numbers.shape, end)
    _, v = find_minima_along_v_lines(u[:, None])
    return found, np.stack([u, v[:, 0]], axis=-1)


def _minimise_convex_on_unit_interval(values: Callable[[np.ndarray], np.ndarray], shape: tuple[int, ...], end: float
                                      ) -> tuple[np.ndarray, np.ndarray]:
    """Minimise convex functions of one variable, one for each entry of `shape`, on [0, 1] by repeated refinement.

    Args:
        values: functions of shape `shape`, evaluated at q points each, shape (*shape, q).
        shape: shape of the result.
        end: the search ends when the values at the points differ by less.

    Returns:
        Smallest values and the arguments at which they occur, shape `shape` each.
    """
    low, high = np.zeros(shape), np.ones(shape)
    for _ in range(_SETTINGS.rounds):
        line = low[..., None] + (high - low)[..., None] * np.linspace(0.0, 1.0, _SETTINGS.line_points)
        found = values(line)
        best = found.argmin(axis=-1)[..., None]
        if np.ptp(found, axis=-1).max() <= end:
            break
        low, high = (np.take_along_axis(line, np.clip(best + offset, 0, _SETTINGS.line_points - 1), -1)[..., 0]
                     for offset in (-1, 1))
    least, place = (np.take_along_axis(array, best, -1)[..., 0] for array in (found, line))
    return least, place
