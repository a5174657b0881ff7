"""Contact on a condensed bulk, stepped with the tool: lift-off, touch and friction within a fraction of a tick."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.fem.condensed.flat_contact import FlatContact
from tissue_sim.fem.condensed.kernel import (
    ANEW,
    BENDING,
    CHANGEABLE,
    COLUMNS,
    COUNT,
    MODULUS,
    MOST_FREEDOMS,
    MOTION,
    NEGLIGIBLE,
    ORIGIN,
    PRESSED_IN,
    RELEASE,
    RESULTS,
    ROTATION,
    SETTINGS,
    TOLERANCE,
    contact_kernel,
)
from tissue_sim.fem.condensed.model import HELD, CondensedContact, ContactState, ContactSurface
from tissue_sim.fem.taichi.launch import BoundKernel
from tissue_sim.fem.taichi.runtime import LOCK
from tissue_sim.fem.taichi.scratch import LANES
from tissue_sim.pose import Pose, Screw, between, motion
from tissue_sim.tool_force import Matrix

#: Looks at the tool in a step, and in an exact one; and up to which states that the flat contact has decided about are
#: gone on with by the curved one, which with other states leads elsewhere.
_MOST, _MOST_EXACT, _CURVED = 10, 24, 5
#: Nodes that are nearer to the tool than this share of its radius take part in the flat contact, and what is left of
#: its equation over its forces.
_NEAR, _FLAT = 0.06, 1e-6
#: A force is found where it changes by less than this share; an exact one by less than this share of that, where no
#: condition is violated by more than that share of the tolerance. Friction below another share of the floor is none.
_SETTLED, _EXACT, _CLOSE, _NO_FRICTION = 1e-4, 1e-6, 1e-4, 1e-6
#: A node's force follows the tool by no more than this many times the largest stiffness of one alone.
_STIFFEST = 10.0
#: No linear solution changes forces by more than this share of the largest: it would lead elsewhere.
_FORESEEN = 0.5
#: Steps that the same derivatives serve for, where the same nodes are pressed.
_STEPS = 8
#: A step is made in parts of no more than this share of the contact's radius, which are cut down to the other share of
#: it where they fail; that no part is made for.
LARGEST, _SHORTEST, _ROUNDING = 0.03, 2.0**-1, 1e-9
#: Share of the surface's tolerance: that is for longer steps.
_FINER = 0.5


@dataclass(frozen=True, slots=True)
class ContactStep:
    """What a step of the contact answers.

    Attributes:
        converged: whether all conditions of the contact hold.
        iterations: that it took.
        wrench: on the tool, about its deepest point, N and N m.
        stiffness_matrix: minus its derivative with place and rotation, 6 x 6.
        way: how far the tool is from the pose of the model, m.
        residual: change of the forces in the last iteration, over their size.
        pressed, slipping: nodes.
    """

    converged: bool
    iterations: int
    wrench: Screw
    stiffness_matrix: Matrix
    way: float
    residual: float
    pressed: int
    slipping: int


_NOTHING_YET: Screw = (0.0,) * 6
_REST = ContactStep(True, 0, _NOTHING_YET, (_NOTHING_YET,) * 6, 0.0, 0.0, 0, 0)


class CondensedStepper:
    """Steps the contact of a tool with a tissue whose bulk is known as a `CondensedContact`.

    What nodes remember of friction, and their forces, go on from model to model.

    Args:
        surface: of the tissue, and the tool.
        largest: part of a step, over the contact's radius.

    Raises:
        InputError: more nodes than it takes.

    Attributes:
        model: the newest; None before the first.
        forces: of the nodes on the tool, N, shape (s, 3).
    """

    def __init__(self, surface: ContactSurface, largest: float = LARGEST):
        self.surface = surface
        s, n = len(surface.places), surface.candidates
        self.forces, self._anchors, self._met_at = np.zeros((3, s, 3))
        self._bound, self._pressed, self._slips, self._met = np.zeros((4, s), dtype=np.int32)
        self._settings, self._results = np.zeros(SETTINGS), np.zeros(RESULTS)
        self._signature = np.zeros(n, dtype=np.int32)
        self._matrix, self._block = np.zeros((2, 9 * n * n))
        self._right, self._levers, self._drive = np.zeros(3 * n * COLUMNS), np.zeros((n, 3)), np.zeros((3 * n, 6))
        # Rows of whole vectors.
        width = -(-3 * n // LANES) * LANES
        if width > MOST_FREEDOMS:
            raise InputError(f"a tool that may touch {n} nodes at a time is more than two rates take "
                             f"({MOST_FREEDOMS // 3}); use a coarser mesh", field="resolution")
        self._compliance, self._middle = np.zeros((3 * n, width)), np.zeros((n, 3))
        self._nodes, self._active = np.zeros((2, n), dtype=np.int32)
        arrays = {
            "settings": self._settings, "results": self._results, "chains": surface.chains, "shapes": surface.shapes,
            "places": surface.places, "springs": surface.springs, "friction": surface.friction,
            "outlines": surface.outlines.astype(np.int32), "bound": self._bound, "anchors": self._anchors,
            "pressed": self._pressed, "slips": self._slips, "forces": self.forces,
            "met": self._met, "met_at": self._met_at, "nodes": self._nodes, "middle": self._middle,
            "drive": self._drive, "compliance": self._compliance, "rows": self._compliance.reshape(-1, LANES),
            "u": np.zeros(width), "guess": np.zeros((n, 3)),
            "rates": np.zeros((n, 9)), "turns": np.zeros((n, 9)), "intercept": np.zeros((n, 3)), "levers": self._levers,
            "signature": self._signature, "geometry": np.zeros((n, 8)),
            "loaded": np.zeros(n, dtype=np.int32), "active": self._active,
            "matrix": self._matrix, "block": self._block, "right": self._right}
        with LOCK:
            self._kernel = BoundKernel(contact_kernel(), arrays)
        self._flat = FlatContact(arrays, _NEAR * surface.radius, surface.floor)
        self._guess = arrays["guess"]
        self._tolerance, self._stiffest = _FINER * surface.tolerance, math.inf
        self._settings[[TOLERANCE, NEGLIGIBLE]] = self._tolerance, _NO_FRICTION * surface.floor
        self._widest = float((surface.chains[:, :, 0] + surface.shapes[:, :1]).max())
        self._others = surface.places[:0]
        self._largest = largest * surface.radius
        self._first_height = surface.start.position[2]
        self.model: CondensedContact | None = None
        self._last = _REST
        self.reset()

    def reset(self) -> None:
        """Back to the first touch; the model stays."""
        for array in (self.forces, self._pressed, self._slips, self._met):
            array[:] = 0
        self._bound[:], self._anchors[:] = self.surface.bound, self.surface.anchors
        self._pose: Pose | None = None
        self._last = _REST
        self._factor: tuple[np.ndarray, np.ndarray] | None = None
        self._columns = np.zeros((0, 6))
        self._settings[ANEW], self._steps = 1.0, 0

    def state(self, time: float, pose: Pose, earlier: float, before: Pose, epoch: int = 0) -> ContactState:
        """Where the contact is, for the solver of the bulk; see `ContactState`."""
        return ContactState(0 if self.model is None else self.model.number, epoch, time, pose, earlier, before,
                            self.forces.copy(), self._anchors.copy(),
                            np.stack([self._bound, self._pressed, self._slips]).astype(float))

    def take(self, state: ContactState) -> None:
        """Go where another stepper of the same surface and model was."""
        self.forces[:], self._anchors[:] = state.forces, state.anchors
        self._bound[:], self._pressed[:], self._slips[:] = state.states
        self._pose, self._columns, self._settings[ANEW] = state.pose, self._columns[:0], 1.0

    def adopt(self, model: CondensedContact) -> None:
        """Go on with another model of the same surface."""
        n, known = len(model.nodes), self.model
        if known is None or (model.base, model.epoch) != (known.base, known.epoch):
            dropped = np.ones(len(self.forces), dtype=bool)
            dropped[model.nodes] = False
            self.forces[dropped], self._pressed[dropped], self._met[dropped], self._slips[dropped] = 0.0, 0, 0, 0
            self._others = self.surface.places[dropped]
            self._bound[dropped & (self._bound != HELD)] = 0
            self._nodes[:n], self._drive[:3 * n], self._compliance[:3 * n, :3 * n] = (
                model.nodes, model.drive, model.compliance)
            self._signature[:] = -1
            self._settings[COUNT] = n
            self._stiffest = _STIFFEST / float(np.abs(np.diag(model.compliance)).min(initial=math.inf))
            self._columns, self._settings[ANEW] = self._columns[:0], 1.0
        self._middle[:n] = model.middle
        self._settings[MODULUS] = model.modulus
        self.model = model

    def step(self, pose: Pose, exact: bool = False) -> ContactStep:
        """Go where the tool is now.

        Args:
            pose: of the tool.
            exact: find the equations anew, so that the stiffness is that of this very pose.

        Returns:
            The wrench there. Of a step that has not converged it is that of the step before, from which the next one
            goes on.

        Raises:
            ValueError: there is no model yet.
        """
        model = self.model
        if model is None:
            raise ValueError("there is no model to step on; adopt one")
        start = self._pose
        if start is None:
            return self._part(pose, exact)
        length, done, share = self.distance(motion(start, pose)), 0.0, 1.0
        if length > 0.0:
            share = min(1.0, self._largest / length)
        while True:
            # The last part ends where the tool is, without rounding.
            end = 1.0 if done + share > 1.0 - _ROUNDING else done + share
            step = self._part(between(start, pose, end), exact)
            if step.converged:
                done, share = end, 1.0 if length == 0.0 else min(2.0 * share, self._largest / length)
                if done == 1.0:
                    return step
            else:
                share *= 0.5
                if share * length < _SHORTEST * self._largest or length == 0.0:
                    return step

    def _part(self, pose: Pose, exact: bool) -> ContactStep:
        """One part of a step; nothing is changed by one that does not converge."""
        from scipy.linalg import lapack

        assert self.model is not None
        settings, results = self._settings, self._results
        way = motion(self.model.pose, pose)
        self._place(pose, way)
        before = [array.copy() for array in self._kept]
        if len(self._columns) and self._pose is not None:
            nodes = self._nodes[self._active[:len(self._columns) // 3]]
            more = (self._columns @ np.array(motion(self._pose, pose))).reshape(-1, 3)
            if np.abs(more).max() < _FORESEEN * np.abs(self.forces[nodes]).max():
                self.forces[nodes] += more
        self._steps += 1
        if exact or self._steps % _STEPS == 0:
            settings[ANEW] = 1.0
        settings[[RELEASE, CHANGEABLE, BENDING]] = 0.0, 1.0, 1.0
        converged, fresh, decided, iterations, columns = False, False, False, 0, self._columns
        while True:
            with LOCK:
                self._kernel()
            violation, pulling, unbalanced, size, active, rebuilt, slipping = results.tolist()
            settings[[RELEASE, CHANGEABLE]], k = (0.0, 1.0), 3 * int(active)
            change, enough = math.sqrt(unbalanced), _SETTLED * max(math.sqrt(size), self.surface.floor)
            if not math.isfinite(unbalanced + size) or iterations >= (_MOST_EXACT if exact else _MOST):
                break
            iterations += 1
            if k and rebuilt:
                lu, pivots, failed = lapack.dgetrf(self._matrix[:k * k].reshape(k, k).T, overwrite_a=1)
                self._factor, fresh = (None if failed else (lu, pivots)), True
            usable = fresh and self._factor is not None and len(self._factor[0]) == k
            settles = change < enough and violation <= self._tolerance
            done = settles and (not exact or (change < _EXACT * enough and violation <= _CLOSE * self._tolerance))
            if done and pulling:
                settings[RELEASE] = 1.0
            elif done and k and not usable and len(columns) != k:
                settings[ANEW] = 1.0
            elif done:
                if not k or usable:
                    columns = self._solved(k)[:, 1:] if k else columns[:0]
                converged = True
                break
            elif usable and (decided or (exact and settles)):
                chosen, step = self._active[:k // 3], self._solved(k)[:, 0]
                self.forces[self._nodes[chosen]] = self._guess[chosen] + step.reshape(-1, 3)
                decided = False
                settings[[CHANGEABLE, ANEW]] = 0.0 if settles else 1.0, 1.0
            else:
                decided = self._flat.solve(_FLAT) and iterations <= _CURVED
                settings[[CHANGEABLE, ANEW]] = 0.0, 1.0
        if converged:
            self._commit()
            self._pose, self._columns = pose, columns
            self._last = self._answer(pose, way, iterations, change, int(slipping))
            return self._last
        for array, kept in zip(self._kept, before, strict=True):
            array[:] = kept
        self._columns, settings[ANEW] = self._columns[:0], 1.0
        return replace(self._last, converged=False, iterations=iterations, way=self.distance(way), residual=change)

    def _solved(self, k: int) -> np.ndarray:
        """Of the linear equations as they were last built, shape (k, 7)."""
        from scipy.linalg import lapack

        assert self._factor is not None
        solution, _ = lapack.dgetrs(*self._factor, self._right[:COLUMNS * k].reshape(COLUMNS, k).T)
        # Where all nodes are about to slip or to stick, there may be none.
        sane = np.isfinite(solution).all() and np.abs(solution[:, 1:4]).max(initial=0.0) < self._stiffest
        return solution if sane else np.zeros_like(solution)

    def leaves(self, pose: Pose) -> bool:
        """Whether the tool may meet nodes there that are not in the model."""
        model = self.model
        if model is None or not len(self._others) or self.distance(motion(model.pose, pose)) <= model.reach:
            return False
        # Within the largest radius of the tool, at most; nodes that far off are hardly displaced.
        self._place(pose, motion(model.pose, pose))
        at = (self._others - self._settings[ORIGIN:ORIGIN + 3]) @ self._settings[ROTATION:ROTATION + 9].reshape(3, 3)
        return bool(np.hypot(at[:, 0], at[:, 1]).min() < self._widest)

    def distance(self, way: Screw) -> float:
        """How far the points of the contact go in a motion, at most, m."""
        return math.hypot(*way[:3]) + self.surface.radius * math.hypot(*way[3:])

    @property
    def _kept(self) -> tuple[np.ndarray, ...]:
        return self.forces, self._pressed, self._slips, self._bound

    def _place(self, pose: Pose, way: Screw) -> None:
        """Tell the kernel where the tool is."""
        settings, (w, x, y, z) = self._settings, pose.orientation
        settings[ROTATION:ROTATION + 9] = (
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y))
        x, y, z = pose.position
        settings[ORIGIN:ORIGIN + 3] = x, y, z + self.surface.datum
        settings[MOTION:MOTION + 6] = way
        settings[PRESSED_IN] = float(z <= self._first_height)

    def _commit(self) -> None:
        """Bind the nodes to what they met."""
        loose = self._bound != HELD
        np.copyto(self._bound, self._met, where=loose)
        np.copyto(self._anchors, self._met_at, where=loose[:, None])
        self._slips &= self._pressed

    def _answer(self, pose: Pose, way: Screw, iterations: int, change: float, slipping: int) -> ContactStep:
        model, columns, k = self.model, self._columns, len(self._columns)
        assert model is not None
        wrench, rate = model.wrench - model.stiffness @ np.array(way), -model.stiffness
        if k:
            active = self._active[:k // 3]
            forces, arms = self.forces[self._nodes[active]], self._levers[active]
            drive = self._drive.reshape(-1, 18)[active]
            follows = drive - (self._block[:k * k].reshape(k, k).T @ columns).reshape(-1, 18)
            drive, changes = drive.reshape(k, 6), columns.reshape(-1, 18)
            # Nodes hand their forces on to the tool, but for what the tissue is driven by itself.
            total, pairs = forces.sum(axis=0), (arms.T @ changes).reshape(3, 3, 6)
            wrench = wrench + np.concatenate([total, _cross_sum(arms.T @ forces)]) - forces.ravel() @ drive
            rate = rate - drive.T @ columns
            rate[:3] += changes.sum(axis=0).reshape(3, 6)
            # The levers of the torque change, too: a node goes its way, and the tool's deepest point the tool's.
            turned = (follows.reshape(-1, 3, 6).transpose(1, 2, 0) @ forces).transpose(0, 2, 1)
            turned[[0, 1, 2], :, [0, 1, 2]] -= total
            rate[3:] += _cross_sum(pairs) + _cross_sum(turned)
        if k and not columns.any():
            rate = -np.array(self._last.stiffness_matrix)  # the equations had no sane solution
        a, b, c, d, e, f = map(tuple, (-rate).tolist())
        x, y, z, u, v, w = wrench.tolist()
        return ContactStep(True, iterations, (x, y, z, u, v, w), (a, b, c, d, e, f), self.distance(way), change,
                           k // 3, slipping)


def _cross_sum(pairs: np.ndarray) -> np.ndarray:
    """Sum of cross products a x b of many vectors, by the sums of the products a_i b_k, shape (3, 3) or, of several on
    either side, (3, 3, m)."""
    return np.stack([pairs[1, 2] - pairs[2, 1], pairs[2, 0] - pairs[0, 2], pairs[0, 1] - pairs[1, 0]])
