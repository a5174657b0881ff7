"""Contact of the surface with rigid bodies: who may meet whom, and what the kernels know of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import leggauss

from tissue_sim.experiment.contact_law import ContactLaw
from tissue_sim.experiment.tools.outline import Profile
from tissue_sim.mesh import Mesh

#: Stiffness of the springs that eliminate contact forces, in units of mu0 over the length of the element edge: each
#: iteration leaves one part in so many of a gap.
STIFFNESS = 3e3
#: How many times stiffer a point that does not slip is held.
HOLD = 30.0
#: What an interface without slip stands for among the coefficients of friction.
STICK = -1.0
#: Places along an edge and weights, from -1 to 1, of Simpson's and the trapezoidal rule, by the order of the element.
NODE_RULES = {1: (np.array([-1.0, 1.0]), np.array([1.0, 1.0])),
              2: (np.array([-1.0, 0.0, 1.0]), np.array([1.0, 4.0, 1.0]) / 3.0)}
#: Columns of `ContactPoints.spans`.
FIRST_LINE, LAST_LINE, SHAFT, MOVES, STAYS = range(5)
#: Columns of `ContactPoints.rates`: of the force with the motion of the point, N/m; normal; coefficient of the
#: friction that acts; by how much the constraint is missed, m; what of the rates is that of contact laws, N/m.
RR, RZ, ZR, ZZ, NORMAL_R, NORMAL_Z, FRICTION, MISSED_R, MISSED_Z, LAW_RR, LAW_RZ, LAW_ZZ, RATES = range(13)
#: Columns of `ContactPoints.known_rates`: the rates that the matrix holds, and what of them is that of contact laws.
KNOWN_LAW_RR, KNOWN_LAW_RZ, KNOWN_LAW_ZZ, KNOWN = range(4, 8)


@dataclass(frozen=True, eq=False)
class Pair:
    """Edges of the surface and the body that they may meet.

    Attributes:
        profile: outline of the body; that of a body which moves with the tool is in the tool's frame.
        edges: nodes of the element edges, shape (m, nodes of an edge).
        friction: of the body's face and of its shaft: a coefficient, 0 frictionless, `STICK` no slip.
        moves: whether the body moves with the tool or rests.
        tied: whether an interface without slip holds the edges from the start.
        stays: whether the edges stay on the body even when they are pulled.
        first_line: line of the profile's chain from which on the edges may meet it.
        between_nodes: whether contact is watched at as many Gauss points of an edge as it brings freedoms along its
            normal, instead of its nodes: a surface that slides round an edge no larger than an element, or up a ball,
            is ten times as well placed by them. A pointed tip would poke through.
    """

    profile: Profile
    edges: np.ndarray
    friction: tuple[float, float]
    moves: bool = True
    tied: bool = False
    stays: bool = False
    first_line: int = 0
    between_nodes: bool = False


@dataclass(frozen=True, eq=False)
class Contact:
    """All pairs of a problem.

    Attributes:
        pairs: the first ones rest, the others move with the tool.
        tolerance: how far a point may violate a contact condition, m.
        laws: tractions at points that have touched the tool, beside contact and friction.
        face: area of the tool's face at the largest depth, m2.
        level: whether the body that moves is a plate, which a settled top meets all at once.
    """

    pairs: tuple[Pair, ...]
    tolerance: float
    laws: tuple[ContactLaw, ...] = ()
    face: float = 1.0
    level: bool = False


class ContactPoints:
    """The points that may meet a body, and the arrays that a step's kernel works on; without contact they hold one that
    is never looked at.

    A node is a point once for the bodies that rest and once for those that move, in the first pair that has it.

    Attributes:
        count: points that are looked at, n below.
        nodes, shapes: of the edge of each point, and the shape functions there, shape (n, a).
        spans: per point first and last line, first line of the shaft, whether the body moves, whether the point stays
            on it, (n, 5).
        vertices: chains of all bodies, one behind the other, shape (v, 2).
        rounding: of each point's body, m, shape (n,).
        friction: of the face and of the shaft of each point's body, shape (n, 2).
        places: (r, z) of the undeformed points, m, (n, 2); areas: that they stand for, m2, shape (n,); springs: N/m,
            shape (n,).
        anchors, held: how a point is bound (`contact_kernels.FREE`, `HELD`, `TOUCHED`) and where in the body's frame,
            at the last equilibrium and during a step, shape (n, 3); met: what it would become. Where: displacement
            of the point in that frame.
        pressed: 1 where a point counts as in contact, else 0, shape (n,).
        ways, slipped: which way along the surface a point slips, 1, -1 or 0, during a step and at the last equilibrium.
        forces: on the tissue, turned round, N, shape (n, 2); rates: columns as named above, (n, RATES); known_rates:
            those with the motion of the points that the matrix holds, N/m, (n, 4).
    """

    def __init__(self, mesh: Mesh, contact: Contact | None):
        pairs = () if contact is None else contact.pairs
        order = mesh.element.order
        # Of each point its pair, the nodes of its edge and where on it; of each edge its points and their weights.
        points: list[tuple[Pair, np.ndarray, float]] = []
        numbers: dict[tuple[int, bool], int] = {}
        edges: list[tuple[np.ndarray, list[int], np.ndarray]] = []
        for pair in pairs:
            places, weights = leggauss(order) if pair.between_nodes else NODE_RULES[order]
            for edge in pair.edges:
                at = []
                for node, place in zip(edge.tolist(), places.tolist(), strict=False):
                    number = len(points) if pair.between_nodes else numbers.setdefault((node, pair.moves), len(points))
                    if number == len(points):
                        points.append((pair, edge, place))
                    at.append(number)
                edges.append((edge, at, weights))
        self.count = len(points)
        if not points:
            nobody = Pair(Profile(np.zeros((2, 2)), 0.0, 0), np.zeros((1, order + 1), np.int32), (0.0, 0.0))
            points = [(nobody, nobody.edges[0], 0.0)]
        owners, n = [pair for pair, _edge, _place in points], len(points)
        self.nodes = np.array([edge for _pair, edge, _place in points], dtype=np.int32)
        along, lines = np.array([place for _pair, _edge, place in points]), np.linspace(-1.0, 1.0, order + 1)
        self.shapes = np.stack([np.prod([(along - other) / (own - other) for other in lines if other != own], axis=0)
                                for own in lines], axis=-1)
        self.places = np.einsum("na,nai->ni", self.shapes, mesh.nodes[self.nodes])
        self._profiles = list({id(pair.profile): pair.profile for pair in owners}.values())
        number_of = {id(profile): k for k, profile in enumerate(self._profiles)}
        self._owner = np.array([number_of[id(pair.profile)] for pair in owners])
        self.vertices = np.concatenate([profile.vertices for profile in self._profiles])
        ends = np.cumsum([len(profile.vertices) for profile in self._profiles])
        firsts = ends - [len(profile.vertices) for profile in self._profiles]
        self.spans = np.array([
            (firsts[k] + pair.first_line, ends[k] - 2, firsts[k] + pair.profile.shaft, pair.moves, pair.stays)
            for k, pair in zip(self._owner, owners, strict=True)], dtype=np.int32)
        self.rounding = np.array([pair.profile.rounding for pair in owners])
        self.friction = np.array([pair.friction for pair in owners], dtype=float)
        self.tied, self.moves = np.array([pair.tied for pair in owners]), self.spans[:, MOVES].astype(bool)
        self.areas, self._lengths, self.springs = np.zeros((3, n))
        for edge, at, weights in edges:
            # Of each point's share of the edge: 2 pi r times half the length times its weight.
            length = float(np.linalg.norm(mesh.nodes[edge[-1]] - mesh.nodes[edge[0]]))
            r = self.places[at, 0]
            areas = np.pi * length * weights * r
            self.areas[at] += areas
            # A point on the axis has no area, but must not be left alone.
            self._lengths[at] += (areas + 0.25 * areas.max() * (r == 0.0)) / length
        self.anchors, self.held, self.met = np.zeros((3, n, 3))
        self.pressed, self.ways, self.slipped = np.zeros((3, n))
        self.forces, self.rates, self.known_rates = np.zeros((n, 2)), np.zeros((n, RATES)), np.zeros((n, KNOWN))

    @property
    def slips(self) -> bool:
        """Whether anything can slip against friction."""
        return bool((self.friction > 0.0).any())

    def set_stiffness(self, modulus: float) -> None:
        """Springs of this many Pa over the length of their edge.

        `rounding_rate` is the force, N, that rounding costs per m of displacement.
        """
        self.springs[:] = modulus * self._lengths
        self.rounding_rate = np.finfo(float).eps * float(np.linalg.norm(self.springs))

    def positions(self, displacement: np.ndarray) -> np.ndarray:
        """Where the points are, (r, z), m, shape (n, 2), from nodal displacements (nodes, 2)."""
        return self.places + np.einsum("na,nai->ni", self.shapes, displacement[self.nodes])

    def gaps(self, place: np.ndarray) -> np.ndarray:
        """Signed distance of points (n, 2), each in the frame of its body, from its body, m, shape (n,)."""
        gaps = np.zeros(len(place))
        for number, profile in enumerate(self._profiles):
            own = self._owner == number
            gaps[own] = profile.gap(place[own])
        return gaps
