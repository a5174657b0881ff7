"""Messages between a slow solver of the bulk and a fast solver of the contact (multirate simulation).

The bulk publishes its linearisation, condensed to the contact nodes (`CondensedBulk`); the contact publishes its
state (`ContactState`). Both can be packed in one array of numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from tissue_sim.experiment.tools.tool import OutlineLineColumn, Profile
from tissue_sim.fem.solver import Solver
from tissue_sim.material.material import Material
from tissue_sim.model import Model
from tissue_sim.pose import Pose
from tissue_sim.registry import Registry

#: Radius over the length of the longest segment of an outline below which a point is on the axis, 1.
_ON_AXIS = 1e-9
#: Number of scalars before the arrays of a packed `CondensedBulk`.
_MODEL_HEAD = 17
#: Number of scalars before the arrays of a packed tangent.
_TANGENT_HEAD = 8
#: Number of scalars before the arrays of a packed `ContactState`.
_STATE_HEAD = 19


@dataclass(frozen=True, eq=False)
class ContactSurface:
    """Constant data of the contact: surface nodes that the tool may touch, and outline of the tool.

    Attributes:
        places: undeformed positions of the nodes in the frame of the mesh, m, shape (s, 3).
        springs: penalty stiffness over the shear modulus, m, shape (s,).
        friction: coefficients of friction of the tool's face and of its shaft, -1 for no slip, shape (s, 2).
        outlines: index of the outline that each node may touch, shape (s,).
        chains: line segments of the outlines, with the columns
            `tissue_sim.experiment.tools.tool.OutlineLineColumn`, shape (outlines, lines, 5).
        shapes: constants of the outlines, shape (outlines, 5): edge radius, m; index of the first segment of the
            shaft; 1 if a sharp shaft is extended downwards; number of segments; radius below which a point counts as
            on the axis, m.
        bound: bonds of the nodes at the first touch, each a `tissue_sim.fem.contact.pairs.ContactBondState`, shape
            (s,).
        anchors: positions in the frame of the tool where these nodes are bound, m, shape (s, 3).
        start: pose of the tool at the first touch.
        datum: height of the scene's origin in the frame of the mesh, m.
        tolerance: largest violation of a contact condition, m.
        radius: radius of the contact, m; a rotation is measured by the path of a point at this radius.
        floor: negligible force, N.
        candidates: largest number of nodes of a `CondensedBulk`.
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


def make_outline_tables(outlines: Sequence[tuple[Profile, int, bool]]) -> tuple[np.ndarray, np.ndarray]:
    """Return the arrays `ContactSurface.chains` and `ContactSurface.shapes` of the parts of a tool.

    Args:
        outlines: for each part its outline, the index of the first segment that nodes may touch, and whether a sharp
            shaft is extended downwards while the tool is pressed in.
    """
    count = max(1, len(outlines))
    lines = max((len(profile.lines) - first for profile, first, _ in outlines), default=1)
    chains, shapes = np.zeros((count, lines, 5)), np.zeros((count, 5))
    for number, (profile, first, extends) in enumerate(outlines):
        own = profile.lines[first:]
        chains[number, :len(own)] = own
        longest = own[:, OutlineLineColumn.LENGTH].max(initial=1.0)
        shapes[number] = (profile.rounding, profile.shaft - first,
                          extends and first == profile.shaft and profile.rounding == 0.0, len(own), _ON_AXIS * longest)
    return chains, shapes


