"""Newton's iteration of a solid's bulk, condensed onto the nodes near the tool, for a contact that is solved elsewhere.

Each call takes the forces of the contact that were found on the last linearisation, makes the step that they give the
bulk, and linearises there: one iteration for each model of the loop, as in the real-time iteration of optimal control
(Diehl, Bock and Schlöder, SIAM J. Control Optim. 43 (2005) 1714). Where the tool stands, a few of them are an
equilibrium. A tangent takes ten times as long to condense as forces take to assemble: where it is condensed beside,
iterates go on with the one of before, so that forces are those of now and only their rates of then.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.fem.condensed.model import Beside, CondensedContact, ContactState, ContactSurface, at_once
from tissue_sim.fem.linear.sparse import library
from tissue_sim.fem.solid.condensed_tangent import CondensedTangent
from tissue_sim.fem.solid.contact import STIFFNESS, Body, nearest
from tissue_sim.fem.solid.discretisation import make_solver
from tissue_sim.fem.solid.frame import Frame
from tissue_sim.fem.solid.solver import SolidSolver
from tissue_sim.material.material import Material
from tissue_sim.mesh.solid import SolidMesh
from tissue_sim.model import Model
from tissue_sim.pose import Pose, between

#: Most nodes that are published. The bulk is condensed onto so many times as many by Pardiso, whose cost hardly depends
#: on it; of them the nearest share must be there, or others are chosen: another choice costs an analysis.
CANDIDATES, _MORE, _NEEDED = 100, 3, 0.6
#: Shares of a step that are tried where the whole of it turns elements inside out.
_SHARES = (1.0, 0.5, 0.25)
#: The same with the tangent of an earlier iterate, which would overshoot where tissue has become more than twice as
#: stiff. Motions below the other share of the displacement are none.
_OLD_SHARES, _ROUNDING = (0.8, 0.4, 0.2), 1e-5
#: A radius below this share of a line's length is none.
_ON_AXIS = 1e-9


@dataclass(frozen=True, eq=False)
class _Step:
    """A step, m, where its length is measured: all of it, and its shares by the forces of the contact and by what the
    tool holds."""

    motion: np.ndarray
    pushed: np.ndarray
    carried: np.ndarray

    def leads_on(self, settles: np.ndarray, share: float, rounding: float) -> bool:
        """Whether a share of it led towards the equilibrium: the next step is shorter (the restricted monotonicity
        test: Deuflhard, Newton Methods for Nonlinear Problems, 2011, section 3.3).

        Args:
            settles: motion that now balances the tissue without contact, m.
            share: that was made. rounding: length that is none, m.
        """
        following = settles + self.pushed + (1.0 - share) * self.carried
        return float(np.linalg.norm(following)) <= (1.0 - 0.25 * share) * float(np.linalg.norm(self.motion)) + rounding


class SolidLinearisation:
    """A `tissue_sim.fem.condensed.model.BulkLinearisation` of a solid. The solver must not be stepped beside it.

    Args:
        solver: at the first touch.
        candidates: most nodes onto which the bulk is condensed.

    Attributes:
        residual: unbalanced over balanced forces at the last iterate.

    Raises:
        InputError: a specimen whose base is not held.
    """

    def __init__(self, solver: SolidSolver, candidates: int = CANDIDATES):
        # The two are one thing in two files, so this one uses protected names of the other.
        self._solver, contact = solver, solver.contact
        self._holds = bool(solver._bonded.size)
        self._mine = np.flatnonzero(contact.moves)
        if contact.laws:
            raise InputError("a solid by two rates takes no adhesion or other laws of contact; leave them out",
                             field="contact_laws")
        if any(not body.moves and body.stays for body in contact.bodies):
            raise InputError("the base slides or can lift off, and the bulk would hold on to nothing; use 'bonded', or "
                             "'frictionless' under a tool that is bonded", field="friction_base")
        self.nodes = contact.nodes[self._mine]
        self._freedoms = 3 * self.nodes[:, None] + np.arange(3)
        equation = np.full(solver.x.size, -1)
        equation[solver._free] = np.arange(solver._free.size)
        self._equations = equation[self._freedoms]
        self._meets = np.flatnonzero((self._equations >= 0).all(axis=1))
        self._count = min(candidates, self._meets.size)
        self._most = min(self._count * (_MORE if library() == "pardiso" else 1), self._meets.size)
        self.surface = self._describe(self._count)
        self._untouched = solver.save()
        self._epoch, self._number, self._time = 0, 0, 0.0
        self._interface = self._meets[:0]
        self._none = np.zeros_like(contact.rates)
        self._tangents = [CondensedTangent(solver._matrix, solver._moved) for _ in range(2)]
        # The one in use, the one that is being made, and the motion that balances the tissue without contact.
        self._tangent: CondensedTangent | None = None
        self._coming: CondensedTangent | None = None
        # Whether the one in use is that of an earlier iterate.
        self._stale = False
        self._settles = np.zeros(solver._free.size)  # begun only, see `CondensedTangent.begin`
        self.beside: Beside = at_once
        self.residual = 0.0

    def _describe(self, candidates: int) -> ContactSurface:
        solver, contact, mine = self._solver, self._solver.contact, self._mine
        bodies = [body for body in contact.bodies if body.moves]
        lines = max((len(body.profile.vertices) - 1 - body.first_line for body in bodies), default=1)
        chains, shapes = np.zeros((max(1, len(bodies)), lines, 5)), np.zeros((max(1, len(bodies)), 5))
        outlines, friction = np.zeros(mine.size, dtype=np.int32), np.zeros((mine.size, 2))
        for number, body in enumerate(bodies):
            chain, shapes[number] = _outline(body)
            chains[number, :len(chain)] = chain
            own = np.isin(self.nodes, body.nodes)
            outlines[own], friction[own] = number, body.friction
        start = Frame(solver.pose, solver.datum)
        springs = STIFFNESS * np.sqrt(np.maximum(contact.areas, 1e-3 * contact.areas.max(initial=0.0)))[mine]
        return ContactSurface(contact.places[mine].copy(), springs, friction, outlines, chains, shapes,
                              contact.bound[mine].astype(np.int32),
                              start.into(contact.places[mine]) + contact.anchors[mine], solver.pose,
                              solver.datum, solver._tolerance, solver.tissue.contact_radius, solver._floor, candidates)

    def set_material(self, material: Material) -> None:
        """See `SolidSolver.set_material`."""
        self._solver.set_material(material)
        self._tangent = None
        self._untouched = self._solver.save() if self._number == 0 else self._untouched

    @property
    def solver(self) -> SolidSolver:
        """Whose last committed state is the last iterate."""
        return self._solver

    def linearise(self, state: ContactState, ahead: Sequence[Pose] = ()) -> CondensedContact | None:
        """See `BulkLinearisation.linearise`."""
        solver = self._solver
        if state.epoch != self._epoch:
            self._rest()
            self._epoch, self._tangent, self._time = state.epoch, None, state.time
        if self._tangent is None:
            return self._begin_anew(state, ahead)
        if state.model != self._number:
            return None
        due = self._coming is None or self._coming.is_done
        if due and self._change(state, state.pose, ahead):
            self._settle()
        before, here = tuple(array.copy() for array in solver._state), solver.pose
        step = self._step(state)
        after = tuple(array.copy() for array in solver._state)
        solver.tissue.prepare(max(0.0, state.time - self._time))
        settles, old = self._settles, self._stale
        for share in _OLD_SHARES if old else _SHARES:
            for array, one, other in zip(solver._state, before, after, strict=True):
                array[:] = one + share * (other - one)
            if not self._assembled(due):
                continue
            pose, self._stale = between(here, state.pose, share), True
            if old:
                self._settle()
                if not step.leads_on(self._measured(self._settles), share, _ROUNDING * self._size):
                    continue
            begun = self._begin(state, pose, ahead, self.beside) if due else None
            if begun is not None and begun.is_done:
                if not self._change(state, pose, ahead):
                    continue  # who waits for a tangent does not go where there is none
                self._stale = False
            if not (old and self._stale):
                self._settle()
            self._note_residual(state)
            self._commit(pose)
            self._time = state.time
            return self._model(state, pose)
        for array, old_one in zip(solver._state, before, strict=True):
            array[:] = old_one
        self._settles, self._stale = settles, old
        if self._coming is None or not self._assembled(False):
            self._tangent = None
        return None

    def _rest(self) -> None:
        """Back to the tissue that nobody touches, of the material as it is now."""
        solver = self._solver
        solver.restore(self._untouched)
        for array, rest in zip(solver._committed, solver._rest, strict=True):
            array[:] = rest
        solver.tissue.prepare(0.0)
        solver._go_back()

    def _begin_anew(self, state: ContactState, ahead: Sequence[Pose]) -> CondensedContact | None:
        """The linearisation where the tissue stands, or where it is at rest if there is none."""
        solver, self._coming = self._solver, None
        for go_back in (solver._go_back, self._rest):
            go_back()
            pose = solver.pose if self._holds else state.pose
            if not self._assembled(True):
                continue
            self._begin(state, pose, ahead, at_once)
            if self._change(state, pose, ahead):
                self._stale = False
                self._settle()
                self._note_residual(state)
                return self._model(state, pose)
        return None

    def _step(self, state: ContactState) -> _Step:
        """Go to the pose of a state, with its forces."""
        solver, tangent = self._solver, self._tangent
        assert tangent is not None
        motion, carried = np.zeros_like(solver.x), np.zeros(solver._free.size)
        if self._holds:
            motion[solver._moved] = solver.held_displacement(Frame(state.pose, solver.datum)) - solver.x[solver._moved]
            carried = -tangent.begin((tangent.held @ motion[solver._moved])[solver._free])
        loaded = np.flatnonzero(state.forces.any(axis=1))
        if np.isin(loaded, tangent.interface).all():
            pushed = -tangent.push(state.forces[tangent.interface])
        else:
            right = np.zeros_like(solver.x)
            right[self._freedoms[loaded]] = state.forces[loaded]
            pushed = -tangent.begin(right[solver._free])
        begun = self._settles + pushed + carried
        motion[solver._free] = tangent.finish(begun)
        solver.x += motion
        solver.tissue.follow(motion)
        return _Step(*(self._measured(each) for each in (begun, pushed, carried)))

    def _measured(self, begun: np.ndarray) -> np.ndarray:
        """The part of a motion of the free freedoms that was begun whose length is compared: near the contact, where
        the forces act, or where they act through what the tool holds, all of it."""
        assert self._tangent is not None
        return self._tangent.finish(begun) if self._holds else begun[self._tangent.rows]

    @property
    def _size(self) -> float:
        """Of the displacement there, m."""
        assert self._tangent is not None
        displacement = self._solver.x[self._solver._free]
        return float(np.linalg.norm(displacement if self._holds else displacement[self._tangent.rows]))

    def _settle(self) -> None:
        """Note the motion of the free freedoms that balances the tissue as it was assembled last, without contact."""
        solver, tangent, right = self._solver, self._tangent, self._solver.batches.residual[:-1].copy()
        assert tangent is not None
        if self._stale:
            solver.tissue.add_known_volumes(right)
        self._settles = -tangent.begin(right[solver._free])
        if self._holds:
            self._reactions = right[solver._moved] + tangent.held[solver._free].T @ tangent.finish(self._settles)

    def _assembled(self, tangent: bool) -> bool:
        """Forces, and if asked for the tangent, without contact; whether no element is turned inside out."""
        solver = self._solver
        solver._least = solver.tissue.assemble(tangent)
        if tangent:
            solver._matrix.add(self._none)
        return 0.0 < solver._least < 1e30

    def _commit(self, pose: Pose) -> None:
        """Keep the iterate."""
        solver = self._solver
        solver.tissue.commit()
        solver._committed = solver.x.copy(), solver.batches.pressures.copy(), solver.contact.forces.copy()
        solver._pose = pose

    def _note_residual(self, state: ContactState) -> None:
        solver, unbalanced = self._solver, self._solver.batches.residual[:-1].copy()
        unbalanced[self._freedoms] += state.forces
        held = float(np.linalg.norm(unbalanced[solver._reacting]))
        self.residual = float(np.linalg.norm(unbalanced[solver._free])) / max(held, solver._floor)

    def _begin(self, state: ContactState, pose: Pose, ahead: Sequence[Pose],
               beside: Beside) -> CondensedTangent | None:
        """Condense the tangent that was assembled last; None where one is still made."""
        # It may be one that nobody needs any more.
        spare = next((each for each in self._tangents if each is not self._tangent and each.is_done), None)
        if spare is None or self._coming is not None:
            return None
        solver, order, loaded = self._solver, *self._nearest(state, pose, ahead)
        if not np.isin(order[:max(int(_NEEDED * self._most), loaded)], self._interface).all():
            self._interface = np.sort(order[:self._most])
        spare.take(solver._matrix, self._interface, self._equations[self._interface], solver.batches.volume_rates,
                   beside)
        self._coming = spare
        return spare

    def _change(self, state: ContactState, pose: Pose, ahead: Sequence[Pose]) -> bool:
        """Go on with the tangent that is done, if there is one and it could be condensed."""
        coming, self._coming = self._coming, None
        if coming is None or coming.factor is None:
            return False
        order, _ = self._nearest(state, pose, ahead)
        nodes = order[np.isin(order, coming.interface)][:self._count]
        coming.choose(nodes, self._equations[nodes])
        self._tangent, self._base = coming, self._number + 1
        self._solver.batches.known_rates[:] = coming.volume_rates
        return True

    def _nearest(self, state: ContactState, pose: Pose, ahead: Sequence[Pose]) -> tuple[np.ndarray, int]:
        """The nodes that the tool can meet, those that are loaded and those that it meets first in front, and how many
        are loaded."""
        meets, loaded = self._meets, np.abs(state.forces).sum(axis=1) > 0.0
        gaps = np.stack([self._gaps(each) for each in (pose, *ahead)])[:, meets]
        return meets[np.lexsort((gaps.min(axis=0), ~loaded[meets]))], int(loaded.sum())

    def _gaps(self, pose: Pose) -> np.ndarray:
        """Distances of the surface from the tool at a pose, m, shape (s,)."""
        solver, contact = self._solver, self._solver.contact
        frame, gaps = Frame(pose, solver.datum), np.full(self.nodes.size, np.inf)
        at = frame.into(contact.places[self._mine] + solver.x[self._freedoms])
        for body in contact.bodies:
            if body.moves:
                own = np.isin(self.nodes, body.nodes)
                gaps[own] = nearest(body, at[own], pressed_in=True).gap
        return gaps

    def _model(self, state: ContactState, pose: Pose) -> CondensedContact:
        """The linearisation at the last iterate."""
        solver, tangent = self._solver, self._tangent
        assert tangent is not None
        middle = solver.x[self._freedoms[tangent.nodes]] + self._settles[self._equations[tangent.nodes]]
        wrench = np.zeros(6)
        if self._holds:
            levers = Frame(pose, solver.datum).rates(solver._places_of(solver._bonded))
            forces = -self._reactions.reshape(-1, 3)
            wrench = np.einsum("nik,ni->k", levers, forces)
            if self._number + 1 == self._base:
                self._hold(tangent, levers, forces)
        left = np.setdiff1d(self._meets, tangent.nodes)
        reach = float(np.maximum(0.0, self._gaps(pose)[left]).min(initial=np.inf))
        self._number += 1
        return CondensedContact(self._number, self._base, self._epoch, state.time, pose, tangent.nodes, middle,
                                tangent.compliance, tangent.drive, wrench, tangent.stiffness, reach,
                                solver.material.mu0, self.residual)

    def _hold(self, tangent: CondensedTangent, levers: np.ndarray, forces: np.ndarray) -> None:
        """Note how the nodes and the wrench follow what the tool holds.

        Args:
            tangent: where.
            levers: how its nodes go with the tool, shape (n, 3, 6). forces: of theirs on it, N, shape (n, 3).
        """
        solver = self._solver
        answer = np.zeros((solver.x.size, 6))
        answer[solver._moved] = levers.reshape(-1, 6)
        answer[solver._free] = -tangent.solve((tangent.held @ answer[solver._moved])[solver._free])
        tangent.drive = answer[self._freedoms[tangent.nodes]].reshape(-1, 6)
        reactions = (tangent.held.T @ answer).reshape(-1, 3, 6)
        rate = -np.einsum("nia,nib->ab", levers, reactions)
        apart = levers - np.concatenate([np.eye(3), np.zeros((3, 3))], axis=1)
        rate[3:] += np.cross(apart, forces[:, :, None], axisa=1, axisb=1, axisc=1).sum(axis=0)
        tangent.stiffness = -rate


def make_linearisation(model: Model, *, resolution: str = "realtime", mesh: SolidMesh | None = None,
                       candidates: int = CANDIDATES) -> SolidLinearisation:
    """Of a model; see `tissue_sim.fem.condensed.model.LINEARISATIONS`."""
    return SolidLinearisation(make_solver(model, resolution=resolution, mesh=mesh), candidates)


def _outline(body: Body) -> tuple[np.ndarray, tuple[float, ...]]:
    """Lines of a body, and its row in `ContactSurface.shapes`."""
    profile, first = body.profile, body.first_line
    start, way = profile.vertices[first:-1], np.diff(profile.vertices[first:], axis=0)
    length = np.linalg.norm(way, axis=1)
    closed = body.closed and first == profile.shaft and profile.rounding == 0.0
    return np.column_stack([start, way / length[:, None], length]), (
        profile.rounding, profile.shaft - first, float(closed), len(length), _ON_AXIS * length.max(initial=1.0))
