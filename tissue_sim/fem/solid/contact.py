"""Contact of a solid's surface nodes with rigid bodies of revolution.

The method is a primal-dual active set strategy (Hüeber and Wohlmuth, Comput. Methods Appl. Mech. Eng. 194 (2005) 3147),
as in the axisymmetric solver (`tissue_sim.fem.axisymmetric.contact_kernels`). The contact force of a node is an unknown
besides its displacement. A penalty stiffness eliminates the forces node by node, and the next iteration removes the
error of the penalty. The active set is decided by the force plus a small stiffness times the gap. Only the diagonal
blocks of the nodes in the matrix change.

Forces are those of the tissue on the body, as in the residual; normals point out of the body.

`ToolFrame` is the frame of the tool relative to the mesh.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tissue_sim.fem.contact.laws import NodalContactLaws
from tissue_sim.fem.contact.pairs import ALL_POINTS, SOLID_PENALTY, ActiveSetSettings, ContactBondState, ContactPair
from tissue_sim.fem.contact.surface_geometry import find_nearest_surface_geometry
from tissue_sim.pose import Pose


class ToolShapeRates(NamedTuple):
    """Derivatives of gaps and normals at fixed positions in the frame of the tool with respect to m sizes of the tool.

    Attributes:
        gap: m per unit of the parameter, shape (n, 1, m).
        normal: in the frame of the mesh, 1 per unit of the parameter, shape (n, 3, m).
    """

    gap: np.ndarray
    normal: np.ndarray


class NodalContactState(NamedTuple):
    """State of all contact nodes; see `tissue_sim.fem.solid.contact.ContactNodes`. Shapes are (n,) if not stated.

    Attributes:
        held: held where they touched, without slip.
        pressed: pressed against a body.
        sticks: pressed and stuck by friction.
        slides: pressed and slipping.
        goes: slipping far enough that the direction of slip is defined.
        keeps: whether the stick anchor stays.
        met: whether the node touches a body at this equilibrium and is bound to it in the next step.
        near: near enough for additional contact laws.
        gap: m.
        normal: force along the normal, N.
        limit: limit of friction, N.
        friction: coefficient of friction, 1.
        on_shaft: whether the friction is that of the shaft.
        springs: penalty stiffness of the gap, N/m.
        holds: penalty stiffness of the slip, N/m.
        normals: outward normals of the bodies, shape (n, 3).
        slip: since the last equilibrium, m, shape (n, 3).
        ways: directions of slip, shape (n, 3).
        curved: derivative of the normals with respect to position, 1/m, shape (n, 3, 3).
        turn: rotation matrix from the frame of the body to that of the mesh, shape (n, 3, 3).
    """

    held: np.ndarray
    pressed: np.ndarray
    sticks: np.ndarray
    slides: np.ndarray
    goes: np.ndarray
    keeps: np.ndarray
    met: np.ndarray
    near: np.ndarray
    gap: np.ndarray
    normal: np.ndarray
    limit: np.ndarray
    friction: np.ndarray
    on_shaft: np.ndarray
    springs: np.ndarray
    holds: np.ndarray
    normals: np.ndarray
    slip: np.ndarray
    ways: np.ndarray
    curved: np.ndarray
    turn: np.ndarray

    def differentiate_forces_and_residuals(self, motion: np.ndarray, anchors: np.ndarray, shape: ToolShapeRates,
                                           forces: np.ndarray, frictions: np.ndarray
                                           ) -> tuple[np.ndarray, np.ndarray]:
        """Differentiate the contact forces and the constraint residuals with respect to m parameters.

        Args:
            motion: derivatives of the nodal positions with respect to m parameters, shape (n, 3, m).
            anchors: derivatives of the anchors in the frames of their bodies, shape (n, 3, m).
            shape: derivatives of gaps and normals at fixed positions.
            forces: present iterate of the derivatives of the forces, shape (n, 3, m).
            frictions: derivatives of the coefficients of friction, shape (n, m).

        Returns:
            Derivatives of the contact forces, and derivatives of the constraint residuals times the penalty stiffness,
            N per parameter, shape (n, 3, m) each.
        """
        n, way, springs = self.normals[:, :, None], self.ways[:, :, None], self.springs[:, None, None]
        gap = _compute_components_along(n, motion) + shape.gap
        slipped = motion - self.turn @ anchors
        tilt = self.curved @ motion + shape.normal
        # Derivative of the tangential part of the slip.
        slip = self.slip[:, :, None]
        along = slipped - (_compute_components_along(n, slipped)
                           + _compute_components_along(slip, tilt)) * n - _compute_components_along(slip, n) * tilt
        flat = self.slip - np.einsum("ni,ni->n", self.slip, self.normals)[:, None] * self.normals
        length = np.where(self.goes, np.linalg.norm(flat, axis=1), np.inf)
        steered = (along - _compute_components_along(way, along) * way) / length[:, None, None]
        limit, mu = self.limit[:, None, None], self.friction[:, None, None]
        free_normal = _compute_components_along(n, forces)
        normal = free_normal - np.where(_reshape_mask_for_broadcast(self.slides),
                                        limit * _compute_components_along(n, steered), 0.0)
        smooth = normal * n + self.normal[:, None, None] * tilt
        pressure = np.maximum(-self.normal, 0.0)[:, None, None]
        sliding = smooth - mu * normal * way + limit * steered + pressure * way * frictions[:, None]
        stuck = _reshape_mask_for_broadcast(self.held | self.sticks)
        found = np.where(stuck, forces, np.where(_reshape_mask_for_broadcast(self.slides), sliding, smooth))
        acts = _reshape_mask_for_broadcast(self.held | self.pressed)
        missing = springs * gap * (n - np.where(_reshape_mask_for_broadcast(self.slides), mu * way, 0.0))
        holds = self.holds[:, None, None]
        missing = np.where(_reshape_mask_for_broadcast(self.sticks),
                           missing + holds * (slipped - _compute_components_along(n, slipped) * n), missing)
        missing = np.where(_reshape_mask_for_broadcast(self.held), holds * slipped, missing)
        return np.where(acts, found, 0.0), np.where(acts, missing, 0.0)

    def differentiate_anchors(self, motion: np.ndarray, anchors: np.ndarray, shape: ToolShapeRates) -> np.ndarray:
        """Return the derivatives of the anchors that follow from this equilibrium, m per parameter, shape (n, 3, m).

        For the arguments see `differentiate_forces_and_residuals`.
        """
        n = self.normals[:, :, None]
        gap = _compute_components_along(n, motion) + shape.gap
        tilted = self.gap[:, None, None] * (self.curved @ motion + shape.normal)
        surface = self.turn.swapaxes(1, 2) @ (motion - gap * n - tilted)
        return np.where(_reshape_mask_for_broadcast(self.held | self.keeps), anchors,
                        np.where(_reshape_mask_for_broadcast(self.met), surface, 0.0))

    @property
    def discrete_contact_flags(self) -> np.ndarray:
        """Flags held, pressed, sticks, slides and near of each node, shape (5, n).

        If a flag changes between two equilibria, the force has a kink as a function of the parameters.
        """
        return np.stack([self.held, self.pressed, self.sticks, self.slides, self.near])


def _compute_components_along(direction: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return the components of vectors, shape (n, 3, m), along unit vectors, (n, 3, 1); shape (n, 1, m)."""
    return (direction * vectors).sum(axis=1, keepdims=True)


