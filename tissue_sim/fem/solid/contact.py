"""Contact of a solid's surface with rigid bodies of revolution, at its nodes.

The method is that of the axisymmetric solver (`tissue_sim.fem.axisymmetric.contact_kernels`), in space: a primal-dual
active set (Hüeber and Wohlmuth, Comput. Methods Appl. Mech. Eng. 194 (2005) 3147) in which the force of a node is an
unknown beside its displacement and follows the linear solution as that does. Stiff springs eliminate the forces node
by node, and the next iteration takes their error away; who presses is decided by the force plus a soft spring times
the gap. Only the blocks of the nodes themselves in the matrix are touched.

Forces here are those that the tissue exerts on the body, as in the residual; a normal points out of the body.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tissue_sim.experiment.tools.outline import Profile
from tissue_sim.fem.solid.contact_laws import NodeLaws
from tissue_sim.fem.solid.contact_state import ContactState
from tissue_sim.fem.solid.frame import Frame
from tissue_sim.pose import Pose

#: Stiffness of the springs that eliminate contact forces, in units of mu0 over the length of what a node stands for:
#: the share of the tissue in the stiffness that a step answers is too small by about its inverse.
STIFFNESS = 3e5
#: How many times stiffer a node that does not slip is held.
HOLD = 3.0
#: What an interface without slip stands for among the coefficients of friction.
STICK = -1.0
#: Share of a node's spring that weighs gap and slip against its force where its state is decided: about the stiffness
#: of the tissue.
TRIAL = 1e-5
#: How a node is bound to its body: not at all, held by an interface without slip, touching with friction.
FREE, HELD, TOUCHED = range(3)
#: All nodes may change their state at once; any other number draws a quarter of them, so that they do not go round in
#: circles together.
ALL, _DRAWN = 1_000_000, 4


@dataclass(frozen=True, eq=False)
class Body:
    """A rigid body of revolution and the nodes that it may meet.

    Attributes:
        profile: its outline, in its own frame.
        nodes: numbers of the nodes.
        friction: of its face and of its shaft: a coefficient, 0 frictionless, `STICK` no slip.
        moves: whether it moves with the tool; else its frame is that of the mesh.
        tied: whether an interface without slip holds the nodes from the start.
        stays: whether the nodes stay on it even when they are pulled.
        first_line: line of the profile's chain from which on the nodes may meet it.
        closed: whether a sharp shaft goes on downwards while the tool is pressed in: what is held below an upright face
            leaves no room there.
    """

    profile: Profile
    nodes: np.ndarray
    friction: tuple[float, float]
    moves: bool = True
    tied: bool = False
    stays: bool = False
    first_line: int = 0
    closed: bool = True


@dataclass(frozen=True)
class Nearest:
    """Of points in the frame of their body: signed distance, m, shape (n,), outward normal, (n, 3), how it turns with
    the place, 1/m, (n, 3, 3), whether the nearest place belongs to the shaft, (n,), and the direction along the outline
    there, (n, 3)."""

    gap: np.ndarray
    normal: np.ndarray
    curvature: np.ndarray
    on_shaft: np.ndarray
    meridian: np.ndarray


def nearest(body: Body, points: np.ndarray, pressed_in: bool) -> Nearest:
    """The surface of a body nearest to points in its frame, m, shape (n, 3).

    Args:
        body: the body.
        points: the points.
        pressed_in: whether it is where it touched, or deeper; see `Body.closed`.
    """
    profile, first = body.profile, body.first_line
    closed = body.closed and pressed_in and first == profile.shaft and profile.rounding == 0.0
    r = np.hypot(points[:, 0], points[:, 1])
    start, way = profile.vertices[first:-1], np.diff(profile.vertices[first:], axis=0)
    length = np.linalg.norm(way, axis=1)
    t = way / length[:, None]
    offset = np.stack([r, points[:, 2]], axis=-1)[:, None] - start  # (n, lines, 2)
    along = np.einsum("nsi,si->ns", offset, t)
    lower = np.where(closed & (np.arange(len(length)) == 0), -np.inf, 0.0)
    share = np.maximum(np.minimum(along, length), lower)
    arrow = offset - share[..., None] * t
    distance = np.linalg.norm(arrow, axis=-1)
    front = arrow[..., 0] * t[:, 1] - arrow[..., 1] * t[:, 0]
    # At a vertex two lines are equally near: the one that the point stands farther in front of decides.
    best = np.lexsort((-np.abs(front), np.round(distance, 15)), axis=-1)[:, 0]
    rows = np.arange(len(points))
    distance, front, share, along, arrow = (each[rows, best] for each in (distance, front, share, along, arrow))
    # Before the start of the chain there is no inside.
    inside = (front < 0.0) & (closed | ~((best == 0) & (along < 0.0)))
    sign = np.where(inside, -1.0, 1.0)
    beyond = (share != along) & (distance > 0.0)
    safe = np.where(distance > 0.0, distance, 1.0)
    n2 = np.where(beyond[:, None], (sign / safe)[:, None] * arrow, np.stack([t[best, 1], -t[best, 0]], axis=-1))
    bent = np.where(beyond, sign / safe, 0.0)
    outwards = np.where(r[:, None] > 0.0, points[:, :2] / np.where(r > 0.0, r, 1.0)[:, None], [1.0, 0.0])
    normal = np.concatenate([n2[:, :1] * outwards, n2[:, 1:]], axis=1)
    meridian = np.concatenate([-n2[:, 1:] * outwards, n2[:, :1]], axis=1)
    around = np.stack([-outwards[:, 1], outwards[:, 0], np.zeros(len(r))], axis=-1)
    # On the axis the surface bends alike in all directions.
    hoop = np.where(r > 1e-9 * length.max(initial=1.0), n2[:, 0] / np.where(r > 0.0, r, 1.0), bent)
    curvature = (bent[:, None, None] * meridian[:, :, None] * meridian[:, None]
                 + hoop[:, None, None] * around[:, :, None] * around[:, None])
    rounded = beyond & (profile.rounding > 0.0)
    return Nearest(sign * distance - profile.rounding, normal, curvature,
                   (best + first >= profile.shaft) & ~rounded, meridian)


@dataclass(frozen=True)
class ContactEvaluation:
    """What the contact is at a state; sums over all nodes.

    Attributes:
        violation: the largest of a contact condition, m.
        slipping: how many nodes slip.
        switched, wanting: how many changed their state, and how many should have but were not drawn.
    """

    violation: float
    slipping: int
    switched: int
    wanting: int


class ContactNodes:
    """The nodes that may meet a body, and what is known of them.

    A node is there once for the bodies that rest and once for those that move.

    Args:
        bodies: who may be met.
        places: of all nodes of the mesh, undeformed, m, shape (nodes, 3).
        areas: that each node of the mesh stands for on the surface, m2, shape (nodes,).
        laws: of contact with the tool, beside friction.

    Attributes:
        nodes: numbers, shape (n,). moves, stays: whether the body of each moves, keeps it, shape (n,).
            parts: bodies, and where their nodes are in these arrays.
        bound: `FREE`, `HELD` or `TOUCHED`; anchors: where, as a displacement in the body's frame, m, shape (n, 3).
        pressed, slips: states of a step, shape (n,); slipped: which slipped at the last equilibrium.
        forces: of contact and friction on the bodies, N, in the frame of the mesh, shape (n, 3).
        rates: of all forces with the motion of the nodes against their bodies, N/m, shape (n, 3, 3); law_rates: of laws
            alone; known_rates: in the matrix, without them. missed: by how much the constraints are, m, shape (n, 3).
        state: what each does where it was looked at last.
    """

    state: ContactState

    def __init__(self, bodies: Sequence[Body], places: np.ndarray, areas: np.ndarray,
                 laws: NodeLaws | None = None):
        taken: dict[bool, set[int]] = {True: set(), False: set()}
        nodes, owners = [], []
        for number, body in enumerate(bodies):
            for node in body.nodes.tolist():
                if node not in taken[body.moves]:
                    taken[body.moves].add(node)
                    nodes.append(node)
                    owners.append(number)
        self.bodies, self.nodes = tuple(bodies), np.array(nodes, dtype=np.intp)
        self._owner, n = np.array(owners, dtype=np.intp), len(nodes)
        self.parts = [(body, np.flatnonzero(self._owner == number)) for number, body in enumerate(bodies)]
        self.places, self.areas = places[self.nodes], areas[self.nodes]
        self._slack = 1e-9 * float(np.ptp(places[:, 2]))
        self.moves, self._tied, self.stays = (
            np.array([getattr(bodies[owner], name) for owner in owners], dtype=bool)
            for name in ("moves", "tied", "stays"))
        self._friction = np.array([bodies[owner].friction for owner in owners], dtype=float).reshape(n, 2)
        self.springs, self.bound, self.anchors = np.zeros(n), np.zeros(n, dtype=np.int8), np.zeros((n, 3))
        self.held, self.held_at = self.bound.copy(), self.anchors.copy()
        self._met, self._met_at = self.bound.copy(), self.anchors.copy()
        self.pressed, self.slips, self.slipped = np.zeros((3, n), dtype=bool)
        self._ways, self.ways_before = np.zeros((2, n, 3))
        self._about = np.zeros(n)  # how far what begins to slip is about to, m; 0: it does not just begin
        self.forces, self.missed, self.normals, self._law_forces = np.zeros((4, n, 3))
        self.rates, self.known_rates, self.law_rates = np.zeros((3, n, 3, 3))
        self.laws = laws or NodeLaws()

    @property
    def acting(self) -> np.ndarray:
        """All forces on the bodies as they were looked at last, those of the laws too, N, shape (n, 3)."""
        return self.forces + self._law_forces if self.laws else self.forces

    @property
    def has_friction(self) -> bool:
        """Whether anything can slip against friction."""
        return bool((self._friction > 0.0).any())

    def set_stiffness(self, modulus: float) -> None:
        """Springs for tissue of this shear modulus, Pa."""
        self.springs[:] = STIFFNESS * modulus * np.sqrt(np.maximum(self.areas, 1e-3 * self.areas.max(initial=0.0)))

    def bring_down(self, start: Pose, datum: float, displacement: np.ndarray,
                   settled: ContactNodes | None = None) -> None:
        """The tool stands where it first touches; bind what meets a body with friction there.

        Args:
            start: of the tool.
            datum: height of the scene's origin in the frame of the mesh, m.
            displacement: of the nodes of the mesh, m, shape (nodes, 3).
            settled: the contact with what rests in that state; None: nothing has moved yet.
        """
        self._first = Frame(start, datum)
        for body, own in self.parts:
            places, moved = self.places[own], self.places[own] + displacement[self.nodes[own]]
            if body.moves:
                places, moved = self._first.into(places), self._first.into(moved)
            touches = nearest(body, moved, pressed_in=True).gap <= self._slack
            self.bound[own[touches]] = HELD if body.tied else TOUCHED
            self.anchors[own[touches]] = (moved - places)[touches]
        if settled is not None:
            _, here, there = np.intersect1d(np.where(self.moves, -1, self.nodes), settled.nodes, return_indices=True)
            for array, left in zip(self.kept, settled.kept, strict=True):
                array[here] = left[there]
        self._first_bonds = tuple(array.copy() for array in self.kept)

    def forget(self) -> None:
        """Bonds and forces as they were at the first touch."""
        for array, first in zip(self.kept, self._first_bonds, strict=True):
            array[:] = first

    def begin(self) -> None:
        """Before a step: bonds as they are at the last equilibrium."""
        self.held[:], self.held_at[:] = self.bound, self.anchors
        self.pressed[:], self.slips[:], self._ways[:], self._about[:] = False, self.slipped, self.ways_before, 0.0

    def measure(self, displacement: np.ndarray, frame: Frame) -> tuple[np.ndarray, ...]:
        """How far each node has come in the frame of its body since the tool touched, gap, curvature, whether the shaft
        is near, turn of that frame, meridian; notes the normals."""
        n = len(self.nodes)
        travel, gap, curved, shaft = np.zeros((n, 3)), np.zeros(n), np.zeros((n, 3, 3)), np.zeros(n, dtype=bool)
        meridians = np.zeros((n, 3))
        turn = np.broadcast_to(np.eye(3), (n, 3, 3)).copy()
        pressed_in = bool(frame.origin[2] <= self._first.origin[2])
        for body, own in self.parts:
            places = self.places[own]
            moved = places + displacement[own]
            at = frame.into(moved) if body.moves else moved
            travel[own] = at - (self._first.into(places) if body.moves else places)
            found = nearest(body, at, pressed_in)
            gap[own], shaft[own] = found.gap, found.on_shaft
            rotation = frame.rotation if body.moves else np.eye(3)
            turn[own] = rotation
            self.normals[own], meridians[own] = found.normal @ rotation.T, found.meridian @ rotation.T
            curved[own] = rotation @ found.curvature @ rotation.T
        return travel, gap, curved, shaft, turn, meridians

    def evaluate(self, displacement: np.ndarray, frame: Frame, changeable: int, slack: float, bending: float,
             negligible: float, tolerance: float) -> ContactEvaluation:
        """Note forces, rates and what the constraints miss at a state.

        Args:
            displacement: of the nodes, m, shape (n, 3).
            frame: of the tool.
            changeable: who may change its state: 0 none, `ALL`, or a number that draws some.
            slack: what is nearer than this counts as touching, m.
            bending: 1 where the curvature of the bodies, and the fall of a pull, take part in the rates, 0 where not.
            negligible: friction below this is none, N.
            tolerance: how far a condition may be violated, m.
        """
        n = len(self.nodes)
        self.rates[:], self.missed[:] = 0.0, 0.0
        travel, gap, curved, shaft, turn, meridians = self.measure(displacement, frame)
        normals, forces, springs = self.normals, self.forces, self.springs
        mu = np.where(shaft, self._friction[:, 1], self._friction[:, 0])
        held = self.held == HELD
        normal = np.einsum("ni,ni->n", forces, normals)
        normal = np.where(self.stays, normal, np.minimum(normal, 0.0))
        tangential = forces - np.einsum("ni,ni->n", forces, normals)[:, None] * normals
        trial = normal + TRIAL * springs * gap
        drawn = np.full(n, changeable == ALL)
        if 0 < changeable < ALL:
            drawn = (7 * np.arange(n) + 5 * changeable) % _DRAWN == 0
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
        # Held where they touched.
        stiff = (HOLD * springs)[:, None, None] * eye
        self.rates[held] = stiff[held]
        self.missed[held] = slip[held]
        found_forces[held] = forces[held]
        # Pressed: no way into the body, and along its surface what friction says.
        rates = springs[:, None, None] * nn + bending * normal[:, None, None] * curved
        missed = gap[:, None] * normals
        pushed = normal[:, None] * normals
        rubs = pressed & (mu > 0.0) & (self.held == TOUCHED) & (mu * np.maximum(-trial, 0.0) > negligible)
        limit = mu * np.maximum(-normal, 0.0)
        length = np.linalg.norm(along, axis=1)
        tried = tangential + (TRIAL * HOLD * springs)[:, None] * along
        size = np.linalg.norm(tried, axis=1)
        if changeable and rubs.any():
            # Where nothing has slipped yet rounding would decide: what slipped goes on.
            onwards = (np.einsum("ni,ni->n", self._ways, along) > 0.0) | (length <= 1e-3 * tolerance)
            slips = np.where(self.slips, onwards, size > mu * np.maximum(-trial, 0.0))
            differs = (slips != self.slips) & rubs
            switched += int((differs & drawn).sum())
            off = (length > 1e-3 * tolerance) | (np.linalg.norm(tangential, axis=1) > 1.001 * limit)
            wanting += int((differs & ~drawn & off).sum())
            begins = differs & drawn & slips
            self._ways[begins] = tried[begins] / np.maximum(size[begins], 1e-300)[:, None]
            self._about = np.where(begins, np.maximum(size - limit, 1e-300) / (TRIAL * HOLD * springs), 0.0)
            self.slips = np.where(differs & drawn, slips, self.slips)
        sticks, sliding = rubs & ~self.slips, rubs & self.slips
        # What slips is dragged along its way, what begins to along its force: its slip is still the error of the spring
        # that held it, along the change of the force, which at a turn of the motion is against the force.
        far = np.where(self._about > 0.0, self._about, length)
        goes = sliding & (self._about == 0.0) & (length > 1e-3 * tolerance)
        self._ways[goes] = along[goes] / length[goes, None]
        ways, tangent = self._ways, eye - nn
        stuck = sticks[:, None]
        rates = np.where(stuck[..., None], rates + (HOLD * springs)[:, None, None] * tangent, rates)
        missed, pushed = np.where(stuck, missed + along, missed), np.where(stuck, pushed + tangential, pushed)
        dragged = -(mu * springs)[:, None, None] * ways[:, :, None] * normals[:, None]
        steer = np.minimum(limit / np.maximum(far, 1e-300), HOLD * springs)[:, None, None]
        dragged = dragged + steer * (tangent - ways[:, :, None] * ways[:, None])
        rates = np.where(sliding[:, None, None], rates + dragged, rates)
        pushed = np.where(sliding[:, None], pushed + limit[:, None] * ways, pushed)
        violation = max(violation, length[sticks].max(initial=0.0))
        for noted, found in ((self.rates, rates), (self.missed, missed), (found_forces, pushed)):
            noted[pressed] = found[pressed]
        forces[:] = found_forces
        near = self.moves & (self.held == TOUCHED) & (gap < self.laws.reach) & bool(self.laws)
        if self.laws:
            self._law_forces[:], self.law_rates[:] = 0.0, 0.0
            self._law_forces[near], self.law_rates[near] = self.laws.act(
                self.nodes[near], gap[near], normal[near], along[near], normals[near], meridians[near], curved[near],
                bending)
            self.rates += self.law_rates
        # What it would be bound to at an equilibrium here.
        surface = travel - np.einsum("nji,nj->ni", turn, gap[:, None] * normals)
        touches = pressed | ((mu > 0.0) & (gap <= 1e-3 * tolerance))
        self._met[:] = np.where(touches & (mu < 0.0) & pressed, HELD, np.where(touches & (mu > 0.0), TOUCHED, FREE))
        keeps = sticks | (touches & ~pressed & (self.held == TOUCHED))
        if self.laws:  # what has touched the tool remembers it up to their reach, and slips on from there
            others = self.moves & ~held & (self._met == FREE) & (pressed | near)
            self._met[others] = TOUCHED
            keeps = keeps | (others & (mu == 0.0) & (self.held == TOUCHED))
        self._met_at[:] = np.where(keeps[:, None], self.held_at, surface)
        self.state = ContactState(held, pressed, sticks, sliding, goes, keeps, self._met != FREE, near, gap, normal,
                                  limit, mu, springs, HOLD * springs, normals, slip, ways, curved, turn)
        return ContactEvaluation(float(violation), int(sliding.sum()), switched, wanting)

    def keep_rates(self) -> None:
        """Those of now, without those of laws, are those that the matrix holds of the contact."""
        self.known_rates[:] = self.rates - self.law_rates

    def follow(self, motion: np.ndarray) -> None:
        """Let the forces follow a linear solution in which the nodes moved so against their bodies, m, shape (n, 3)."""
        self.forces += np.einsum("nij,nj->ni", self.known_rates, self.missed + motion)
        self._about[:] = 0.0

    def release(self) -> int:
        """Let go of nodes that are held and pull at an equilibrium; returns how many there are."""
        bears = np.where(self.moves, self.laws.pull_of(self.nodes), 0.0)
        pulls = (self.held == HELD) & ~self.stays & (np.einsum("ni,ni->n", self.forces, self.normals) > bears)
        self.held[pulls] = np.where(self.moves[pulls] & (self.laws.reach > 0.0), TOUCHED, FREE)
        return int(pulls.sum())

    def hold(self) -> None:
        """Bind the nodes to what they met in this step."""
        loose = self.held != HELD
        self.held[loose], self.held_at[loose] = self._met[loose], self._met_at[loose]

    def commit(self) -> None:
        """After a step that converged."""
        self.bound[:], self.anchors[:] = self.held, self.held_at
        self.slipped[:], self.ways_before[:] = self.slips & self.pressed, self._ways

    @property
    def kept(self) -> tuple[np.ndarray, ...]:
        """All that a committed step leaves behind; to go back there, fill them with what they were."""
        return self.bound, self.anchors, self.slipped, self.ways_before, self.forces