@dataclass(frozen=True, eq=False)
class CondensedBulk:
    """Linearised bulk of the tissue, condensed to the contact nodes near the tool (Schur complement).

    With the linearised equations K du = -R - B^T f of the bulk, the displacements of the contact nodes are

        u = u_0 + G m - C f,    C = B K^-1 B^T,

    where u_0 = `free_displacement`, G = `tool_coupling`, C = `compliance`, B selects the contact nodes, f are the
    forces of the nodes on the tool, and m is the motion of the tool from `pose` (translation and rotation vector).
    Tissue that is bonded to the tool exerts the wrench `wrench` - `stiffness` m - G^T f on the tool.

    Attributes:
        number: number of the linearisation, from 1.
        base: number of the linearisation with the same tangent, and so the same `nodes`, `compliance`,
            `tool_coupling` and `stiffness`.
        epoch: epoch of the `ContactState` for which the linearisation was made.
        time: time of that contact state, s.
        pose: pose of the tool in that contact state.
        nodes: indices into the `ContactSurface`, shape (n,). Loaded nodes first, then the nodes that the tool touches
            next: then a step evaluates few nodes.
        free_displacement: displacements without contact forces, m, shape (n, 3).
        compliance: C, symmetric, m/N, shape (3 n, 3 n).
        tool_coupling: G, derivative of the displacements with respect to the motion of the tool, shape (3 n, 6).
        wrench: wrench of the tissue that is bonded to the tool, N and N m, shape (6,).
        stiffness: minus the derivative of `wrench` with respect to the motion of the tool, shape (6, 6).
        reach: distance from `pose` within which the tool cannot touch other nodes, m.
        modulus: shear modulus of the material, Pa.
        residual: relative residual of the state at which the bulk was linearised.
        tangent_time: time of the contact state of the iterate at which the tangent was assembled, s; earlier than
            `time` if the tangent was factorised while the iteration continued.
        tangent_pose: pose of the tool at that iterate.
        material: number of the change of material that the linearisation contains; 0: the initial material.
        has_contact: whether contact forces or a bonded tool loaded the bulk. The linearisations of undeformed tissue
            are equal for all poses of the tool in the air.
    """

    number: int
    base: int
    epoch: int
    time: float
    pose: Pose
    nodes: np.ndarray
    free_displacement: np.ndarray
    compliance: np.ndarray
    tool_coupling: np.ndarray
    wrench: np.ndarray
    stiffness: np.ndarray
    reach: float
    modulus: float
    residual: float
    tangent_time: float
    tangent_pose: Pose
    material: int = 0
    has_contact: bool = False

    @property
    def has_own_tangent(self) -> bool:
        """Whether the linearisation has its own tangent; otherwise its tangent is that of linearisation `base`."""
        return self.base == self.number

    @property
    def has_tissue_bonded_to_tool(self) -> bool:
        """Whether tissue is bonded to the tool, so that `stiffness` is nonzero."""
        return bool(self.stiffness.any())

    def pack_to_array(self) -> np.ndarray:
        """Return the linearisation as one array of numbers, for `unpack_from_array`."""
        n = len(self.nodes)
        head = (self.number, self.base, self.epoch, self.time, n, self.reach, self.modulus, self.residual,
                self.material, self.has_contact, *self.pose.position, *self.pose.orientation)
        own = [np.array(head), self.wrench, self.free_displacement.ravel()]
        if self.has_own_tangent:
            tangent = self.tangent_time, *self.tangent_pose.position, *self.tangent_pose.orientation
            own += [np.array(tangent), self.nodes, self.stiffness.ravel(), self.tool_coupling.ravel(),
                    self.compliance.ravel()]
        return np.concatenate(own)

    @classmethod
    def unpack_from_array(cls, numbers: np.ndarray, base: CondensedBulk | None = None) -> CondensedBulk | None:
        """Return the linearisation that `pack_to_array` packed.

        Args:
            numbers: array of `pack_to_array`; the arrays of the result are views of this array.
            base: a linearisation with the same tangent, needed if the packed one has no own tangent.

        Returns:
            None if `base` is needed and missing, or has another tangent.
        """
        head = numbers[:_MODEL_HEAD].tolist()
        number, base_number, epoch, time, count, reach, modulus, residual, material, has_contact, *pose = head
        n, rest = int(count), numbers[_MODEL_HEAD:]
        own = {"number": int(number), "base": int(base_number), "epoch": int(epoch), "time": time,
               "pose": _build_pose(pose), "wrench": rest[:6],
               "free_displacement": rest[6 : 6 + 3 * n].reshape(n, 3), "reach": reach, "modulus": modulus,
               "residual": residual, "material": int(material), "has_contact": bool(has_contact)}
        if number != base_number:
            return None if base is None or base.base != base_number else replace(base, **own)
        tangent, nodes, stiffness, tool_coupling, compliance = np.split(
            rest[6 + 3 * n :], np.cumsum([_TANGENT_HEAD, n, 36, 18 * n]))
        tangent_time, *tangent_pose = tangent.tolist()
        return cls(tangent_time=tangent_time, tangent_pose=_build_pose(tangent_pose), nodes=nodes.astype(np.intp),
                   stiffness=stiffness.reshape(6, 6),
                   tool_coupling=tool_coupling.reshape(3 * n, 6),
                   compliance=compliance.reshape(3 * n, 3 * n), **own)


def max_packed_linearisation_size(surface: ContactSurface, whole: bool = True) -> int:
    """Return the largest number of entries of a packed `CondensedBulk`.

    Args:
        surface: constants of the contact.
        whole: whether the linearisation has its own tangent.
    """
    n = 3 * surface.candidates
    own = _MODEL_HEAD + 6 + n
    return own + _TANGENT_HEAD + n // 3 + 36 + 6 * n + n * n if whole else own