def _reshape_mask_for_broadcast(mask: np.ndarray) -> np.ndarray:
    """Reshape a mask of the nodes from (n,) to (n, 1, 1)."""
    return mask[:, None, None]


class ToolFrame:
    """Rotation and position of the tool in the frame of the mesh.

    Args:
        pose: pose of the tool in the frame of the scene.
        datum: height of the scene's origin in the frame of the mesh, m.

    Attributes:
        rotation: rotation matrix from the frame of the tool to that of the mesh, shape (3, 3).
        origin: position of the tool's deepest point, m, shape (3,).
    """

    def __init__(self, pose: Pose, datum: float):
        w, x, y, z = pose.orientation
        self.rotation = np.array([
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]])
        x0, y0, z0 = pose.position
        self.origin = np.array([x0, y0, z0 + datum])

    def compute_origin_and_matrix_change_from(self, first: ToolFrame) -> np.ndarray:
        """Return displacement, m, and change of the rotation matrix, row by row, from another frame, shape (12,)."""
        return np.concatenate([self.origin - first.origin, (self.rotation - first.rotation).ravel()])

    def transform_to_tool(self, points: np.ndarray) -> np.ndarray:
        """Transform points from the frame of the mesh to that of the tool, m, shape (n, 3)."""
        return (points - self.origin) @ self.rotation

    def transform_to_mesh(self, points: np.ndarray) -> np.ndarray:
        """Transform points from the frame of the tool to that of the mesh, m, shape (n, 3)."""
        return points @ self.rotation.T + self.origin

    def differentiate_points(self, points: np.ndarray) -> np.ndarray:
        """Differentiate points fixed to the tool with respect to its position and a rotation about its deepest point.

        Args:
            points: positions in the frame of the mesh, m, shape (n, 3).

        Returns:
            Derivatives by displacement (columns 0 to 2, 1) and rotation vector (columns 3 to 5, m), shape (n, 3, 6).
        """
        rates = differentiate_rotated_forces(points - self.origin)
        rates[:, 0, 0] = rates[:, 1, 1] = rates[:, 2, 2] = 1.0
        return rates


