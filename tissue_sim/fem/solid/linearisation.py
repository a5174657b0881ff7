"""Newton's iteration of a solid's bulk, condensed onto the nodes near the tool, for a contact that is solved elsewhere.

Each call takes the forces of the contact that were found on the last linearisation, makes the step that they give the
bulk, and linearises there: one iteration for each model of the loop, as in the real-time iteration of optimal control
(Diehl, Bock and Schlöder, SIAM J. Control Optim. 43 (2005) 1714). Where the tool stands, a few of them are an
equilibrium.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.fem.condensed.model import CondensedContact, ContactState, ContactSurface
from tissue_sim.fem.linear.sparse import CondensedFactor
from tissue_sim.fem.solid.contact import STIFFNESS, Body, nearest
from tissue_sim.fem.solid.discretisation import make_solver
from tissue_sim.fem.solid.frame import Frame
from tissue_sim.fem.solid.solver import SolidSolver
from tissue_sim.material.material import Material
from tissue_sim.mesh.solid import SolidMesh
from tissue_sim.model import Model
from tissue_sim.pose import Pose

#: Most nodes onto which the bulk is condensed; and share of them, the nearest, of which all must be there, or others
#: are chosen: another choice costs an analysis.
CANDIDATES, _NEEDED = 100, 0.6
#: Shares of a step that are tried where the whole of it turns elements inside out.
_SHARES = (1.0, 0.5, 0.25)
#: A radius below this share of a line's length is none.
_ON_AXIS = 1e-9


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
        self.surface = self._describe(self._count)
        self._untouched = solver.save()
        self._epoch, self._number, self._time = 0, 0, 0.0
        self._factor: CondensedFactor | None = None
        self._chosen = self._meets[:0]
        self._none = np.zeros_like(contact.rates)
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
        self._untouched = self._solver.save() if self._number == 0 else self._untouched

    @property
    def solver(self) -> SolidSolver:
        """Whose last committed state is the last iterate."""
        return self._solver

    def linearise(self, state: ContactState, ahead: Sequence[Pose] = ()) -> CondensedContact | None:
        """See `BulkLinearisation.linearise`."""
        solver = self._solver
        if state.epoch != self._epoch:
            solver.restore(self._untouched)
            for array, rest in zip(solver._committed, solver._rest, strict=True):
                array[:] = rest  # of the material as it is now
            solver.tissue.prepare(0.0)
            self._epoch, self._factor, self._time = state.epoch, None, state.time
        if self._factor is None:
            solver._go_back()
            if not self._condense(state, solver.pose, ahead):
                return None
            return self._model(state, solver.pose if self._holds else state.pose)
        if state.model != self._number:
            return None
        way, before = self._step(state), tuple(array.copy() for array in solver._state)
        solver.tissue.prepare(max(0.0, state.time - self._time))
        self._take(way)
        after = tuple(array.copy() for array in solver._state)
        for share in _SHARES:
            for array, old, new in zip(solver._state, before, after, strict=True):
                array[:] = old + share * (new - old)
            if self._condense(state, state.pose, ahead):
                self._settle(state.pose)
                self._time = state.time
                return self._model(state, state.pose)
        for array, old in zip(solver._state, before, strict=True):
            array[:] = old
        self._factor = None
        return None

    def _step(self, state: ContactState) -> np.ndarray:
        """Motion of all freedoms to the pose of a state, with its forces, m."""
        solver, factor = self._solver, self._factor
        assert factor is not None
        motion = np.zeros_like(solver.x)
        motion[solver._moved] = solver.held_displacement(Frame(state.pose, solver.datum)) - solver.x[solver._moved]
        right = self._unbalanced(state)
        if self._holds:
            right += solver._matrix.all @ motion
        motion[solver._free] = -factor.solve(right[solver._free])
        return motion

    def _take(self, motion: np.ndarray) -> None:
        solver = self._solver
        solver.x += motion
        solver.tissue.follow(motion)

    def _assembled(self) -> bool:
        """Forces and tangent without contact; whether no element is turned inside out."""
        solver = self._solver
        solver._assemble()
        return 0.0 < solver._least < 1e30

    def _settle(self, pose: Pose) -> None:
        """Commit the iterate."""
        solver = self._solver
        solver.tissue.commit()
        solver._committed = solver.x.copy(), solver.batches.pressures.copy(), solver.contact.forces.copy()
        solver._pose = pose

    def _unbalanced(self, state: ContactState) -> np.ndarray:
        right = self._solver.batches.residual[:-1].copy()
        np.add.at(right, self._freedoms, state.forces)
        return right

    def _condense(self, state: ContactState, pose: Pose, ahead: Sequence[Pose]) -> bool:
        """Assemble where the solver stands, and condense there; whether that is possible."""
        solver = self._solver
        if not self._assembled():
            return False
        unbalanced = self._unbalanced(state)
        held = float(np.linalg.norm(unbalanced[solver._reacting]))
        self.residual = float(np.linalg.norm(unbalanced[solver._free])) / max(held, solver._floor)
        self._choose(state, pose, ahead)
        solver._matrix.add(self._none)
        self._order = np.argsort(self._equations[self._chosen].ravel())
        self._factor = solver._sparse.condense(solver._matrix.free, self._equations[self._chosen].ravel()[self._order])
        return self._factor is not None

    def _choose(self, state: ContactState, pose: Pose, ahead: Sequence[Pose]) -> None:
        """The nodes that the tool can meet first."""
        meets, loaded = self._meets, np.abs(state.forces).sum(axis=1) > 0.0
        gaps = np.stack([self._gaps(each) for each in (pose, *ahead)])[:, meets]
        order = meets[np.lexsort((gaps.min(axis=0), ~loaded[meets]))]
        needed = order[:max(int(_NEEDED * self._count), int(loaded.sum()))]
        if not np.isin(needed, self._chosen).all():
            self._chosen = np.sort(order[:self._count])
        left = np.setdiff1d(meets, self._chosen)
        self._reach = float(np.maximum(0.0, self._gaps(pose)[left]).min(initial=np.inf))

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
        solver, factor, chosen = self._solver, self._factor, self._chosen
        assert factor is not None
        n, free = chosen.size, solver._free
        back = np.argsort(self._order)
        compliance = factor.compliance[np.ix_(back, back)]
        residual = solver.batches.residual[:-1]
        settles = np.zeros_like(solver.x)
        settles[free] = -factor.solve(residual[free])
        middle = (solver.x + settles)[self._freedoms[chosen]]
        wrench, stiffness, drive = np.zeros(6), np.zeros((6, 6)), np.zeros((3 * n, 6))
        if self._holds:
            levers = Frame(pose, solver.datum).rates(solver._places_of(solver._bonded))
            moved = np.zeros((solver.x.size, 6))
            moved[solver._moved] = levers.reshape(-1, 6)
            answer = moved.copy()
            answer[free] = -factor.solve((solver._matrix.all @ moved)[free])
            drive = answer[self._freedoms[chosen]].reshape(3 * n, 6)
            forces = -(residual + solver._matrix.all @ settles)[solver._moved].reshape(-1, 3)
            wrench = np.einsum("nik,ni->k", levers, forces)
            reactions = (solver._matrix.all @ answer)[solver._moved].reshape(-1, 3, 6)
            rate = -np.einsum("nia,nib->ab", levers, reactions)
            apart = levers - np.concatenate([np.eye(3), np.zeros((3, 3))], axis=1)
            rate[3:] += np.cross(apart, forces[:, :, None], axisa=1, axisb=1, axisc=1).sum(axis=0)
            stiffness = -rate
        self._number += 1
        return CondensedContact(self._number, self._epoch, state.time, pose, chosen.copy(), middle, compliance,
                                drive, wrench, stiffness, self._reach, solver.material.mu0, self.residual)


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
