"""Contact of the surface with rigid bodies: who may meet whom, and what the kernels know of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import leggauss

from tissue_sim.experiment.contact_law import ContactLaw
from tissue_sim.experiment.tools.outline import Profile
from tissue_sim.mesh import Mesh

#: Spring stiffness in units of mu0 over the length of the element edge.
STIFFNESS = 3e3
#: How many times stiffer a point that does not slip is held: it never chatters, and a soft hold lets a sharp edge
#: buckle the tissue.
HOLD = 30.0
#: What an interface without slip stands for among the coefficients of friction.
STICK = -1.0
#: Places along an edge and weights, from -1 to 1, of Simpson's and the trapezoidal rule, by the order of the element.
NODE_RULES = {1: (np.array([-1.0, 1.0]), np.array([1.0, 1.0])),
              2: (np.array([-1.0, 0.0, 1.0]), np.array([1.0, 4.0, 1.0]) / 3.0)}
#: Columns of `ContactPoints.spans`.
FIRST_LINE, LAST_LINE, SHAFT, MOVES, STAYS = range(5)


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
        at_nodes: whether contact is watched at the nodes instead of Gauss points.
    """

    profile: Profile
    edges: np.ndarray
    friction: tuple[float, float]
    moves: bool = True
    tied: bool = False
    stays: bool = False
    first_line: int = 0
    at_nodes: bool = False


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
    """The arrays that a step's kernel works on; without contact they hold one edge that is never looked at.

    Attributes:
        count: edges that are looked at.
        edges: their nodes, shape (m, a).
        spans: per edge first and last line, first line of the shaft, whether the body moves, whether the edge stays on
            it, (m, 5).
        vertices: chains of all bodies, one behind the other, shape (v, 2).
        rounding: of each edge's body, m, shape (m,).
        friction: of the face and of the shaft of each edge's body, shape (m, 2).
        shapes: shape functions of an edge at its points, shape (m, q, a); places: (r, z) of the points, m, (m, q, 2).
        springs: N/m, shape (m, q), 0 where a point is not used; areas: m2, shape (m, q).
        anchors, held: how a point is bound (`contact_kernels.FREE`, `HELD`, `TOUCHED`) and where in the body's frame,
            at the last equilibrium and during a step, shape (m, q, 3); met: what it would become. Where: displacement
            of the point in that frame.
        ways, slipped: which way along the surface a point slips, 1, -1 or 0, during a step and at the last equilibrium.
        forces: on the tissue, turned round, N, shape (m, q, 2); rates: with the motion of the points, rr, rz, zr, zz,
            N/m, then the normal (r, z) and the coefficient of friction there, shape (m, q, 7); known_rates: those
            that the matrix holds, (m, q, 4).
    """

    def __init__(self, mesh: Mesh, contact: Contact | None):
        order = mesh.element.order
        pairs = () if contact is None else contact.pairs
        self.count = sum(len(pair.edges) for pair in pairs)
        if not pairs:
            none = Profile(np.zeros((2, 2)), 0.0, 0)
            pairs = (Pair(none, np.zeros((1, order + 1), np.int32), (0.0, 0.0)),)
        sizes = [len(pair.edges) for pair in pairs]

        def of_edges(values, dtype=float):
            return np.repeat(np.array(values, dtype=dtype), sizes, axis=0)

        self.edges = np.concatenate([pair.edges for pair in pairs]).astype(np.int32)
        self.vertices = np.concatenate([pair.profile.vertices for pair in pairs])
        ends = np.cumsum([len(pair.profile.vertices) for pair in pairs])
        starts = ends - [len(pair.profile.vertices) for pair in pairs]
        self.spans = np.ascontiguousarray(of_edges([
            (start + pair.first_line, end - 2, start + pair.profile.shaft, pair.moves, pair.stays)
            for pair, start, end in zip(pairs, starts, ends, strict=True)], np.int32))
        self.rounding = of_edges([pair.profile.rounding for pair in pairs])
        self.friction = of_edges([pair.friction for pair in pairs])
        self.tied, self.moves = of_edges([pair.tied for pair in pairs], bool), self.spans[:, MOVES].astype(bool)
        self._profiles, self._owner = [pair.profile for pair in pairs], of_edges(np.arange(len(pairs)), int)
        # As many points as an edge brings freedoms along its normal: more of them would lock on a curved tool. An edge
        # that is tied takes one more, which holds all of its nodes. What is left over has no weight.
        few, many, nodes = leggauss(order), leggauss(order + 1), NODE_RULES[order]
        at_nodes = of_edges([pair.at_nodes for pair in pairs], bool)[:, None]
        along, weight = (np.where(at_nodes, own, np.where(self.tied[:, None], more, np.append(less, 0.0)))
                         for less, more, own in zip(few, many, nodes, strict=True))
        lines = np.linspace(-1.0, 1.0, order + 1)
        self.shapes = np.stack([np.prod([(along - other) / (own - other) for other in lines if other != own], axis=0)
                                for own in lines], axis=-1)
        self.places = np.einsum("mqa,mai->mqi", self.shapes, mesh.nodes[self.edges])
        ends_of_edge = mesh.nodes[self.edges[:, [0, -1]]]
        length = np.linalg.norm(ends_of_edge[:, 1] - ends_of_edge[:, 0], axis=-1)[:, None]
        # Each point's share of the area: 2 pi r times half the length times its weight.
        self.areas = np.pi * length * weight * self.places[..., 0]
        # A node on the axis has no area, but must not be left alone.
        on_axis = at_nodes & (self.places[..., 0] == 0.0)
        held_by = self.areas + 0.25 * on_axis * self.areas.max(axis=1, keepdims=True)
        for shares in (self.areas, held_by):
            self._merge(shares, at_nodes[:, 0])
        self._lengths = np.divide(held_by, length, out=np.zeros_like(held_by), where=length > 0)
        self.springs = np.zeros(self.places.shape[:2])
        self.anchors = np.zeros((*self.places.shape[:2], 3))
        self.held, self.met = np.zeros_like(self.anchors), np.zeros_like(self.anchors)
        self.ways, self.slipped = np.zeros_like(self.springs), np.zeros_like(self.springs)
        self.forces, self.rates = np.zeros((*self.places.shape[:2], 2)), np.zeros((*self.places.shape[:2], 7))
        self.known_rates = np.zeros((*self.places.shape[:2], 4))

    def _merge(self, shares: np.ndarray, at_nodes: np.ndarray) -> None:
        """One point a node and body: the first edge that has it takes the `shares` of the others."""
        first: dict[tuple, tuple[int, int]] = {}
        for m in np.flatnonzero(at_nodes).tolist():
            for q, node in enumerate(self.edges[m]):
                place = first.setdefault((node, self.moves[m]), (m, q))
                if place != (m, q):
                    shares[place] += shares[m, q]
                    shares[m, q] = 0.0

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
        """Where the points are, (r, z), m, shape (m, q, 2), from nodal displacements (n, 2)."""
        return self.places + np.einsum("mqa,mai->mqi", self.shapes, displacement[self.edges])

    def gaps(self, place: np.ndarray) -> np.ndarray:
        """Signed distance of points (m, q, 2), each in the frame of its body, from its body, m, shape (m, q)."""
        gaps = np.zeros(place.shape[:2])
        for number, profile in enumerate(self._profiles):
            own = self._owner == number
            gaps[own] = profile.gap(place[own].reshape(-1, 2)).reshape(gaps[own].shape)
        return gaps