def differentiate_rotated_forces(forces: np.ndarray) -> np.ndarray:
    """Differentiate forces, N, shape (n, 3), that rotate with a body, with respect to its pose, shape (n, 3, 6)."""
    rates = np.zeros((*forces.shape, 6))
    x, y, z = forces.T
    rates[:, 0, 4], rates[:, 0, 5] = z, -y
    rates[:, 1, 3], rates[:, 1, 5] = -z, x
    rates[:, 2, 3], rates[:, 2, 4] = y, -x
    return rates


def differentiate_torque_by_levers(motions: np.ndarray, forces: np.ndarray) -> np.ndarray:
    """Differentiate the torque of constant forces whose points move relative to the tool, N and N m, shape (3, 6).

    Args:
        motions: derivatives of the points with respect to the pose of the tool, shape (n, 3, 6).
        forces: forces at the points, N, shape (n, 3).
    """
    apart = motions - np.concatenate([np.eye(3), np.zeros((3, 3))], axis=1)
    return np.cross(apart, forces[:, :, None], axisa=1, axisb=1, axisc=1).sum(axis=0)


#: Radius up to which a held node belongs to the face, over the radius of the face, 1.
FACE_MARGIN = 1.001
#: Settings of the active set.
ACTIVE_SET = ActiveSetSettings(augmentation_factor=1e-5)


@dataclass(frozen=True)
class ContactViolationAndCounts:
    """Result of an evaluation of the contact, summed over all nodes.

    Attributes:
        violation: largest violation of a contact condition, m.
        slipping: number of slipping nodes.
        switched: number of nodes that changed their state.
        wanting: number of nodes whose state violates a contact condition, but that were not allowed to change it.
    """

    violation: float
    slipping: int
    switched: int
    wanting: int


