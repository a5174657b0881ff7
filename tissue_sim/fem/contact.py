"""Unilateral contact of the free surface with a rigid tool, at the Gauss points of the element edges.

Augmented Lagrangian (Simo and Laursen, Computers & Structures 42 (1992) 97): the force of a point is its multiplier,
which is the force of the last equilibrium, plus that of a spring for the distance by which the point violates the
contact condition. A point without slip is held where it touched, the others are only pushed along the normal. An
equilibrium whose violation exceeds the tolerance makes its forces the multipliers and is solved again. Everything
derives from an energy, so the tangent is symmetric. The multipliers stand in the state behind the pressures and are
extrapolated with it.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.polynomial.legendre import leggauss

from tissue_sim.fem.band import add_entry_function
from tissue_sim.fem.runtime import initialise
from tissue_sim.mesh import Mesh
from tissue_sim.tool import Profile

#: Spring stiffness in units of mu0 over the length of the element edge.
STIFFNESS = 3e3
#: How many times stiffer a point without slip is held: it never chatters, and a soft hold lets a sharp edge buckle the
#: tissue.
HOLD = 30.0
#: Deepest penetration that is accepted, in radii of the tool.
TOLERANCE = 1e-4


@dataclass(frozen=True, eq=False)
class Contact:
    """Which edges may meet which tool, and how.

    Attributes:
        profile: outline of the tool.
        edges: nodes of the element edges that are watched, shape (m, nodes of an edge).
        first_line: line of the profile's chain from which on each edge may meet it, shape (m,).
        tied: edges that an interface without slip holds from the start, shape (m,).
        stick: whether the face and the shaft hold what they touch.
        radius: of the tool, m; the measure of penetration.
    """

    profile: Profile
    edges: np.ndarray
    first_line: np.ndarray
    tied: np.ndarray
    stick: tuple[bool, bool]
    radius: float

    @property
    def tolerance(self) -> float:
        """Deepest penetration that is accepted, m."""
        return TOLERANCE * self.radius


class ContactPoints:
    """The arrays that a step's kernel works on; without contact they hold one edge that is never looked at."""

    def __init__(self, mesh: Mesh, contact: Contact | None):
        order = mesh.element.order
        self.count = 0 if contact is None else len(contact.edges)
        if contact is None:
            none = Profile(np.zeros((2, 2)), 0.0, 0)
            contact = Contact(none, np.zeros((1, order + 1)), np.zeros(1), np.zeros(1, bool), (False, False), 0.0)
        self.edges, self.first_line = contact.edges.astype(np.int32), contact.first_line.astype(np.int32)
        self.vertices = contact.profile.vertices.copy()
        tied = contact.tied[:, None]
        # As many points as an edge brings freedoms along its normal: more of them would lock on a curved tool. An edge
        # that is tied takes one more, which holds all of its nodes. What is left over has no weight.
        few, many = leggauss(order), leggauss(order + 1)
        along, weight = (np.where(tied, more, np.append(less, 0.0)) for less, more in zip(few, many, strict=True))
        lines = np.linspace(-1.0, 1.0, order + 1)
        self.shapes = np.stack([np.prod([(along - other) / (own - other) for other in lines if other != own], axis=0)
                                for own in lines], axis=-1)
        self.places = np.einsum("mqa,mai->mqi", self.shapes, mesh.nodes[self.edges])
        # Each point's share of the area, 2 pi r times half the length times its weight, over the length.
        self._area_per_length = np.pi * weight * self.places[..., 0]
        self.springs = np.zeros(self.places.shape[:2])
        # Held (1) or not (0), and where, in the frame of the tool.
        self.anchors = np.zeros((*self.places.shape[:2], 3))
        self.held, self.met = np.zeros_like(self.anchors), np.zeros_like(self.anchors)
        self.forces = np.zeros((*self.places.shape[:2], 2))

    def set_stiffness(self, modulus: float) -> None:
        """Springs of this many Pa over the length of their edge."""
        self.springs[:] = modulus * self._area_per_length

    def positions(self, displacement: np.ndarray) -> np.ndarray:
        """Where the points are, (r, z), m, shape (m, q, 2), from nodal displacements (n, 2)."""
        return self.places + np.einsum("mqa,mai->mqi", self.shapes, displacement[self.edges])


