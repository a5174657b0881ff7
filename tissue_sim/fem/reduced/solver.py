"""A reduced solid, stepped from pose to pose of a tool a thousand times a second."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.fem.reduced.compliance import missing_force
from tissue_sim.fem.reduced.contact import LayerContact
from tissue_sim.fem.reduced.elements import SampledElements
from tissue_sim.fem.reduced.fields import reduced_fields
from tissue_sim.fem.reduced.lifting import Lifting
from tissue_sim.fem.reduced.linear import bend, size, solution
from tissue_sim.fem.reduced.model import ReducedModel
from tissue_sim.fem.reduced.placement import PlacedReduced
from tissue_sim.fem.reduced.prediction import Prediction
from tissue_sim.fem.reduced.response import Response
from tissue_sim.fem.solid.discretisation import tool_contact
from tissue_sim.fem.solid.frame import Frame
from tissue_sim.fem.solid.state import SavedState
from tissue_sim.fem.solid.surface import SolidSurface
from tissue_sim.fem.solid.tissue import node_moduli
from tissue_sim.fem.solver import Fields, OwnStiffness, Step, StepStatus
from tissue_sim.material.material import Material
from tissue_sim.mesh.solid import SolidMesh
from tissue_sim.model import Model
from tissue_sim.pose import Pose, Screw, motion
from tissue_sim.tool_force import Matrix

#: Unbalanced over balanced forces on the modes; a smaller tolerance would be far below the error of the reduction.
TOLERANCE = 5e-4
#: Unbalanced forces are measured against those of the contact, but at least this share of the largest so far.
_FLOOR_SHARE = 0.02
#: A linear solution is halved where it does not make the unbalanced forces smaller by this share of itself.
_DESCENT, _MOST_HALVINGS = 0.1, 5
#: The contact is solved on linear tissue to this share of the tolerance, in so many solutions at most.
_INNER, _MOST_SOLVES = 0.3, 12
#: Groups of elements whose stiffness is computed at one time; an iteration after the first computes no stiffness while
#: the unbalanced forces shrink to this fraction each time.
_GROUPS, _FAST = 8, 0.3
#: Groups that are computed anew in a slow iteration, and iterations from which on all are.
_OLDEST, _PATIENT = 2, 4
#: Tissue bends away from its tangent by less than so many times what its last change lets expect: of 5700 that were
#: looked at, none by more than 8 times, and none of those that five times would have let pass. Not where some of the
#: tangent is that of a step which failed, nor in further iterations, whose changes go elsewhere: there up to 17 times.
_DOUBT = 5.0
#: Smallest J of an element that is not about to turn inside out.
_LEAST = 0.02


class ReducedSolver(PlacedReduced):
    """Newton's iteration on the modes of a reduced solid; see `ReducedModel`.

    Args:
        reduced: what was kept of the solid.
        material: law, parameters, bulk response; may differ from the one that it was made of.

    Attributes:
        least_tolerance: to which a step is solved, whatever smaller one it asks for.

    Raises:
        InputError: what it does not take of a material.
        MissingBackendError: Taichi is not there.
    """

    highest_order = 1
    least_tolerance = TOLERANCE

    def __init__(self, reduced: ReducedModel, material: Material):
        experiment, mesh = reduced.model.experiment, reduced.mesh
        self.mesh, self.reduced = mesh, reduced
        self._start = self._pose = self._landed = experiment.tool_pose(0.0)
        bonded = mesh.sets["face"] if reduced.lifting else np.zeros(0, dtype=np.intp)
        bodies, self.datum = tool_contact(experiment, mesh, bonded, reduced.places)
        self._make_placement(bodies)
        self.elements = SampledElements(
            mesh, reduced.basis, reduced.elements, reduced.shares, groups=_GROUPS, rest=reduced.rest,
            layers=reduced.element_layers, contact_radius=experiment.contact_radius)
        self._reach = experiment.contact_radius
        self.contact = LayerContact(bodies, reduced.places, mesh.node_areas, reduced.basis, reach=self._reach,
                                    softness=reduced.softness)
        self.missing_force = missing_force(reduced, self.contact)
        self._lifted = Lifting(reduced.lifting, Frame(self._start, self.datum))
        modes = reduced.basis.shape[1]
        #: How many modes the tool says, and those that are solved for.
        self._lifting, self._free = reduced.lifting, slice(reduced.lifting, modes - reduced.watched)
        self.amplitudes = np.zeros(modes)
        self._prediction = Prediction(modes, self._reach)
        self._committed = self.amplitudes.copy(), self.elements.rest_pressures.copy()
        #: Of the elements on the modes there; and steps in which stiffness was computed since it came to rest.
        self._forces, self._known, self._rested, self._largest_force = np.zeros(modes), self.amplitudes, 0, 0.0
        #: Groups whose stiffness may be that of a step which failed.
        self._strange = 0
        self._asked = False
        reduced.require_material(material)
        self.elements.set_material(material, reduced.bulk_ratio)
        self.elements.settle()
        self.set_material(material)

    def set_material(self, material: Material) -> None:
        """Change parameters, bulk response or law; the state is kept. See `Solver.set_material`."""
        self.reduced.require_material(material)
        stiffer = self.elements.set_material(material, self.reduced.bulk_ratio)
        self.material = material
        for pressures in (self._committed[1], self.elements.pressures):
            pressures *= stiffer
        softest = self.contact.set_stiffness(node_moduli(material, self.mesh, self.reduced.element_layers))
        self._prediction.forget_what_was_missed()
        self._floor = 1e-3 * softest * self._reach**2
        self._largest_force = 0.0
        self._renew()

    @property
    def pose(self) -> Pose:
        """Of the tool at the last committed state."""
        return self._pose

    def ask_for_stiffness(self) -> None:
        """Let every step answer its stiffness matrix from now on."""
        self._asked = True

    def step(self, pose: Pose, dt: float = 0.0, *, tolerance: float = TOLERANCE, max_iterations: int = 20,
             predictor_order: int = 2, inertial: bool = False, resumes: bool = False,
             own_stiffness: int = OwnStiffness.IF_LEFT) -> Step:
        """Move the tool to a pose and find equilibrium; see `Solver.step`. There is no mass."""
        elements, contact = self.elements, self.contact
        if not resumes:
            self._go_back()
        frame = Frame(pose, self.datum)
        pressed_in = bool(frame.origin[2] <= self._lifted.first.origin[2])
        inside, clear = self._where(pose, frame)
        if not (inside or clear):
            return Step(StepStatus.OUTSIDE, 0, 0.0, (0.0,) * 6)
        if not inside:  # it touches nothing: near to where it rests
            self.amplitudes[:], elements.pressures[:] = 0.0, elements.rest_pressures
            if not elements.remember:
                return self._rest(pose)
        elements.prepare(dt)
        held, free = self._lifting, self._free
        # It begins by going with the tool as it would if the contact did not change, or where the last step ended.
        predicts = predictor_order and inside and not resumes
        way = np.array(motion(self._pose, pose)) if predicts else np.zeros(6)
        # What touches is balanced below, from the forces that were left.
        here = self.amplitudes + (self._prediction.change(way) if held and predicts else self._prediction.answer @ way)
        here[:held] = self._lifted.amplitudes(frame)
        iterations, ratio, last, halvings, status = 0, 0.0, np.inf, 0, None
        anew = _OLDEST if self._strange else 1
        # Where the elements were looked at last, and their forces there.
        base, forces = (self._known, elements.pressures.copy()), self._forces
        if resumes:
            base, forces = (self.amplitudes.copy(), base[1]), elements.forces.copy()
        if elements.are_known and inside and not (held or resumes):
            # First the contact on the tissue as the last step left it: lift-off, touch and friction are what changes.
            here, pushed, rates = self._balance(here, base[0], forces, frame, pressed_in, tolerance)
        else:
            pushed, rates = self._press(here, frame, pressed_in)
        follows = inside and np.array_equal(elements.at, base[0])
        while status is None:
            change = here - base[0]
            drawn = elements.tangent @ change
            went, foreseen, is_foreseen = float(change @ drawn), forces + drawn, elements.are_known and follows
            elements.evaluate(here, follows, anew)
            forces, looked = elements.forces.copy(), here
            residual = forces + pushed
            unbalanced = size(residual[free])
            balanced = self._balanced(pushed, forces)
            ratio = unbalanced / self._scale(balanced)
            bad = not (elements.least > _LEAST and np.isfinite(ratio))
            if ratio <= max(tolerance, self.least_tolerance) and not bad:
                status = StepStatus.CONVERGED
                break
            if (bad or unbalanced > (1.0 - _DESCENT) * last) and halvings < _MOST_HALVINGS and (iterations or bad):
                halvings += 1
                here = 0.5 * (here + base[0])
                here[:held] = self._lifted.amplitudes(frame)
                elements.pressures[:] = 0.5 * (elements.pressures + base[1])
                follows = False
                pushed, rates = self._press(here, frame, pressed_in)
                continue
            if bad:
                status = StepStatus.INVERTED
            elif iterations >= max_iterations:
                status = StepStatus.SLOW
            if status is not None:
                break
            if iterations and (unbalanced > _FAST * last or halvings):
                # The stiffness is that of other states: the oldest of it, or all where it led astray.
                elements.evaluate(here, False, _GROUPS if halvings > 1 or iterations > _PATIENT else _OLDEST)
            last, halvings, base = unbalanced, 0, (here, elements.pressures.copy())
            here, pushed, rates = self._balance(here, here, forces, frame, pressed_in, tolerance)
            follows, anew = True, 0
            iterations += 1
            if is_foreseen and iterations == 1 and not (self._strange or elements.remember):
                # Tissue bends away from its tangent as it just has, or less, where it goes less far.
                change = here - base[0]
                added = elements.tangent @ change
                residual, balanced = forces + added + pushed, self._balanced(pushed, forces + added)
                doubt = _DOUBT * bend((forces - foreseen)[free], went, float(change @ added))
                ratio = (size(residual[free]) + doubt) / self._scale(balanced)
                if ratio <= max(tolerance, self.least_tolerance):
                    status = StepStatus.CONVERGED
        self.amplitudes[:] = here
        self._strange = max(0, self._strange - _OLDEST) if status is StepStatus.CONVERGED else _GROUPS
        stiffness, error, wrench, stiffness_age = None, None, np.zeros(6), 0.0
        if status is StepStatus.CONVERGED:
            lifted = self._lifted.rates(frame)
            wrench = contact.wrench - lifted.T @ residual[:held]
            if self._asked and contact.has_friction and pose == self._pose:
                # What has slipped would slip on, as while the tool went.
                _, rates = self._press(here, frame, pressed_in, slips_on=True)
            response = Response(elements.tangent + rates, contact, lifted, free, residual)
            self._prediction.learn(np.array(motion(self._pose, pose)), here - self._committed[0], response.answer,
                                   response.left)
            error = response.force_error(self.reduced.error_factors, wrench[:3], self.missing_force)
            if self._asked:
                age = elements.stiffness_age(here)
                if age == 0.0:
                    # No time passed, so no age would state that the stiffness is that of another state.
                    elements.evaluate(here, not np.array_equal(here, looked), _GROUPS)
                    looked, forces = here, elements.forces.copy()
                    response = Response(elements.tangent + rates, contact, lifted, free, residual)
                stiffness, stiffness_age = response.stiffness(self.reduced.box), age or 0.0
            contact.commit()
            elements.commit()
            self._committed, self._known, self._forces = (here.copy(), elements.pressures.copy()), looked, forces
            self._pose = pose
            self._largest_force = max(self._largest_force, balanced)
        return Step(status, iterations, ratio, cast("Screw", tuple(wrench.tolist())),
                    None if stiffness is None else cast("Matrix", tuple(map(tuple, stiffness.tolist()))),
                    contact.violation, contact.slipping, force_error=error, stiffness_age=stiffness_age)

    def _rest(self, pose: Pose) -> Step:
        """Elastic tissue that nothing touches, in a tick that has time to compute some of the stiffness at rest."""
        if self._committed[0].any():
            self._rested = 0
        if self._rested < _GROUPS:
            self._rested += 1
            self.elements.evaluate(self.amplitudes, False, 1)
        self._committed, self._forces = (self.amplitudes.copy(), self.elements.pressures.copy()), 0.0 * self._forces
        self._known, self._pose = self.amplitudes.copy(), pose
        self._prediction.forget()
        self.contact.forget()
        stiffness = ((0.0,) * 6,) * 6 if self._asked else None
        return Step(StepStatus.CONVERGED, 0, 0.0, (0.0,) * 6, stiffness)

    @property
    def is_at_rest(self) -> bool:
        """See `PlacedReduced.is_at_rest`."""
        return self._rested >= _GROUPS and not self._committed[0].any()

    def _press(self, amplitudes: np.ndarray, frame: Frame, pressed_in: bool, *, slips_on: bool = False
               ) -> tuple[np.ndarray, np.ndarray]:
        """The contact's forces on the modes, and their derivatives."""
        self.contact.evaluate(amplitudes, frame, pressed_in, slips_on=slips_on)
        return self.contact.on_modes()

    def _balanced(self, pushed: np.ndarray, forces: np.ndarray) -> float:
        """Force on the modes of the contact and, by the forces of the elements, of the held face."""
        return size(pushed) + size(forces[: self._lifting])

    def _scale(self, balanced: float) -> float:
        """Force by which unbalanced forces are divided."""
        return max(balanced, self._floor, _FLOOR_SHARE * self._largest_force)

    def _balance(self, guess: np.ndarray, known: np.ndarray, forces: np.ndarray, frame: Frame, pressed_in: bool,
                 tolerance: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Solve the contact on tissue whose forces grow linearly from a state where they are known.

        Args:
            guess: amplitudes to begin with; their first ones, which the tool's pose says, stay.
            known: amplitudes at which the elements have these forces on the modes, shape (modes,).

        Returns:
            Amplitudes, the contact's forces there, and their derivatives.
        """
        free, tangent = self._free, self.elements.tangent
        goal = _INNER * max(tolerance, self.least_tolerance)
        at, before, last, halvings, solves = guess, guess, np.inf, 0, 0
        while True:
            pushed, rates = self._press(at, frame, pressed_in)
            resisted = forces + tangent @ (at - known)
            residual = (resisted + pushed)[free]
            unbalanced = size(residual)
            if unbalanced <= goal * self._scale(self._balanced(pushed, resisted)) or solves >= _MOST_SOLVES:
                return at, pushed, rates
            if unbalanced > (1.0 - _DESCENT) * last and halvings < _MOST_HALVINGS:
                at, halvings = 0.5 * (at + before), halvings + 1
                continue
            before, last, halvings = at, unbalanced, 0
            at = at.copy()
            at[free] -= solution((tangent + rates)[free, free], residual)
            solves += 1

    def accepts_pose(self, pose: Pose) -> bool:
        """See `Solver.accepts_pose`: in the box, or where it touches nothing."""
        return any(self._where(pose, Frame(pose, self.datum)))

    def _where(self, pose: Pose, frame: Frame) -> tuple[bool, bool]:
        """Whether a tool there is in the box, and whether it touches nothing outside of it."""
        box, start = self.reduced.box, self._start
        inside = box.holds(pose, start)
        clear = not inside and self._is_clear_of(frame)
        # A tool that goes up out of the box takes leave of the tissue within the width of the layer.
        return inside or (not (clear or self._lifting) and box.is_under(pose, start)), clear

    def _renew(self) -> None:
        """Another state has been put in place: its volumes, and all of its stiffness."""
        self._rested = self._strange = 0
        self._go_back()
        self.elements.renew(self.amplitudes)
        self._known, self._forces = self.amplitudes.copy(), self.elements.forces.copy()

    def _go_back(self) -> None:
        """To the last committed state."""
        self.amplitudes[:], self.elements.pressures[:] = self._committed

    def lift_off(self) -> None:
        """Take the tool away at once; see `Solver.lift_off`."""
        self._committed[0][:], self._committed[1][:] = 0.0, self.elements.rest_pressures
        self._prediction.forget()
        self.contact.forget()
        self._pose, self._largest_force = self._start, 0.0
        self._renew()

    def forget(self) -> None:
        """Become tissue that nobody has touched."""
        self.elements.forget()
        self.lift_off()

    def save(self) -> SavedState:
        """All that a committed step leaves behind, for `restore`."""
        return SavedState(tuple(array.copy() for array in self._kept), self._pose, self._largest_force, self._landed)

    def restore(self, saved: SavedState) -> None:
        """Go back to where `save` was called."""
        self.place_tool(saved.start or self._start)
        for array, before in zip(self._kept, saved.arrays, strict=True):
            array[:] = before
        self._pose, self._largest_force = saved.pose, saved.largest_force
        self._renew()

    @property
    def _kept(self) -> tuple[np.ndarray, ...]:
        return (*self._committed, *self._prediction.kept, *self.contact.kept, *self.elements.kept)

    def displacement(self) -> np.ndarray:
        """Of all nodes at the last committed state, m, shape (nodes, 3)."""
        return (self.reduced.basis @ self._committed[0]).reshape(-1, 3) + self.reduced.places - self.mesh.nodes

    #: What `fields` needs of the last committed state.
    sample = displacement

    def fields(self, samples: Sequence[Any]) -> Fields | None:
        """See `reduced_fields`."""
        return reduced_fields(self.mesh, self.material, samples, self.datum, self.reduced.element_layers)

    def surface(self) -> SolidSurface:
        """The surface at the last committed state."""
        return SolidSurface(self.mesh, self.displacement(), self.datum)

    def report(self) -> dict[str, Any]:
        """See `Solver.report`."""
        report = {"element": self.mesh.element.name,
                  "mesh": {"elements": len(self.mesh.connectivity), "freedoms": 3 * len(self.mesh.nodes)},
                  "reduced": dict(self.reduced.report), "penetration_mm": 0.0,
                  "penetration_tolerance_mm": self.reduced.softness * self._reach * 1e3}
        if self.contact.has_friction:
            report["slipping_points"] = 0
        if self.reduced.rest is not None:
            report["self_weight"] = {"sag_mm": 1e3 * self.reduced.sag,
                                     "moulded_height_mm": 1e3 * float(np.ptp(self.mesh.nodes[:, 2]))}
        return report


def make_solver(model: Model, *, resolution: str = "realtime", mesh: SolidMesh | ReducedModel | None = None,
                topology: Model | None = None) -> ReducedSolver:
    """The solver of a reduced model; see `tissue_sim.fem.solver.SolverMaker`.

    Args:
        model: the experiment of the reduced model, and a material.
        resolution, topology: not supported; `topology` must be None.
        mesh: the `ReducedModel`.

    Raises:
        InputError: no reduced model, or the experiment of another one.
    """
    if not isinstance(mesh, ReducedModel):
        raise InputError("must be a ReducedModel, as `tissue-sim reduce` writes it", field="mesh")
    if topology is not None:
        raise InputError("a reduced model has the geometry that it was made of; leave the topology out",
                         field="topology")
    made_of = mesh.model.experiment
    for name in ("specimen", "tool", "friction", "friction_base", "friction_wall", "approach"):
        if getattr(model.experiment, name) != getattr(made_of, name):
            raise InputError("a reduced solid has the one that it was made of; take that, or make another one",
                             field=f"experiment.{name}")
    return ReducedSolver(mesh, model.material)
