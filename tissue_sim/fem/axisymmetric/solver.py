"""Solver of the axisymmetric solid: mesh, material, supports and contact, stepped by the depth of the tool."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from tissue_sim.fem.axisymmetric import newton
from tissue_sim.fem.axisymmetric.contact import Contact, SpanColumn
from tissue_sim.fem.axisymmetric.creep import creep
from tissue_sim.fem.axisymmetric.equations import Equations
from tissue_sim.fem.axisymmetric.fields import Fields
from tissue_sim.fem.axisymmetric.predictor import extrapolation_weights
from tissue_sim.fem.axisymmetric.resolutions import RESOLUTIONS, realtime_levels
from tissue_sim.fem.axisymmetric.state import SavedState
from tissue_sim.fem.axisymmetric.surface import DeformedSurface, deformed_surface
from tissue_sim.fem.axisymmetric.touch import bind_ahead, place_at_first_touch
from tissue_sim.fem.free_tool import AT_REST
from tissue_sim.fem.inertia import Motion
from tissue_sim.fem.solver import ErrorEstimate, Neighbours, OwnStiffness, ResolutionLevel, Solver, Step, StepStatus
from tissue_sim.kernel_owner import KernelOwner
from tissue_sim.material.material import Material
from tissue_sim.mesh import Mesh
from tissue_sim.model import Model
from tissue_sim.pose import NO_ROTATION, Pose
from tissue_sim.tool_force import PredictedForce, get_depth_of_pose, make_axial_stiffness_matrix, make_axial_wrench

if TYPE_CHECKING:
    from tissue_sim.fem.axisymmetric.sensitivity import Sensitivity

#: Largest depth of the tool over the height of the specimen. At a stretch of 0.444 the free surface of compressed
#: incompressible neo-Hookean tissue becomes unstable (surface instability); beyond it equilibria are not unique.
#: Source: Biot, Appl. Sci. Res. A 12 (1963) 168.
MAX_RELATIVE_DEPTH = 1.0 - 0.444

_STATUSES = {int(status): status for status in StepStatus}


@dataclass(frozen=True, eq=False)
class Sample:
    """Committed state for the computation of fields.

    Attributes:
        state: nodal displacements, pressure amplitudes, contact forces, shape (unknowns,).
        stresses: isochoric second Piola stresses, see `Fields.stresses`; None for tissue without memory.
    """

    state: np.ndarray
    stresses: np.ndarray | None


class AxisymmetricSolver(KernelOwner, Solver):
    """Stateful Newton solver of one axisymmetric boundary-value problem with contact.

    Args:
        mesh: undeformed mesh.
        material: law, parameters, bulk response.
        supports: node set -> fixed components, ``"r"``, ``"z"`` or ``"rz"``.
        tool: node set -> components that are bonded to the tool: ``"z"`` moves with the tool, ``"rz"`` also sticks.
        contact: contact pairs; None without contact.
        specific_weight: density times gravity, N/m3, towards -z.
        element_layers: index of the material's layer of each element, shape (elements,); the number of layers, or None
            for all elements, stands for no layer.
        contact_radius: radius that determines the drainage time of the pores, m, see `Material.relaxation`.
        start: solver on the same mesh whose last state is the initial state, in which the tool touches; its contact
            pairs are the first pairs of this solver. None: the undeformed mesh.

    Raises:
        InputError: the bulk ratio is outside `BULK_RATIOS`.
        MissingBackendError: Taichi is not installed.
    """

    def __init__(self, mesh: Mesh, material: Material, supports: dict[str, str], tool: dict[str, str], *,
                 contact: Contact | None = None, specific_weight: float = 0.0, element_layers: np.ndarray | None = None,
                 contact_radius: float = 1.0, start: AxisymmetricSolver | None = None):
        self.mesh = mesh
        self.equations: Equations = Equations(mesh, material, supports, tool, contact, specific_weight, element_layers,
                                              contact_radius, None if start is None else start.equations)
        equations = self.equations
        self.committed = equations.state
        #: Derivatives with respect to the material; None unless `differentiate` was called.
        self._sensitivity: Sensitivity | None = None
        # Target depth of the last iteration (m), and its number of linear solves.
        self._target_depth, self._iterated, self._pose = 0.0, 0, Pose.at_depth(0.0)
        self.datum = equations.settings[newton.Setting.TOUCH] = 0.0 if contact is None else place_at_first_touch(
            mesh, contact, equations.surface, equations.start.reshape(-1, 2))
        self.committed.store_initial_bonds()
        self._max_depth = MAX_RELATIVE_DEPTH * float(np.ptp(mesh.nodes[:, 1]))
        self._holds_tissue = any(mesh.sets[name].size for name in tool)

    def set_material(self, material: Material) -> None:
        """Change parameters, bulk response or law of the material; the displacements stay.

        Raises:
            InputError: the bulk ratio is outside `BULK_RATIOS`; nothing is changed.
        """
        before = self.equations.material.mu0
        self.equations.set_material(material)
        # Pressures and contact forces scale with the modulus, exactly if all moduli change by the same factor.
        self.committed.history[:, self.equations.equation.size :] *= material.mu0 / before

    def project_pose(self, pose: Pose) -> Pose:
        """Return the pose on the axis, upright, at the depth of a pose."""
        x, y, z = pose.position
        if x == y == 0.0 and pose.orientation == NO_ROTATION:
            return pose
        return Pose((0.0, 0.0, z))

    def accepts_pose(self, pose: Pose) -> bool:
        """Whether the depth is at most `MAX_RELATIVE_DEPTH`, up to which the equilibrium is unique."""
        return pose.depth <= self._max_depth

    def step(self, pose: Pose | float, dt: float = 0.0, *, tolerance: float = 1e-9, max_iterations: int = 20,
             predictor_order: int = 2, inertial: bool = False, resumes: bool = False,
             own_stiffness: int = OwnStiffness.IF_LEFT) -> Step:
        """Move the tool to a depth (m), or to the depth of a pose, and solve for equilibrium; see `Solver.step`."""
        state, rate = self.committed, 0.0
        if state.motion is not None and inertial:
            rate = state.motion.prepare(state.latest, dt)
        return self.try_step(get_depth_of_pose(pose), dt, tolerance, max_iterations, predictor_order, rate,
                             inertial=inertial,
                             resumes=resumes, own_stiffness=own_stiffness)

    def try_step(self, depth: float, dt: float, tolerance: float, max_iterations: int, predictor_order: int,
                 rate: float, *, inertial: bool = False, resumes: bool = False,
                 own_stiffness: int = OwnStiffness.IF_LEFT) -> Step:
        """Solve a step with the force `rate` times mass times displacement from rest (`Equations.rest`).

        Args:
            depth: depth of the tool, m.
            dt: duration, s.
            tolerance: relative residual of a converged step.
            max_iterations: maximum number of linear solves.
            predictor_order: order of the extrapolation of earlier states.
            rate: factor, 1/s2; of artificial damping, N/m4; 0: quasi-static.
            inertial: whether the force is that of inertia.
            resumes: whether the iteration of the last call continues.
            own_stiffness: an `OwnStiffness`.
        """
        equations, state = self.equations, self.committed
        if not resumes:
            by_time = inertial and len(state.times) > 1
            equations.predict(extrapolation_weights(state.times, dt, predictor_order) if by_time
                              else extrapolation_weights(state.depths, depth, predictor_order))
        equations.prepare(dt)
        equations.settings[newton.Setting.INERTIA] = rate
        self._iterated *= resumes
        equations.solve(depth, tolerance, max_iterations, resumed_depth=self._target_depth if resumes else None,
                        iterated=self._iterated)
        self._target_depth = depth
        self._iterated += int(equations.report[newton.Report.ITERATIONS])
        status, iterations, residual, force, violation, slipping, stiffness = equations.report.tolist()
        asked = bool(equations.counts[newton.Count.STIFFNESS_ASKED])
        result = Step.axial(_STATUSES[int(status)], int(iterations), residual, force, violation, int(slipping),
                            stiffness if asked else None)
        if result.status is StepStatus.CONVERGED and asked and inertial:
            is_due = OwnStiffness.is_due(own_stiffness, iterations < max_iterations)
            own = equations.stiffness_without_mass() if is_due else None
            result = replace(result, step_stiffness_matrix=result.stiffness_matrix,
                             stiffness_matrix=None if own is None else make_axial_stiffness_matrix(own))
        if result.status is StepStatus.CONVERGED:
            if inertial or rate == 0.0:  # the force of artificial damping is no load
                state.largest_force = max(state.largest_force, abs(force))
            if self._sensitivity is not None:
                self._sensitivity.advance()
            if state.motion is not None:
                state.motion.commit(state.latest, state.x, dt, inertial)
            state.commit(depth, dt if inertial else 0.0, watched=asked)
        return result

    def creep(self, pose: Pose | float, dt: float = 0.0, *, tolerance: float = 1e-9, max_iterations: int = 20,
              allowed: Callable[[], int] | None = None) -> Generator[Step]:
        """Step to a depth (m), or to that of a pose, with decreasing artificial damping; see `Solver.creep`."""
        return creep(self, get_depth_of_pose(pose), dt, tolerance, max_iterations, allowed)

    def follow_motion(self, density: float) -> bool:
        """Enable inertial steps with a mass density, kg/m3; returns True, because the solver supports inertia."""
        equations = self.equations
        self.committed.motion = Motion(equations.masses, equations.rest, density * equations.node_masses)
        equations.settings[newton.Setting.DENSITY] = density
        self._masses = density * equations.all_masses()
        return True

    def ahead(self, dt: float) -> PredictedForce | None:
        """Predict the force of the next inertial step without motion; see `Solver.ahead`.

        Let D be the displacement of all degrees of freedom per depth of the tool, f the internal forces and a the
        accelerations. The force is D.(f + M a), and its derivative with respect to the depth is D.(K + rate M) D. In a
        next step without motion f stays constant unless the tissue relaxes, and a results from the finite differences
        in time. A change of contact changes D.
        """
        motion, equations = self.committed.motion, self.equations
        _, _, _, force, _, _, stiffness = equations.report.tolist()
        if motion is None or stiffness <= 0.0:
            return None
        more, stiffer = map(float, motion.ahead(self.committed.latest, dt, self._masses,
                                                equations.compute_displacement_per_depth()))
        return PredictedForce(make_axial_wrench(force + more),
                              make_axial_stiffness_matrix(max(stiffness + stiffer, 0.0)))

    def ask_for_stiffness(self) -> None:
        """Enable the computation of the stiffness (derivative of the force with respect to the depth) in every step."""
        self.equations.counts[newton.Count.STIFFNESS_ASKED] = 1

    @classmethod
    def realtime_levels(cls, model: Model) -> Sequence[ResolutionLevel]:
        """See `Solver.realtime_levels`."""
        return realtime_levels(model.experiment)

    @classmethod
    def error_estimate(cls, resolution: str) -> ErrorEstimate | None:
        """See `Solver.error_estimate`."""
        return RESOLUTIONS[resolution].error_estimate if resolution in RESOLUTIONS else None

    def differentiate(self, neighbours: Neighbours) -> Sensitivity | None:
        """Compute exact derivatives of the force with respect to the material in every step; see `Sensitivity`.

        To be called before the first step.

        Returns:
            None with effects at the quadrature points, contact laws or weight, for which no derivatives exist.
        """
        equations = self.equations
        if neighbours and (equations.effects.formulas or equations.specific_weight
                           or (equations.contact is not None and equations.contact.laws)):
            return None
        from tissue_sim.fem.axisymmetric.sensitivity import Sensitivity

        self._sensitivity = Sensitivity(self.equations, neighbours)
        return self._sensitivity

    @property
    def relaxes(self) -> bool:
        """See `FreeTool.relaxes`."""
        return self.equations.remembers

    def clearance(self, pose: Pose) -> float | None:
        """See `FreeTool.clearance`; None for a tool that is bonded to tissue, and with contact laws."""
        equations, surface = self.equations, self.equations.surface
        own, contact = surface.moves, equations.contact
        if (contact is None or contact.laws or self._holds_tissue or not own.any() or surface.anchors[own, 0].any()
                or surface.spans[own, SpanColumn.STAYS].any()):
            return None
        positions = surface.positions(self.committed.latest[: 2 * len(self.mesh.nodes)].reshape(-1, 2))
        positions[own, 1] += pose.depth - self.datum
        return float(surface.gaps(positions)[own].min())

    def move_in_air(self, pose: Pose) -> None:
        """See `FreeTool.move_in_air`."""
        self.committed.move_tool(pose.depth)

    def move_to_next_touch(self, pose: Pose) -> bool:
        """Move a lifted tool to its next touch; return whether the touch begins as a first touch.

        See `FreeTool.move_to_next_touch`.
        """
        tolerance = AT_REST * float(self.equations.settings[newton.Setting.CONTACT_TOLERANCE])
        begins = not self.relaxes and self.committed.is_at_rest(2 * len(self.mesh.nodes), tolerance)
        if begins:
            self.committed.lift_off()
        else:
            self.move_in_air(pose)
        return begins

    def bind_points_on_path(self, pose: Pose) -> None:
        """Bind the points with friction that touch in the first half of an increment.

        See `FreeTool.bind_points_on_path`.
        """
        committed = self.committed
        if committed.motion is not None:
            committed.motion.restart()
        bind_ahead(self.equations.surface, committed.latest[: 2 * len(self.mesh.nodes)].reshape(-1, 2),
                   committed.depths[0] - self.datum, pose.depth - committed.depths[0])

    def stand_still(self) -> None:
        """See `FreeTool.stand_still`."""
        if self.committed.motion is not None:
            self.committed.motion.stop()

    def lift_off(self) -> None:
        """Remove the tool in one step; see `Solver.lift_off`."""
        self.committed.lift_off()

    def save(self) -> SavedState:
        """Return a copy of the committed state, for `restore`."""
        return self.committed.save()

    def restore(self, saved: SavedState) -> None:
        """Return to a saved state."""
        self.committed.restore(saved)

    @property
    def pose(self) -> Pose:
        """Pose of the tool at the last committed state."""
        if self._pose.position[2] != -self.committed.depths[0]:
            self._pose = Pose.at_depth(self.committed.depths[0])
        return self._pose

    @property
    def depth(self) -> float:
        """Depth of the tool at the last committed state, m."""
        return self.committed.depths[0]

    @property
    def unchanged(self) -> int:
        """Number of equilibria since a contact point last touched, separated, stuck or slipped.

        Counted if stiffness is requested. The number is at least 1 if contact iterates on the linearised tissue,
        because linear extrapolation then reaches the change of contact.
        """
        return max(self.committed.unchanged, int(self.equations.has_contact_rounds))

    @property
    def state(self) -> np.ndarray:
        """Copy of the last committed state: nodal displacements (m), pressure amplitudes, contact forces (N)."""
        return self.committed.latest.copy()

    @property
    def sag(self) -> float:
        """Sag at the first touch: area average of the downward displacement of the top under the weight, m."""
        from scipy.integrate import simpson

        top = self.mesh.sets["top"]
        r = self.mesh.nodes[top, 0]
        return -float(simpson(self.equations.start[2 * top + 1] * r, x=r) / simpson(r, x=r))

    def field_sample(self) -> Sample:
        """Return the data of the last committed state from which `fields` computes fields."""
        equations = self.equations
        if not equations.remembers:
            return Sample(self.state, None)
        stresses = equations.memory.total()
        return Sample(self.state, stresses + equations.effects.stress if equations.effects.formulas else stresses)

    def fields(self, samples: Sequence[Sample]) -> Fields:
        """Return the fields of states that `field_sample` returned."""
        equations = self.equations
        reference = equations.reference
        stresses = [sample.stresses for sample in samples if sample.stresses is not None]
        return Fields(self.mesh, equations.material, equations.bulk_modulus,
                      np.array([sample.state for sample in samples]), reference.node_gradients,
                      reference.pressure_modes, reference.weights, equations.moduli,
                      np.array(stresses) if stresses else None)

    def deformed_surface(self) -> DeformedSurface:
        """Return the surface at the last committed state, with z relative to the height of the first touch."""
        return deformed_surface(self.mesh, self.state, self.datum)

    def report(self) -> dict[str, Any]:
        """Return the metadata of recordings about the solver; see `Solver.report`."""
        contact = self.equations.contact
        report = {"element": self.mesh.element.name,
                  "mesh": {"elements": len(self.mesh.connectivity), "freedoms": self.equations.free}}
        if contact is not None:
            report |= {"penetration_mm": 0.0, "penetration_tolerance_mm": contact.tolerance * 1e3}
            if self.equations.surface.slips:
                report["slipping_points"] = 0
        if self.equations.specific_weight:
            report["self_weight"] = {"sag_mm": self.sag * 1e3,
                                     "moulded_height_mm": -float(self.mesh.nodes[:, 1].min()) * 1e3}
        return report