@dataclass(frozen=True, eq=False)
class ContactState:
    """State of the contact (forces, bonds, pose of the tool), which the fast contact solver sends to the bulk.

    Attributes:
        model: number of the `CondensedBulk` on which the contact was solved; 0: none yet.
        epoch: number of resets to the untouched specimen.
        time: time, s.
        pose: pose of the tool.
        earlier: an earlier time, s.
        before: pose of the tool at the earlier time.
        forces: forces of the surface's nodes on the tool, N, shape (s, 3).
        anchors: positions in the frame of the tool where nodes are bound, m, shape (s, 3).
        states: bond (`ContactBondState`), whether pressed, and whether slipping, shape (3, s).
        touched: whether the tool has touched the specimen since the last reset.
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

    def pack_to_array(self) -> np.ndarray:
        """Return the state as one array of numbers, for `unpack_from_array`."""
        head = (self.model, self.epoch, self.touched, self.time, *self.pose.position, *self.pose.orientation,
                self.earlier, *self.before.position, *self.before.orientation)
        return np.concatenate([head, self.forces.ravel(), self.anchors.ravel(), self.states.ravel()])

    @classmethod
    def unpack_from_array(cls, numbers: np.ndarray) -> ContactState:
        """Return the state that `pack_to_array` packed."""
        model, epoch, touched, time, *poses = numbers[:_STATE_HEAD].tolist()
        forces, anchors, states = np.split(numbers[_STATE_HEAD:], 3)
        return cls(int(model), int(epoch), time, _build_pose(poses[:7]), poses[7], _build_pose(poses[8:]),
                   forces.reshape(-1, 3), anchors.reshape(-1, 3), states.reshape(3, -1), bool(touched))


def compute_packed_state_size(surface: ContactSurface) -> int:
    """Return the number of entries of a packed `ContactState` of a surface."""
    return _STATE_HEAD + 9 * len(surface.places)


#: Runs a computation at once or in a background thread, and returns a function that tells whether it is complete.
Executor = Callable[[Callable[[], None]], Callable[[], bool]]


def run_now_and_get_completion_check(compute: Callable[[], None]) -> Callable[[], bool]:
    """Run a computation before returning (synchronous `Executor`); the returned function always gives True."""
    compute()
    return lambda: True


class BulkLineariser(Protocol):
    """Interface of Newton's iteration for the bulk; a contact solver uses the linearisation of each iterate.

    A solver with this interface runs in multirate simulation; see docs/multirate.md for the rules of its results.

    Attributes:
        executor: runs the condensation of tangents. Meanwhile iterations use the previous tangent.
    """

    executor: Executor

    @property
    def surface(self) -> ContactSurface:
        """Nodes of the tissue surface and shape of the tool, constant during the simulation."""

    def iterate_and_linearise_or_none(self, state: ContactState, ahead: Sequence[Pose] = ()) -> CondensedBulk | None:
        """Make an iteration of the bulk under the contact forces, and return its new linearisation.

        Args:
            state: state of the contact on the last linearisation.
            ahead: poses that the tool may reach while the next tangent is in use.

        Returns:
            None if the state belongs to another linearisation, or if no linearisation was found; the next call tries
            again.
        """

    def set_material(self, material: Material) -> None:
        """Change the material of the bulk; see `Solver.set_material`."""

    @property
    def solver(self) -> Solver:
        """Solver that holds the last iterate of the bulk as its committed state, for visualisation."""


class LineariserMaker(Protocol):
    """Factory of a `BulkLineariser`, the entries of `LINEARISATIONS`."""

    def __call__(self, model: Model, *, resolution: str, mesh: Any = None) -> BulkLineariser:
        """Return the linearisation of a model with the tool at its first touch.

        Arguments and errors are those of a `tissue_sim.fem.solver.SolverMaker`.
        """


#: Name of a solver -> factory of the linearisation of its bulk.
LINEARISATIONS: Registry[LineariserMaker] = Registry(
    "linearisation", "tissue_sim.linearisations", {"solid": "tissue_sim.fem.solid.linearisation:make_lineariser"})


def _build_pose(numbers: list[float]) -> Pose:
    """Return the pose with 3 coordinates of the position, m, and 4 of the quaternion."""
    x, y, z, a, b, c, d = numbers
    return Pose((x, y, z), (a, b, c, d))
