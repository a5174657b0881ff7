"""What a slow solver of the bulk publishes, and what a fast solver of the contact tells it: arrays that travel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any, Protocol

import numpy as np

from tissue_sim.fem.solver import Solver
from tissue_sim.material.material import Material
from tissue_sim.model import Model
from tissue_sim.pose import Pose
from tissue_sim.registry import Registry


class Bond(IntEnum):
    """Bond of a contact node to the tool, as in `tissue_sim.fem.solid.contact`.

    Attributes:
        FREE: the node has not touched the tool.
        HELD: an interface without slip holds the node at its anchor.
        TOUCHED: the node touches the tool with friction; the anchor is the origin of the elastic slip.
    """

    FREE = 0
    HELD = 1
    TOUCHED = 2


#: Numbers before the arrays of a packed model.
_MODEL_HEAD = 17
#: Numbers before the arrays of a packed state.
_STATE_HEAD = 19


@dataclass(frozen=True, eq=False)
class ContactSurface:
    """The nodes of a tissue that a tool may meet, and the tool; what does not change.

    Attributes:
        places: undeformed, m, shape (s, 3), in the frame of the mesh.
        springs: that eliminate contact forces, over the shear modulus, m, shape (s,).
        friction: of the tool's face and of its shaft, a coefficient or -1 for no slip, shape (s, 2).
        outlines: which of the outlines each node meets, shape (s,).
        chains: lines of the outlines, shape (outlines, lines, 5): start and direction (r, z), and length, m.
        shapes: of each outline, shape (outlines, 5): rounding, m; first line of the shaft; whether a sharp shaft goes
            on downwards; how many lines there are; radius below which a point is on the axis, m.
        bound, anchors: `FREE`, `HELD` or `TOUCHED` at the first touch, shape (s,), and where, in the frame of the tool,
            m, shape (s, 3).
        start: of the tool, where it first touches.
        datum: height of the scene's origin in the frame of the mesh, m.
        tolerance: how far a condition of the contact may be violated, m.
        radius: of the contact, m: a turn counts as the way of a point so far from the axis.
        floor: force that is as good as none for a whole test, N.
        candidates: the most nodes that a model has.
    """

    places: np.ndarray
    springs: np.ndarray
    friction: np.ndarray
    outlines: np.ndarray
    chains: np.ndarray
    shapes: np.ndarray
    bound: np.ndarray
    anchors: np.ndarray
    start: Pose
    datum: float
    tolerance: float
    radius: float
    floor: float
    candidates: int


@dataclass(frozen=True, eq=False)
class CondensedContact:
    """The bulk of a tissue as the nodes near a tool feel it: u = middle + drive m - compliance f.

    f are the forces of the nodes on the tool, and m is the tool's motion from `pose`: translation and rotation vector.
    What the tool holds goes with it, and answers wrench - stiffness m - drive^T f.

    Attributes:
        number: of the linearisation, from 1.
        base: number of the one with whose tangent it was made, whose nodes, compliance, drive and stiffness it has.
        time: when the tool was there, s. pose: of the tool then.
        nodes: numbers in the `ContactSurface`, shape (n,). A step is quick where those stand first that are loaded, and
            then those that the tool meets first.
        middle: displacements without forces, m, shape (n, 3).
        compliance: m/N, symmetric, shape (3 n, 3 n). drive: shape (3 n, 6).
        wrench: of what the tool holds, N, N m, shape (6,). stiffness: of it, shape (6, 6).
        reach: how far the tool may go from the pose before it can meet a node that is not here, m.
        modulus: shear modulus of the material, Pa.
        residual: unbalanced over balanced forces of the state that it was linearised at.
        epoch: of the `ContactState` that it follows.
        material: number of the change of material that it contains, 0: the material at the start.
        has_contact: whether the bulk was loaded by forces of the contact, or by a tool that holds it. The models of
            an undeformed tissue are equal, wherever the tool is in the air.
    """

    number: int
    base: int
    epoch: int
    time: float
    pose: Pose
    nodes: np.ndarray
    middle: np.ndarray
    compliance: np.ndarray
    drive: np.ndarray
    wrench: np.ndarray
    stiffness: np.ndarray
    reach: float
    modulus: float
    residual: float
    material: int = 0
    has_contact: bool = False

    @property
    def is_whole(self) -> bool:
        """Whether it has a tangent of its own."""
        return self.base == self.number

    @property
    def is_held(self) -> bool:
        """Whether the tool holds a part of the tissue, which moves with it."""
        return bool(self.stiffness.any())

    def packed(self) -> np.ndarray:
        """As one array of numbers: all of a whole one, of others what they do not have from their base."""
        n = len(self.nodes)
        head = (self.number, self.base, self.epoch, self.time, n, self.reach, self.modulus, self.residual,
                self.material, self.has_contact, *self.pose.position, *self.pose.orientation)
        own = [np.array(head), self.wrench, self.middle.ravel()]
        if self.is_whole:
            own += [self.nodes, self.stiffness.ravel(), self.drive.ravel(), self.compliance.ravel()]
        return np.concatenate(own)

    @classmethod
    def unpacked(cls, numbers: np.ndarray, base: CondensedContact | None = None) -> CondensedContact | None:
        """What `packed` gave, beside its base where it is not whole; None where that is another one.

        Its arrays are parts of the one given.
        """
        head = numbers[:_MODEL_HEAD].tolist()
        number, of, epoch, time, count, reach, modulus, residual, material, has_contact, *where = head
        n, rest = int(count), numbers[_MODEL_HEAD:]
        own = {"number": int(number), "base": int(of), "epoch": int(epoch), "time": time, "pose": _pose(where),
               "wrench": rest[:6], "middle": rest[6 : 6 + 3 * n].reshape(n, 3), "reach": reach, "modulus": modulus,
               "residual": residual, "material": int(material), "has_contact": bool(has_contact)}
        if number != of:
            return None if base is None or base.base != of else replace(base, **own)
        nodes, stiffness, drive, compliance = np.split(rest[6 + 3 * n :], np.cumsum([n, 36, 18 * n]))
        return cls(nodes=nodes.astype(np.intp), stiffness=stiffness.reshape(6, 6), drive=drive.reshape(3 * n, 6),
                   compliance=compliance.reshape(3 * n, 3 * n), **own)


def packed_size(surface: ContactSurface, whole: bool = True) -> int:
    """The most numbers that a packed model of a surface has."""
    n = 3 * surface.candidates
    own = _MODEL_HEAD + 6 + n
    return own + n // 3 + 36 + 6 * n + n * n if whole else own


@dataclass(frozen=True, eq=False)
class ContactState:
    """Where a fast solver of the contact is.

    Attributes:
        model: number of the model that it solved on; 0: none yet.
        epoch: how often it was set back to the untouched specimen.
        touched: whether the tool has touched the specimen since then.
        time: s. pose: of the tool.
        earlier, before: a time a little ago, s, and the pose then.
        forces: on the tool, N, shape (s, 3), of the surface's nodes.
        anchors: where nodes were bound to the tool, in its frame, m, shape (s, 3).
        states: how each is bound, whether it is pressed, and whether it slips, shape (3, s).
    """

    model: int
    epoch: int
    time: float
    pose: Pose
    earlier: float
    before: Pose
    forces: np.ndarray
    anchors: np.ndarray
    states: np.ndarray
    touched: bool = True

    def packed(self) -> np.ndarray:
        """All of it as one array of numbers."""
        head = (self.model, self.epoch, self.touched, self.time, *self.pose.position, *self.pose.orientation,
                self.earlier, *self.before.position, *self.before.orientation)
        return np.concatenate([head, self.forces.ravel(), self.anchors.ravel(), self.states.ravel()])

    @classmethod
    def unpacked(cls, numbers: np.ndarray) -> ContactState:
        """What `packed` gave."""
        model, epoch, touched, time, *where = numbers[:_STATE_HEAD].tolist()
        forces, anchors, states = np.split(numbers[_STATE_HEAD:], 3)
        return cls(int(model), int(epoch), time, _pose(where[:7]), where[7], _pose(where[8:]), forces.reshape(-1, 3),
                   anchors.reshape(-1, 3), states.reshape(3, -1), bool(touched))


def packed_state_size(surface: ContactSurface) -> int:
    """Numbers of a packed state of a surface."""
    return _STATE_HEAD + 9 * len(surface.places)


#: Computes something, here and now or beside other things; what it answers says whether that is done.
Beside = Callable[[Callable[[], None]], Callable[[], bool]]


def at_once(compute: Callable[[], None]) -> Callable[[], bool]:
    """The `Beside` of who waits."""
    compute()
    return lambda: True


class BulkLinearisation(Protocol):
    """Newton's iteration of a tissue's bulk, to whose linearisation another solver adds the contact.

    Attributes:
        beside: where tangents are condensed. While one is, iterates go on with the tangent of before.
    """

    beside: Beside

    @property
    def surface(self) -> ContactSurface:
        """What may be touched, and by what."""

    def linearise(self, state: ContactState, ahead: Sequence[Pose] = ()) -> CondensedContact | None:
        """The next iterate, where the contact has come to on the last model, and the bulk's linearisation there.

        Args:
            state: of the contact.
            ahead: poses to which the tool may go while the next tangent serves.

        Returns:
            None where the state is not of the last model, or no linearisation was found; the next call tries again.
        """

    def set_material(self, material: Material) -> None:
        """Change the material; see `Solver.set_material`."""

    @property
    def solver(self) -> Solver:
        """Whose last committed state is the last iterate, to be looked at."""


class LinearisationMaker(Protocol):
    """What stands in `LINEARISATIONS`."""

    def __call__(self, model: Model, *, resolution: str, mesh: Any = None) -> BulkLinearisation:
        """Of a model, its tool where it first touches the specimen; arguments and errors as of a `SolverMaker`."""


#: By the names of the solvers whose bulk it is.
LINEARISATIONS: Registry[LinearisationMaker] = Registry(
    "linearisation", "tissue_sim.linearisations", {"solid": "tissue_sim.fem.solid.linearisation:make_linearisation"})


def _pose(numbers: list[float]) -> Pose:
    x, y, z, a, b, c, d = numbers
    return Pose((x, y, z), (a, b, c, d))