@cache
def functions():
    """Taichi functions ``add_contact``, ``augment`` and ``hold``."""
    ti = initialise()
    add_entry = add_entry_function()
    far = 1e30

    @ti.func
    def nearest(r, z, first, vertices: ti.template(), rounding):
        """Gap, outward normal, curvature of the surface, and line of the chain that is nearest to (r, z)."""
        best, gap, nr, nz, curved, line = far, far, 0.0, 0.0, 0.0, first
        front_best = 0.0
        last = vertices.shape[0] - 2
        for s in range(first, last + 1):
            tr, tz = vertices[s + 1, 0] - vertices[s, 0], vertices[s + 1, 1] - vertices[s, 1]
            length = ti.sqrt(tr * tr + tz * tz)
            tr, tz = tr / length, tz / length
            dr, dz = r - vertices[s, 0], z - vertices[s, 1]
            along = dr * tr + dz * tz
            share = ti.min(ti.max(along, 0.0), length)
            dr, dz = dr - share * tr, dz - share * tz
            distance = ti.sqrt(dr * dr + dz * dz)
            front = dr * tz - dz * tr
            # At a vertex two lines are equally near: the one that the point stands farther in front of decides.
            if distance < best - 1e-15 or (distance < best + 1e-15 and ti.abs(front) > ti.abs(front_best)):
                best, front_best, line = distance, front, s
                # Before the start of the chain there is no inside.
                inside = front < 0.0 and not (s == first and along <= 0.0)
                sign = -1.0 if inside else 1.0
                gap = sign * distance - rounding
                beyond = along < 0.0 or along > length
                nr, nz, curved = tz, -tr, 0.0
                if beyond and distance > 0.0:
                    nr, nz = sign * dr / distance, sign * dz / distance
                    curved = 1.0 / distance
        return gap, nr, nz, curved, line

    @ti.func
    def place(m, q, lift, edges: ti.template(), shapes: ti.template(), places: ti.template(), x: ti.template()):
        """Where a point is, in the frame of the tool."""
        r, z = places[m, q, 0], places[m, q, 1] + lift
        for a in range(shapes.shape[2]):
            r += shapes[m, q, a] * x[2 * edges[m, a]]
            z += shapes[m, q, a] * x[2 * edges[m, a] + 1]
        return r, z

    @ti.func
    def add_contact(count, tangent, pending, bending, move, lift, free, width, rounding, shaft, stick_face, stick_shaft,
                    multipliers, edges: ti.template(), shapes: ti.template(), places: ti.template(),
                    first_line: ti.template(), vertices: ti.template(), springs: ti.template(), held: ti.template(),
                    met: ti.template(), forces: ti.template(), x: ti.template(), target: ti.template(),
                    equation: ti.template(), residual: ti.template(), entries: ti.template()):
        """Add the contact forces to the residual and their rates to the band matrix.

        `lift` takes z into the frame of the tool, `move` is what the tool still has to go down in this step. Returns
        the axial force on the tool and the largest violation of the contact conditions.
        """
        axial, violation = 0.0, 0.0
        n = shapes.shape[2]
        slack = 1e-9 if pending == 1 else 0.0
        for m in range(count):
            for q in range(places.shape[1]):
                r, z = place(m, q, lift, edges, shapes, places, x)
                gap, nr, nz, curved, line = nearest(r, z, first_line[m], vertices, rounding)
                stick = stick_face
                if line >= shaft and curved == 0.0:
                    stick = stick_shaft
                spring = springs[m, q]
                at = multipliers + 2 * (m * places.shape[1] + q)
                normal = ti.min(x[at] * nr + x[at + 1] * nz, 0.0) + spring * gap
                fr, fz, krr, krz, kzz = 0.0, 0.0, 0.0, 0.0, 0.0
                met[m, q, 0] = 0.0
                if held[m, q, 0] > 0.0:
                    spring *= HOLD
                    dr, dz = r - held[m, q, 1], z - held[m, q, 2]
                    fr, fz = x[at] + spring * dr, x[at + 1] + spring * dz
                    krr, kzz = spring, spring
                    violation = ti.max(violation, ti.sqrt(dr * dr + dz * dz))
                elif spring > 0.0 and (normal < 0.0 or gap < slack):
                    fr, fz = normal * nr, normal * nz
                    bend = bending * normal * curved
                    krr = spring * nr * nr + bend * nz * nz
                    krz = (spring - bend) * nr * nz
                    kzz = spring * nz * nz + bend * nr * nr
                    violation = ti.max(violation, ti.abs(gap))
                    if stick == 1:
                        met[m, q, 0], met[m, q, 1], met[m, q, 2] = 1.0, r - gap * nr, z - gap * nz
                forces[m, q, 0], forces[m, q, 1] = fr, fz
                axial += fz
                if krr + kzz > 0.0:
                    if pending == 1:
                        # The way of the tool, and that of nodes which follow it.
                        pr, pz = 0.0, move
                        for a in range(n):
                            dof = 2 * edges[m, a]
                            if equation[dof] >= free:
                                pr += shapes[m, q, a] * (target[dof] - x[dof])
                            if equation[dof + 1] >= free:
                                pz += shapes[m, q, a] * (target[dof + 1] - x[dof + 1])
                        fr += krr * pr + krz * pz
                        fz += krz * pr + kzz * pz
                    for a in range(n):
                        ir, iz = equation[2 * edges[m, a]], equation[2 * edges[m, a] + 1]
                        residual[ir] = residual[ir] + shapes[m, q, a] * fr
                        residual[iz] = residual[iz] + shapes[m, q, a] * fz
                        if tangent == 1:
                            for b in range(n):
                                share = shapes[m, q, a] * shapes[m, q, b]
                                jr, jz = equation[2 * edges[m, b]], equation[2 * edges[m, b] + 1]
                                add_entry(ir, jr, share * krr, free, width, entries)
                                add_entry(ir, jz, share * krz, free, width, entries)
                                add_entry(iz, jr, share * krz, free, width, entries)
                                add_entry(iz, jz, share * kzz, free, width, entries)
        return axial, violation

    @ti.func
    def augment(count, multipliers, rounding, first_line: ti.template(), vertices: ti.template(), held: ti.template(),
                forces: ti.template(), x: ti.template()):
        """Make the forces of an equilibrium the multipliers, and let go of edges that pull; returns how many do.

        What an edge holds, it holds or lets go as a whole: point by point the tractions beside a sharp edge oscillate,
        and their average tells whether it is pulled. The equilibrium decides, not the way to it.
        """
        released = 0
        for m in range(count):
            pull = 0.0
            for q in range(forces.shape[1]):
                at = multipliers + 2 * (m * forces.shape[1] + q)
                x[at], x[at + 1] = forces[m, q, 0], forces[m, q, 1]
                if held[m, q, 0] > 0.0:
                    _, nr, nz, _, _ = nearest(held[m, q, 1], held[m, q, 2], first_line[m], vertices, rounding)
                    pull += nr * forces[m, q, 0] + nz * forces[m, q, 1]
            if pull > 0.0:
                released += 1
                for q in range(forces.shape[1]):
                    held[m, q, 0] = 0.0
        return released

    @ti.func
    def hold(count, held: ti.template(), met: ti.template()):
        """Let an interface without slip hold what it met in this step."""
        for m in range(count):
            for q in range(held.shape[1]):
                if met[m, q, 0] > 0.0:
                    for i in ti.static(range(3)):
                        held[m, q, i] = met[m, q, i]

    return add_contact, augment, hold
