"""Rigid tools and their profiles.

A new shape is a function from the `Tool` to its `Profile` and a line in `SHAPES`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tissue_sim.errors import InputError, nearest, require_length
from tissue_sim.experiment.tools.profile_file import read_profile
from tissue_sim.parameters import parameter

#: How far a shaft reaches above the face, in tool radii: farther than any tissue.
SHAFT_LENGTH = 1e3
#: Radius of a plate, m: wider than any specimen.
PLATE_RADIUS = 10.0
#: Rounding of the corners of a profile from a file where nothing is said, in radii of the tool.
PROFILE_ROUNDING, MOST_HALVINGS = 0.02, 10


@dataclass(frozen=True, eq=False)
class Profile:
    """Outline of a rigid body of revolution: a chain of straight lines, thickened by a rounding radius.

    The frame is the tool's: r from the axis, z out of the tissue, origin at the deepest point. The chain runs from the
    axis outwards and upwards with the body on its left.

    Attributes:
        vertices: (r, z), m, shape (n, 2).
        rounding: m; the surface lies this far outside the chain.
        shaft: index of the first line that belongs to the shaft; those before are the face.
    """

    vertices: np.ndarray
    rounding: float
    shaft: int

    def gap(self, points: np.ndarray) -> np.ndarray:
        """Signed distance of points (n, 2) from the surface, m, positive outside, shape (n,)."""
        points = np.asarray(points, dtype=float)
        start, way = self.vertices[:-1], np.diff(self.vertices, axis=0)
        offset = points[:, None] - start
        along = np.einsum("nsi,si->ns", offset, way) / np.einsum("si,si->s", way, way)
        share = np.clip(along, 0.0, 1.0)
        arrow = offset - share[..., None] * way
        distance = np.linalg.norm(arrow, axis=-1)
        normal = np.stack([way[:, 1], -way[:, 0]], axis=-1)
        # Where two lines are equally near, at a vertex, the one that the point stands farther in front of decides.
        front = np.einsum("nsi,si->ns", arrow, normal / np.linalg.norm(normal, axis=1)[:, None])
        # Before the start of the chain there is no inside.
        front[:, 0] = np.where(along[:, 0] < 0.0, np.abs(front[:, 0]), front[:, 0])
        closest = np.lexsort((-np.abs(front), np.round(distance, 15)), axis=-1)[:, 0]
        rows = np.arange(len(points))
        return np.copysign(distance[rows, closest], front[rows, closest]) - self.rounding

    def outline(self, height: float) -> np.ndarray:
        """Points (r, z) of the surface from the axis up to `height`, m, for drawing, shape (n, 2)."""
        way = np.diff(self.vertices, axis=0)
        angle = np.arctan2(-way[:, 0], way[:, 1])  # of the outward normal
        # The surface begins on the axis, under the first vertex.
        angle = np.concatenate([[-np.pi / 2], angle, [np.pi / 2 if self.vertices[-1, 1] < height else angle[-1]]])
        points = []
        for k, vertex in enumerate(self.vertices):
            turn = np.linspace(angle[k], angle[k + 1], 25)
            points.append(vertex + self.rounding * np.stack([np.cos(turn), np.sin(turn)], axis=-1))
        points = np.concatenate(points)
        points[:, 1] = np.minimum(points[:, 1], height)
        return points


def _plate(tool: Tool) -> Profile:
    return Profile(np.array([[0.0, 0.0], [PLATE_RADIUS, 0.0]]), 0.0, 1)


def _flat(tool: Tool) -> Profile:
    a, rounding = tool.radius, tool.edge_radius
    return Profile(np.array([[0.0, rounding], [a - rounding, rounding], [a - rounding, SHAFT_LENGTH * a]]), rounding, 1)


def _round(tool: Tool) -> Profile:
    a = tool.radius
    return Profile(np.array([[0.0, a], [0.0, SHAFT_LENGTH * a]]), a, 0)


def _sphere(tool: Tool) -> Profile:
    a = tool.radius
    # A line too short to matter; above it the ball closes.
    return Profile(np.array([[0.0, a], [0.0, a * (1 + 1e-9)]]), a, 1)


def _cone(tool: Tool) -> Profile:
    a, tip = tool.radius, tool.tip_radius
    shoulder = tip + (a - tip) / np.tan(tool.half_angle)
    return Profile(np.array([[0.0, tip], [a - tip, shoulder], [a - tip, shoulder + SHAFT_LENGTH * a]]), tip, 1)


def _profile(tool: Tool) -> Profile:
    """The chain lies inside the outline of the file by the rounding, so that its lines stay where they are.

    Raises:
        InputError: a rounding for which a line is too short.
    """
    outline = tool.outline
    top = [[outline[-1, 0], outline[-1, 1] + SHAFT_LENGTH * tool.radius]]
    if outline[-1, 0] == outline[-2, 0]:
        outline = outline[:-1]
    outline = np.concatenate([outline, top])
    rounding = tool.edge_radius
    way = np.diff(outline, axis=0)
    inward = np.stack([-way[:, 1], way[:, 0]], axis=-1) / np.linalg.norm(way, axis=1)[:, None]
    chain = outline.copy()
    chain[0] += rounding * np.array([0.0, 1.0]) / inward[0, 1]
    chain[-1] += rounding * inward[-1]
    for k in range(1, len(way)):
        # Where the two shifted lines meet.
        chain[k] += rounding * (inward[k - 1] + inward[k]) / (1.0 + inward[k - 1] @ inward[k])
    if (np.einsum("ki,ki->k", np.diff(chain, axis=0), way) <= 0).any():
        raise InputError(f"a line of the profile is too short for corners rounded by {rounding:g} m; give a smaller "
                         "edge radius", field="tool.edge_radius")
    # A rounded point is blunter, and the deepest point is the origin.
    chain[:, 1] -= chain[0, 1] - rounding
    return Profile(chain, rounding, int(np.flatnonzero(way[:, 0] == 0.0)[0]))


#: Shape -> what makes its profile.
SHAPES: dict[str, Callable[[Tool], Profile]] = {
    "plate": _plate, "flat": _flat, "round": _round, "sphere": _sphere, "cone": _cone, "profile": _profile}
#: Which shapes take which sizes besides the radius.
_TAKES = {"edge_radius": ("flat", "profile"), "half_angle": ("cone",), "tip_radius": ("cone",),
          "profile_file": ("profile",)}


@dataclass(frozen=True)
class Tool:
    """A rigid body that is moved into the specimen.

    Attributes:
        shape: ``"plate"`` covers the whole top face; ``"flat"`` is a needle with a flat face, ``"round"`` one with a
            hemispherical tip, ``"cone"`` one with a conical tip; ``"sphere"`` is a ball; ``"profile"`` comes from a
            file.
        radius: of the shaft or of the ball, m; a plate has none, a profile's is that of its file.
        edge_radius: of the rounding between face and shaft of a flat needle, or of the corners of a profile
            (where it is 0, `PROFILE_ROUNDING` of its radius or what its lines have room for), m.
        half_angle: of a cone, between its axis and its side, rad.
        tip_radius: of the rounding of a cone's tip, and of its shoulder, m.
        profile_file: two columns r, z in mm from the axis outwards and upwards, see
            `tissue_sim.experiment.tools.profile_file`.

    Raises:
        InputError: unknown shape, a size that is missing, does not fit or does not belong to the shape; what
            `read_profile` refuses.
    """

    shape: str = "plate"
    radius: float | None = parameter("a", "m", key="tool_radius_mm", factor=1e-3, bounds=(1e-6, 1.0), shapes_mesh=True,
                                     default=None)
    edge_radius: float = parameter("r_e", "m", key="edge_radius_mm", factor=1e-3, bounds=(0.0, 1.0), absent=0.0,
                                   shapes_mesh=True, default=0.0)
    half_angle: float | None = parameter("theta", "rad", key="half_angle_deg", factor=np.pi / 180, bounds=(0.01, 1.57),
                                         default=None)
    tip_radius: float = parameter("r_t", "m", key="tip_radius_mm", factor=1e-3, bounds=(0.0, 1.0), absent=0.0,
                                  default=0.0)
    profile_file: str | Path | None = None

    def __post_init__(self):
        if self.shape not in SHAPES:
            raise InputError(f"unknown tool shape {self.shape!r}{nearest(self.shape, SHAPES)}", field="tool")
        if self.shape == "plate" and (self.radius is not None or self.edge_radius):
            raise InputError("a plate covers the whole top face and has no radius; leave it out", field="tool.radius")
        for name, shapes in _TAKES.items():
            if getattr(self, name) and self.shape not in shapes:
                raise InputError(f"a {self.shape} tool has no {name.replace('_', ' ')}; leave it out",
                                 field=f"tool.{name}")
        if self.shape == "plate":
            return
        if self.shape == "profile":
            self._take_profile()
        if self.radius is None:
            raise InputError(f"a {self.shape} tool needs a radius", field="tool.radius")
        require_length(self.radius, "tool.radius")
        for name in ("edge_radius", "tip_radius"):
            value = getattr(self, name)
            if not (np.isfinite(value) and 0 <= value < self.radius):
                raise InputError(f"an {name.replace('_', ' ')} of {value:g} m does not fit a tool of radius "
                                 f"{self.radius:g} m; give 0 or more and less than the radius", field=f"tool.{name}")
        if self.shape == "cone" and not (self.half_angle and 0.01 <= self.half_angle < np.pi / 2):
            raise InputError("a cone needs a half angle, between its axis and its side, of 0.6 degrees or more and "
                             "below 90 degrees", field="tool.half_angle")

    def _take_profile(self) -> None:
        if self.profile_file is None:
            raise InputError("a profile tool needs the file of its profile", field="tool.profile_file")
        outline = read_profile(self.profile_file)
        widest = float(outline[:, 0].max())
        if self.radius is not None and abs(self.radius - widest) > 1e-9 * widest:
            raise InputError(f"the profile's radius is {widest:g} m; leave the radius out", field="tool.radius")
        object.__setattr__(self, "radius", widest)
        object.__setattr__(self, "_outline", outline)
        if self.edge_radius:
            return
        # The largest that every line has room for, within reason.
        for halvings in range(MOST_HALVINGS):
            object.__setattr__(self, "edge_radius", PROFILE_ROUNDING * widest / 2**halvings)
            try:
                _profile(self)
                return
            except InputError:
                continue

    @property
    def outline(self) -> np.ndarray | None:
        """The profile of the file, (r, z), m, shape (n, 2); None where there is no file."""
        return getattr(self, "_outline", None)

    @property
    def profile(self) -> Profile:
        """The outline that the tissue meets."""
        return SHAPES[self.shape](self)

    @property
    def face_radius(self) -> float | None:
        """Radius of the flat part of the face, m; 0 where there is none, None for a plate."""
        match self.shape:
            case "plate":
                return None
            case "flat":
                return self.radius - self.edge_radius
            case "profile":
                return max(0.0, float(self.outline[self.outline[:, 1] == 0.0, 0].max()) - self.edge_radius)
            case _:
                return 0.0

    def contact_radius(self, depth: float, specimen_radius: float = np.inf) -> float:
        """About how wide the contact is at a depth, m: of a pointed tool as on an elastic half-space (Hertz; Sneddon,
        Int. J. Eng. Sci. 3 (1965) 47), of a plate the specimen's radius."""
        match self.shape:
            case "plate":
                return specimen_radius
            case "round" | "sphere":
                return min(self.radius, float(np.sqrt(self.radius * depth)))
            case "cone":
                pointed = 2.0 / np.pi * depth * np.tan(self.half_angle)
                blunt = np.sqrt(self.tip_radius * depth)
                return min(self.radius, float(max(pointed, blunt)))
            case "profile":
                wide = float(np.interp(depth, self.outline[:, 1], self.outline[:, 0]))
                return max(self.face_radius, 1e-3 * self.radius, wide if self.face_radius else 2.0 / np.pi * wide)
            case _:
                return self.radius
