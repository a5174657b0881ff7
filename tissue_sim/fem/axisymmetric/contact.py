"""Contact points of the surface of an axisymmetric specimen, packed in the arrays of the kernels."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.polynomial.legendre import leggauss

from tissue_sim.experiment.tools.tool import Profile
from tissue_sim.fem.axisymmetric.array_layouts import SURFACE_ARRAYS
from tissue_sim.fem.contact.pairs import ContactPair, ContactPairs, PenaltySettings
from tissue_sim.fem.taichi.origins import copy_to_addressable_array
from tissue_sim.mesh import Mesh

#: Penalty stiffness of the contact points.
PENALTY = PenaltySettings(normal=3e3, stick_factor=30.0)
#: Element order -> points and weights on [-1, 1] of the quadrature with the nodes of an edge: trapezoidal and Simpson's
#: rule.
NODE_RULES = {1: (np.array([-1.0, 1.0]), np.array([1.0, 1.0])),
              2: (np.array([-1.0, 0.0, 1.0]), np.array([1.0, 4.0, 1.0]) / 3.0)}


class OutlineSpanColumn(IntEnum):
    """Columns of `ContactPoints.spans`: segments of a body's outline that a contact point may touch.

    Attributes:
        FIRST_LINE: index of the first line segment of the outline.
        END_LINE: one more than the index of the last line segment.
        SHAFT: index of the first line segment of the shaft, where the friction of the shaft begins.
        MOVES: 1 if the body moves with the tool, 0 if the body rests.
        STAYS: 1 if the point stays on the body even under tension, else 0.
    """

    FIRST_LINE = 0
    END_LINE = 1
    SHAFT = 2
    MOVES = 3
    STAYS = 4


class ContactLinearisationColumn(IntEnum):
    """Columns of `ContactPoints.rates`: linearisation of the contact force of a point.

    Attributes:
        RR, RZ, ZR, ZZ: derivative of the contact force with respect to the displacement of the point, N/m.
        NORMAL_R, NORMAL_Z: outward unit normal of the body.
        FRICTION: coefficient of the active friction; 0 if no friction acts.
        MISSED_R, MISSED_Z: residual of the contact constraint, m.
        LAW_RR, LAW_RZ, LAW_ZZ: the part of the derivative that results from contact laws (adhesion), N/m.
        ON_SHAFT: 1 if the point has the friction of the shaft, 0 if it has that of the face.
    """

    RR = 0
    RZ = 1
    ZR = 2
    ZZ = 3
    NORMAL_R = 4
    NORMAL_Z = 5
    FRICTION = 6
    MISSED_R = 7
    MISSED_Z = 8
    LAW_RR = 9
    LAW_RZ = 10
    LAW_ZZ = 11
    ON_SHAFT = 12


class FactorisedRateColumn(IntEnum):
    """Columns of `ContactPoints.known_rates`: contact derivatives that the factorised matrix contains, N/m.

    Attributes:
        RR, RZ, ZR, ZZ: derivative of the contact force with respect to the displacement of the point.
        LAW_RR, LAW_RZ, LAW_ZZ: the part of the derivative that results from contact laws.
    """

    RR = 0
    RZ = 1
    ZR = 2
    ZZ = 3
    LAW_RR = 4
    LAW_RZ = 5
    LAW_ZZ = 6


#: Number of columns of `ContactPoints.rates`.
RATE_COLUMNS = len(ContactLinearisationColumn)
#: Number of columns of `ContactPoints.known_rates`.
KNOWN_RATE_COLUMNS = len(FactorisedRateColumn)


class ContactPoints:
    """Contact points of the tissue surface, packed in the arrays that the kernel of a step reads and writes.

    A node is one contact point for the bodies that rest and one for the bodies that move, in the first pair that
    contains the node. Without contact the arrays contain one unused point.

    Attributes:
        count: number of contact points, n below; 0 without contact.
        nodes: nodes of the edge of each point, shape (n, a).
        shapes: shape functions of these nodes at the point, shape (n, a).
        spans: columns of `OutlineSpanColumn`, shape (n, 5).
        lines: line segments of the outlines of all bodies, one outline after the other, with the columns
            `tissue_sim.experiment.tools.tool.OutlineLineColumn`, shape (lines, 5).
        rounding: edge radius of each point's body, m, shape (n,).
        friction: coefficients of the face and of the shaft of each point's body, shape (n, 2).
        places: (r, z) of the undeformed points, m, shape (n, 2).
        face: numbers of the points under a face without slip of the tool.
        areas: surface area of each point, m2, shape (n,).
        springs: penalty stiffness of each point, N/m, shape (n,).
        anchors: bond (a `tissue_sim.fem.contact.pairs.ContactBondState`) and anchor of each point at the last
            equilibrium; the anchor is the displacement of the point in the frame of the body, (r, z), m; shape (n, 3).
        initial: bond and anchor at the beginning of a step, with the bonds of points that the tool reaches in the step,
            shape (n, 3).
        held: bond and anchor during a step, shape (n, 3).
        met: bond and anchor for the next step if this step converges, shape (n, 3).
        pressed: 1 where a point is in the active set of the normal contact, else 0, shape (n,).
        slip_signs: direction of slip along the surface during a step, 1, -1 or 0 (no slip), shape (n,).
        slipped: `slip_signs` at the last equilibrium, shape (n,).
        forces: forces of the tissue on the bodies, N, shape (n, 2).
        rates: columns of `ContactLinearisationColumn`, shape (n, `RATE_COLUMNS`).
        known_rates: columns of `FactorisedRateColumn`, N/m, shape (n, `KNOWN_RATE_COLUMNS`).
    """

    def __init__(self, mesh: Mesh, contact: ContactPairs | None):
        pairs = () if contact is None else contact.pairs
        order = mesh.element.order
        # Each point: pair, nodes of the edge, coordinate on the edge. Each edge: nodes, its points, their weights.
        points: list[tuple[ContactPair, np.ndarray, float]] = []
        numbers: dict[tuple[int, bool], int] = {}
        edges: list[tuple[np.ndarray, list[int], np.ndarray]] = []
        for pair in pairs:
            coordinates, weights = leggauss(order) if pair.between_nodes else NODE_RULES[order]
            for edge in pair.surface:
                at = []
                for node, coordinate in zip(edge.tolist(), coordinates.tolist(), strict=False):
                    number = len(points) if pair.between_nodes else numbers.setdefault((node, pair.moves), len(points))
                    if number == len(points):
                        points.append((pair, edge, coordinate))
                    at.append(number)
                edges.append((edge, at, weights))
        self.count = len(points)
        if not points:
            plane = Profile([(0.0, 0.0), (1.0, 0.0)], 0.0, 0)
            unused = ContactPair(plane, np.zeros((1, order + 1), np.int32), (0.0, 0.0))
            points = [(unused, unused.surface[0], 0.0)]
        owners, n = [pair for pair, _edge, _coordinate in points], len(points)
        self.nodes = np.array([edge for _pair, edge, _coordinate in points], dtype=np.int32)
        along = np.array([coordinate for _pair, _edge, coordinate in points])
        lines = np.linspace(-1.0, 1.0, order + 1)
        self.shapes = np.stack([np.prod([(along - other) / (own - other) for other in lines if other != own], axis=0)
                                for own in lines], axis=-1)
        self.places = np.einsum("na,nai->ni", self.shapes, mesh.nodes[self.nodes])
        self._profiles = list({id(pair.profile): pair.profile for pair in owners}.values())
        number_of = {id(profile): k for k, profile in enumerate(self._profiles)}
        self._owner = np.array([number_of[id(pair.profile)] for pair in owners])
        self.lines = np.concatenate([profile.lines for profile in self._profiles])
        ends = np.cumsum([len(profile.lines) for profile in self._profiles])
        firsts = ends - [len(profile.lines) for profile in self._profiles]
        self.spans = np.array([
            (firsts[k] + pair.first_line, ends[k], firsts[k] + pair.profile.shaft, pair.moves, pair.stays)
            for k, pair in zip(self._owner, owners, strict=True)], dtype=np.int32)
        self.rounding = np.array([pair.profile.rounding for pair in owners])
        self.friction = np.array([pair.friction for pair in owners], dtype=float)
        self.tied = np.array([pair.tied for pair in owners])
        self.moves = self.spans[:, OutlineSpanColumn.MOVES].astype(bool)
        self.face = np.flatnonzero(self.tied & self.moves)
        self.areas, self._lengths, self.springs = np.zeros((3, n))
        for edge, at, weights in edges:
            # The area of a point is 2 pi r times half the length of the edge times the weight of the point.
            length = float(np.linalg.norm(mesh.nodes[edge[-1]] - mesh.nodes[edge[0]]))
            r = self.places[at, 0]
            areas = np.pi * length * weights * r
            self.areas[at] += areas
            # A point on the axis has no area but needs a penalty stiffness.
            self._lengths[at] += (areas + 0.25 * areas.max() * (r == 0.0)) / length
        self.anchors, self.initial, self.held, self.met = np.zeros((4, n, 3))
        self.pressed, self.slip_signs, self.slipped = np.zeros((3, n))
        self.forces, self.rates = np.zeros((n, 2)), np.zeros((n, RATE_COLUMNS))
        self.known_rates = np.zeros((n, KNOWN_RATE_COLUMNS))
        for name in SURFACE_ARRAYS.types.keys() & vars(self):
            setattr(self, name, copy_to_addressable_array(getattr(self, name)))

    @property
    def has_coulomb_friction_points(self) -> bool:
        """Whether any contact point has Coulomb friction, so that the point can slip and the tangent is unsymmetric."""
        return bool((self.friction > 0.0).any())

    def set_penalty_stiffness(self, modulus: float) -> None:
        """Set the penalty stiffness (`springs`) of all contact points, and the attribute `rounding_rate`.

        `rounding_rate` is the force that rounding errors of displacements cause, N per m of displacement.

        Args:
            modulus: penalty stiffness per area, times the length of the edge, Pa.
        """
        self.springs[:] = modulus * self._lengths
        self.rounding_rate = np.finfo(float).eps * float(np.linalg.norm(self.springs))

    def deformed_positions(self, displacement: np.ndarray, points: np.ndarray | None = None) -> np.ndarray:
        """Return the positions (r, z) of contact points on the deformed surface, m, shape (points, 2).

        Args:
            displacement: displacements of the nodes, m, shape (nodes, 2).
            points: numbers of the points; None: all.
        """
        places, shapes, nodes = self.places, self.shapes, self.nodes
        if points is not None:
            places, shapes, nodes = places[points], shapes[points], nodes[points]
        return places + np.einsum("na,nai->ni", shapes, displacement[nodes])

    def signed_gaps(self, place: np.ndarray, points: np.ndarray | None = None) -> np.ndarray:
        """Return the signed distance of contact points from their rigid bodies, m, shape (points,); negative inside.

        Args:
            place: positions (r, z) of the points in the frames of their bodies, m, shape (points, 2).
            points: numbers of the points; None: all.
        """
        gaps, owner = np.zeros(len(place)), self._owner if points is None else self._owner[points]
        for number, profile in enumerate(self._profiles):
            own = owner == number
            gaps[own] = profile.gap(place[own])
        return gaps