class ContactNodes:
    """All nodes that may touch a body, with their contact state and forces.

    A node occurs once for the bodies at rest and once for the bodies that move.

    Args:
        pairs: contact pairs.
        places: undeformed positions of all nodes of the mesh, m, shape (nodes, 3).
        areas: surface area that each node of the mesh represents, m2, shape (nodes,).
        laws: additional contact laws of the tool.

    Attributes:
        nodes: indices in the mesh, shape (n,).
        moves, stays: `ContactPair.moves` and `ContactPair.stays` of each node, shape (n,).
        parts: contact pairs, and indices of their nodes in these arrays.
        bound: committed bond of each node to its body, a `ContactBondState`, shape (n,).
        anchors: displacements at which nodes are held or stick, in the frame of the body, m, shape (n, 3).
        pressed, slips: active sets of the present step: nodes in contact, and nodes that slip, shape (n,).
        slipped: nodes that slipped at the last equilibrium, shape (n,).
        forces: of contact and friction on the bodies, N, in the frame of the mesh, shape (n, 3).
        rates: derivative of all forces with respect to nodal motions relative to the bodies, N/m, shape (n, 3, 3).
        law_rates: derivative of the forces of the additional laws alone.
        known_rates: derivatives in the matrix, without those of the laws.
        missed: residuals of the constraints, m, shape (n, 3).
        state: state of each node at the last evaluation.
    """

    state: NodalContactState

    def __init__(self, pairs: Sequence[ContactPair], places: np.ndarray, areas: np.ndarray,
                 laws: NodalContactLaws | None = None):
        taken: dict[bool, set[int]] = {True: set(), False: set()}
        nodes, owners = [], []
        for number, pair in enumerate(pairs):
            for node in pair.surface.tolist():
                if node not in taken[pair.moves]:
                    taken[pair.moves].add(node)
                    nodes.append(node)
                    owners.append(number)
        self.pairs, self.nodes = tuple(pairs), np.array(nodes, dtype=np.intp)
        self._owner, n = np.array(owners, dtype=np.intp), len(nodes)
        self.parts = [(pair, np.flatnonzero(self._owner == number)) for number, pair in enumerate(pairs)]
        self.places, self.areas = places[self.nodes], areas[self.nodes]
        self._slack = 1e-9 * float(np.ptp(places[:, 2]))
        self.moves, self.stays = (np.array([getattr(pairs[owner], name) for owner in owners], dtype=bool)
                                  for name in ("moves", "stays"))
        self._friction = np.array([pairs[owner].friction for owner in owners], dtype=float).reshape(n, 2)
        self.springs, self.bound, self.anchors = np.zeros(n), np.zeros(n, dtype=np.int8), np.zeros((n, 3))
        self.held, self.held_at = self.bound.copy(), self.anchors.copy()
        self._met, self._met_at = self.bound.copy(), self.anchors.copy()
        self.pressed, self.slips, self.slipped = np.zeros((3, n), dtype=bool)
        self._ways, self.ways_before = np.zeros((2, n, 3))
        self._about = np.zeros(n)  # length of slip at which a node that begins to slip is aimed, m; 0: none
        self.forces, self.missed, self.normals, self._law_forces = np.zeros((4, n, 3))
        self.rates, self.known_rates, self.law_rates = np.zeros((3, n, 3, 3))
        self.laws = laws or NodalContactLaws()

    @property
    def contact_and_law_forces_by_node(self) -> np.ndarray:
        """Force of each node on its body at the last evaluation, `forces` plus the law forces, N, shape (n, 3)."""
        return self.forces + self._law_forces if self.laws else self.forces

    @property
    def has_friction(self) -> bool:
        """Whether any node may slip against friction."""
        return bool((self._friction > 0.0).any())

    def set_penalty_stiffness(self, modulus: float) -> None:
        """Set the penalty stiffness for a shear modulus of the tissue, Pa."""
        areas = np.maximum(self.areas, 1e-3 * self.areas.max(initial=0.0))
        self.springs[:] = SOLID_PENALTY.normal * modulus * np.sqrt(areas)

    def bind_nodes_at_first_touch(self, start: Pose, datum: float, displacement: np.ndarray,
                                  settled: ContactNodes | None = None) -> None:
        """Set the frame of the first touch, and bind the nodes that touch a body there, with stick or friction.

        Args:
            start: pose of the tool.
            datum: height of the scene's origin in the frame of the mesh, m.
            displacement: of the nodes of the mesh, m, shape (nodes, 3).
            settled: contact with bodies at rest in the settled state; None: the mesh is undeformed.
        """
        self._first = ToolFrame(start, datum)
        for pair, own in self.parts:
            places, moved = self.places[own], self.places[own] + displacement[self.nodes[own]]
            if pair.moves:
                places, moved = self._first.transform_to_tool(places), self._first.transform_to_tool(moved)
            touches = find_nearest_surface_geometry(pair, moved, pressed_in=True).gap <= self._slack
            self.bound[own[touches]] = ContactBondState.HELD if pair.tied else ContactBondState.TOUCHED
            self.anchors[own[touches]] = (moved - places)[touches]
        if settled is not None:
            _, here, there = np.intersect1d(np.where(self.moves, -1, self.nodes), settled.nodes, return_indices=True)
            for array, left in zip(self.state_arrays, settled.state_arrays, strict=True):
                array[here] = left[there]
        self._first_bonds = tuple(array.copy() for array in self.state_arrays)

    def restore_first_touch_contact_state(self) -> None:
        """Restore bonds, anchors, slip and forces of the first touch."""
        for array, first in zip(self.state_arrays, self._first_bonds, strict=True):
            array[:] = first

    def copy_committed_bonds_to_step(self) -> None:
        """Copy bonds, anchors and slip states of the last committed equilibrium to the step that begins."""
        self.held[:], self.held_at[:] = self.bound, self.anchors
        self.pressed[:], self.slips[:], self._ways[:], self._about[:] = False, self.slipped, self.ways_before, 0.0

    def is_pressed_in(self, frame: ToolFrame) -> bool:
        """Whether the tool is at its position of first touch, or deeper; see `ContactPair.closed`."""
        return bool(frame.origin[2] <= self._first.origin[2])

    def compute_kinematics_and_store_normals(self, displacement: np.ndarray,
                                             frame: ToolFrame) -> tuple[np.ndarray, ...]:
        """Compute displacement and gap of the nodes relative to their bodies, and store `normals`.

        Returns:
            Displacement in the frame of the body since the first touch, m, (n, 3); gap, m, (n,); derivative of the
            normals, 1/m, (n, 3, 3); whether the shaft is nearest, (n,); rotation of the frame, (n, 3, 3); meridians,
            (n, 3).
        """
        n = len(self.nodes)
        travel, gap, curved, shaft = np.zeros((n, 3)), np.zeros(n), np.zeros((n, 3, 3)), np.zeros(n, dtype=bool)
        meridians = np.zeros((n, 3))
        turn = np.broadcast_to(np.eye(3), (n, 3, 3)).copy()
        pressed_in = self.is_pressed_in(frame)
        for pair, own in self.parts:
            places = self.places[own]
            moved = places + displacement[own]
            at = frame.transform_to_tool(moved) if pair.moves else moved
            travel[own] = at - (self._first.transform_to_tool(places) if pair.moves else places)
            found = find_nearest_surface_geometry(pair, at, pressed_in)
            gap[own], shaft[own] = found.gap, found.on_shaft
            if pair.tied and pair.moves:
                # At a sharp edge, rounding would decide between the normals of face and shaft. Nodes that another part
                # of the tool holds keep the normal of that part.
                is_at_face = np.hypot(at[:, 0], at[:, 1]) < FACE_MARGIN * pair.profile.vertices[1, 0]
                found.normal[is_at_face & (self.held[own] == ContactBondState.HELD)] = [0.0, 0.0, -1.0]
            rotation = frame.rotation if pair.moves else np.eye(3)
            turn[own] = rotation
            self.normals[own], meridians[own] = found.normal @ rotation.T, found.meridian @ rotation.T
            curved[own] = rotation @ found.curvature @ rotation.T
        return travel, gap, curved, shaft, turn, meridians

    def evaluate_and_update_active_set(self, displacement: np.ndarray, frame: ToolFrame, changeable: int, slack: float,
                                       bending: float, negligible: float,
                                       tolerance: float) -> ContactViolationAndCounts:
        """Compute forces, derivatives and constraint residuals at a state, and update the active sets.

        Args:
            displacement: of the nodes, m, shape (n, 3).
            frame: frame of the tool.
            changeable: nodes that may change their state: 0 none, `ALL_POINTS`, or a number that selects a subset.
            slack: gap below which a node touches, m.
            bending: 1: the derivatives contain the curvature of the bodies and the decrease of a pull; 0: they do not.
            negligible: friction below this force is ignored, N.
            tolerance: largest permitted violation of a contact condition, m.
        """
        n = len(self.nodes)
        self.rates[:], self.missed[:] = 0.0, 0.0
        travel, gap, curved, shaft, turn, meridians = self.compute_kinematics_and_store_normals(displacement, frame)
        normals, forces, springs = self.normals, self.forces, self.springs
        augmentation, stick = ACTIVE_SET.augmentation_factor, SOLID_PENALTY.stick_factor
        mu = np.where(shaft, self._friction[:, 1], self._friction[:, 0])
        held = self.held == ContactBondState.HELD
        normal = np.einsum("ni,ni->n", forces, normals)
        normal = np.where(self.stays, normal, np.minimum(normal, 0.0))
        tangential = forces - np.einsum("ni,ni->n", forces, normals)[:, None] * normals
        trial = normal + augmentation * springs * gap
        drawn = np.full(n, changeable == ALL_POINTS)
        if 0 < changeable < ALL_POINTS:
            drawn = (7 * np.arange(n) + 5 * changeable) % ACTIVE_SET.draw_interval == 0
        switched = wanting = 0
        if changeable:
            presses = (trial < 0.0) | (gap < slack) | self.stays
            differs = (presses != self.pressed) & ~held
            switched += int((differs & drawn).sum())
            wanting += int((differs & ~drawn & (trial > 1e3 * negligible)).sum())
            self.pressed = np.where(differs & drawn, presses, self.pressed)
        pressed = self.pressed & ~held
        # Slip since the last equilibrium, along the surface, in the frame of the mesh.
        slip = np.einsum("nij,nj->ni", turn, travel - self.held_at)
        along = slip - np.einsum("ni,ni->n", slip, normals)[:, None] * normals
        violation = np.concatenate([np.linalg.norm(slip[held], axis=1), np.abs(gap[pressed]), -gap[~(pressed | held)],
                                    [0.0]]).max()
        eye, nn = np.eye(3), normals[:, :, None] * normals[:, None]
        found_forces = np.zeros((n, 3))
        # Held nodes: constraint on all three components of the slip.
        stiff = (stick * springs)[:, None, None] * eye
        self.rates[held] = stiff[held]
        self.missed[held] = slip[held]
        found_forces[held] = forces[held]
        # Pressed nodes: no penetration, and friction along the surface.
        rates = springs[:, None, None] * nn + bending * normal[:, None, None] * curved
        missed = gap[:, None] * normals
        pushed = normal[:, None] * normals
        is_bearing = mu * np.maximum(-trial, 0.0) > negligible
        rubs = pressed & (mu > 0.0) & (self.held == ContactBondState.TOUCHED) & is_bearing
        limit = mu * np.maximum(-normal, 0.0)
        length, rubbing = np.linalg.norm(along, axis=1), np.linalg.norm(tangential, axis=1)
        tried = tangential + (augmentation * stick * springs)[:, None] * along
        size = np.linalg.norm(tried, axis=1)
        if changeable and rubs.any():
            # Without slip the direction is decided by rounding errors: nodes that slipped before continue to slip.
            onwards = (np.einsum("ni,ni->n", self._ways, along) > 0.0) | (length <= 1e-3 * tolerance)
            slips = np.where(self.slips, onwards, size > mu * np.maximum(-trial, 0.0))
            differs = (slips != self.slips) & rubs
            switched += int((differs & drawn).sum())
            off = (length > 1e-3 * tolerance) | (rubbing > 1.001 * limit)
            wanting += int((differs & ~drawn & off).sum())
            begins = differs & drawn & slips
            self._ways[begins] = tried[begins] / np.maximum(size[begins], 1e-300)[:, None]
            self._about = np.where(begins, np.maximum(size - limit, 1e-300) / (augmentation * stick * springs), 0.0)
            self.slips = np.where(differs & drawn, slips, self.slips)
        sticks, sliding = rubs & ~self.slips, rubs & self.slips
        # The friction force of a slipping node is along its slip; that of a node that begins to slip is along its trial
        # force. Its slip is still the penalty error in the direction of the change of the force, which at a reversal of
        # the motion is opposite to the force.
        far = np.where(self._about > 0.0, self._about, length)
        goes = sliding & (self._about == 0.0) & (length > 1e-3 * tolerance)
        self._ways[goes] = along[goes] / length[goes, None]
        # Without slip the friction force may turn: the radial return keeps the direction of the trial force. With a
        # constant direction the iteration would discard the change of the force and not converge.
        turns = sliding & (self._about == 0.0) & ~goes & (rubbing > 0.0)
        self._ways[turns] = tangential[turns] / rubbing[turns, None]
        ways, tangent = self._ways, eye - nn
        stuck = sticks[:, None]
        rates = np.where(stuck[..., None], rates + (stick * springs)[:, None, None] * tangent, rates)
        missed, pushed = np.where(stuck, missed + along, missed), np.where(stuck, pushed + tangential, pushed)
        dragged = -(mu * springs)[:, None, None] * ways[:, :, None] * normals[:, None]
        steer = np.minimum(limit / np.maximum(far, 1e-300), stick * springs)[:, None, None]
        dragged = dragged + steer * (tangent - ways[:, :, None] * ways[:, None])
        rates = np.where(sliding[:, None, None], rates + dragged, rates)
        pushed = np.where(sliding[:, None], pushed + limit[:, None] * ways, pushed)
        violation = max(violation, length[sticks].max(initial=0.0))
        for noted, found in ((self.rates, rates), (self.missed, missed), (found_forces, pushed)):
            noted[pressed] = found[pressed]
        forces[:] = found_forces
        near = self.moves & (self.held == ContactBondState.TOUCHED) & (gap < self.laws.reach) & bool(self.laws)
        if self.laws:
            self._law_forces[:], self.law_rates[:] = 0.0, 0.0
            self._law_forces[near], self.law_rates[near] = self.laws.compute_law_forces_and_derivatives(
                self.nodes[near], gap[near], normal[near], along[near], normals[near], meridians[near], curved[near],
                bending)
            self.rates += self.law_rates
        # State of the nodes if this were an equilibrium.
        surface = travel - np.einsum("nji,nj->ni", turn, gap[:, None] * normals)
        touches = pressed | ((mu > 0.0) & (gap <= 1e-3 * tolerance))
        self._met[:] = np.where(touches & (mu < 0.0) & pressed, ContactBondState.HELD,
                                np.where(touches & (mu > 0.0), ContactBondState.TOUCHED, ContactBondState.FREE))
        keeps = sticks | (touches & ~pressed & (self.held == ContactBondState.TOUCHED))
        if self.laws:  # nodes that have touched the tool keep their anchors up to the reach of the laws
            others = self.moves & ~held & (self._met == ContactBondState.FREE) & (pressed | near)
            self._met[others] = ContactBondState.TOUCHED
            keeps = keeps | (others & (mu == 0.0) & (self.held == ContactBondState.TOUCHED))
        self._met_at[:] = np.where(keeps[:, None], self.held_at, surface)
        self.state = NodalContactState(held, pressed, sticks, sliding, goes, keeps, self._met != ContactBondState.FREE,
                                       near, gap, normal, limit, mu, shaft, springs, stick * springs, normals, slip,
                                       ways, curved, turn)
        return ContactViolationAndCounts(float(violation), int(sliding.sum()), switched, wanting)

    def store_assembled_contact_rates(self) -> None:
        """Copy `rates` without those of the laws to `known_rates`, because the factorised matrix contains them."""
        self.known_rates[:] = self.rates - self.law_rates

    def update_forces_linearly(self, motion: np.ndarray) -> None:
        """Add the linearised change after a linear solution to `forces`.

        Args:
            motion: displacement increments of the nodes relative to their bodies, m, shape (n, 3).
        """
        self.forces += np.einsum("nij,nj->ni", self.known_rates, self.missed + motion)
        self._about[:] = 0.0

    def release_pulled_nodes_and_count(self) -> int:
        """Release held nodes whose tension at an equilibrium exceeds the adhesion of the laws; return their number."""
        bears = np.where(self.moves, self.laws.compute_adhesive_pull_of_nodes_at_touch(self.nodes), 0.0)
        tension = np.einsum("ni,ni->n", self.forces, self.normals)
        pulls = (self.held == ContactBondState.HELD) & ~self.stays & (tension > bears)
        self.held[pulls] = np.where(self.moves[pulls] & (self.laws.reach > 0.0), ContactBondState.TOUCHED,
                                    ContactBondState.FREE)
        return int(pulls.sum())

    def bind_touching_nodes(self) -> None:
        """Bind the nodes to the bodies that they touch at this equilibrium, with their new anchors."""
        loose = self.held != ContactBondState.HELD
        self.held[loose], self.held_at[loose] = self._met[loose], self._met_at[loose]

    def commit_step(self) -> None:
        """Make bonds, anchors and slip states of the converged step the committed ones."""
        self.bound[:], self.anchors[:] = self.held, self.held_at
        self.slipped[:], self.ways_before[:] = self.slips & self.pressed, self._ways

    @property
    def state_arrays(self) -> tuple[np.ndarray, ...]:
        """Arrays of the committed contact state: bonds, anchors, slip, slip directions, forces.

        Writing saved copies into these arrays restores the state.
        """
        return self.bound, self.anchors, self.slipped, self.ways_before, self.forces
