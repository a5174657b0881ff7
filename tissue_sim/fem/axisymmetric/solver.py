"""The axisymmetric solid: a mesh, a material and how its faces are held, stepped by tool displacement."""

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
from tissue_sim.fem.axisymmetric.predictor import extrapolation
from tissue_sim.fem.axisymmetric.resolutions import RESOLUTIONS, realtime_levels
from tissue_sim.fem.axisymmetric.state import SavedState
from tissue_sim.fem.axisymmetric.surface import DeformedSurface, deformed_surface
from tissue_sim.fem.axisymmetric.touch import bind_ahead, bring_down
from tissue_sim.fem.free_tool import AT_REST
from tissue_sim.fem.inertia import Motion
from tissue_sim.fem.solver import ErrorEstimate, Neighbours, OwnStiffness, ResolutionLevel, Solver, Step, StepStatus
from tissue_sim.kernel_owner import KernelOwner
from tissue_sim.material.material import Material
from tissue_sim.mesh import Mesh
from tissue_sim.model import Model
from tissue_sim.pose import NO_ROTATION, Pose
from tissue_sim.tool_force import NextForce, axial_stiffness, axial_wrench, depth_of

if TYPE_CHECKING:
    from tissue_sim.fem.axisymmetric.sensitivity import Sensitivity

#: Largest depth of the tool over the height of the specimen. At a stretch of 0.444 a free surface of compressed
#: incompressible neo-Hookean tissue folds; beyond it there are several equilibria, and a mesh finds any of them.
#: Source: Biot, Appl. Sci. Res. A 12 (1963) 168.
DEEPEST = 1.0 - 0.444

_STATUSES = {int(status): status for status in StepStatus}


@dataclass(frozen=True, eq=False)
class Sample:
    """A committed state, and the isochoric stresses of its memory where it has one; see `Fields`."""

    state: np.ndarray
    stresses: np.ndarray | None


class AxisymmetricSolver(KernelOwner, Solver):
    """Stateful Newton solver of one axisymmetric boundary-value problem.

    Args:
        mesh: undeformed mesh.
        material: law, parameters, bulk response.
        supports: node set -> components held, ``"r"``, ``"z"`` or ``"rz"``.
        tool: node set -> components that follow the tool: ``"z"`` moves with it, ``"rz"`` also sticks to it.
        contact: the surface that the tool may meet besides.
        specific_weight: density times gravity, N/m3, towards -z.
        element_layers: number of the material's layer of each element, shape (elements,); that after the last one
            stands for none, as does None for all.
        contact_radius: m; how fast the pores drain, see `Material.relaxation`.
        start: a solver on the same mesh whose last state is the one in which the tool touches; its contact pairs are
            the first of this one's. None: the undeformed mesh.

    Raises:
        InputError: bulk ratio outside `BULK_RATIOS`.
        MissingBackendError: Taichi is not there.
    """

    def __init__(self, mesh: Mesh, material: Material, supports: dict[str, str], tool: dict[str, str], *,
                 contact: Contact | None = None, specific_weight: float = 0.0, element_layers: np.ndarray | None = None,
                 contact_radius: float = 1.0, start: AxisymmetricSolver | None = None):
        self.mesh = mesh
        self.equations: Equations = Equations(mesh, material, supports, tool, contact, specific_weight, element_layers,
                                              contact_radius, None if start is None else start.equations)
        equations = self.equations
        self.committed = equations.state
        #: Rates with the parameters of the material, where somebody asked for them.
        self._sensitivity: Sensitivity | None = None
        # Where the last iteration was meant to end, and its linear solves.
        self._tried, self._iterated, self._pose = 0.0, 0, Pose.at_depth(0.0)
        self.datum = equations.settings[newton.Setting.TOUCH] = 0.0 if contact is None else bring_down(
            mesh, contact, equations.surface, equations.start.reshape(-1, 2))
        self.committed.note_bonds()
        self._deepest = DEEPEST * float(np.ptp(mesh.nodes[:, 1]))
        self._holds = any(mesh.sets[name].size for name in tool)

    def set_material(self, material: Material) -> None:
        """Change parameters, bulk response or law; the state is kept.

        Raises:
            InputError: bulk ratio outside `BULK_RATIOS`; nothing is changed.
        """
        before = self.equations.material.mu0
        self.equations.set_material(material)
        # Where all moduli change alike, the tissue stays where it is and its forces follow them.
        self.committed.history[:, self.equations.equation.size :] *= material.mu0 / before

    def project_pose(self, pose: Pose) -> Pose:
        """On the axis and upright at the depth of the pose."""
        x, y, z = pose.position
        if x == y == 0.0 and pose.orientation == NO_ROTATION:
            return pose
        return Pose((0.0, 0.0, z))

    def accepts_pose(self, pose: Pose) -> bool:
        """Whether the tool is above the depth at which compressed tissue loses its one equilibrium; see `DEEPEST`."""
        return pose.depth <= self._deepest

    def step(self, pose: Pose | float, dt: float = 0.0, *, tolerance: float = 1e-9, max_iterations: int = 20,
             predictor_order: int = 2, inertial: bool = False, resumes: bool = False,
             own_stiffness: int = OwnStiffness.IF_LEFT) -> Step:
        """Move the tool to a depth, m, or that of a pose, and find equilibrium; see `Solver.step`."""
        state, rate = self.committed, 0.0
        if state.motion is not None and inertial:
            rate = state.motion.prepare(state.latest, dt)
        return self.try_step(depth_of(pose), dt, tolerance, max_iterations, predictor_order, rate, inertial=inertial,
                             resumes=resumes, own_stiffness=own_stiffness)

    def try_step(self, depth: float, dt: float, tolerance: float, max_iterations: int, predictor_order: int,
                 rate: float, *, inertial: bool = False, resumes: bool = False,
                 own_stiffness: int = OwnStiffness.IF_LEFT) -> Step:
        """A step in which `rate` (1/s2, or N/m4 of a drag) times mass draws each freedom to where it rests."""
        equations, state = self.equations, self.committed
        if not resumes:
            swings = inertial and len(state.times) > 1
            equations.predict(extrapolation(state.times, dt, predictor_order) if swings
                              else extrapolation(state.depths, depth, predictor_order))
        equations.prepare(dt)
        equations.settings[newton.Setting.INERTIA] = rate
        self._iterated *= resumes
        equations.solve(depth, tolerance, max_iterations, goes_on_from=self._tried if resumes else None,
                        iterated=self._iterated)
        self._tried = depth
        self._iterated += int(equations.report[newton.Report.ITERATIONS])
        status, iterations, residual, force, violation, slipping, stiffness = equations.report.tolist()
        asked = bool(equations.counts[newton.Count.STIFFNESS_ASKED])
        result = Step.axial(_STATUSES[int(status)], int(iterations), residual, force, violation, int(slipping),
                            stiffness if asked else None)
        if result.status is StepStatus.CONVERGED and asked and inertial:
            is_due = OwnStiffness.is_due(own_stiffness, iterations < max_iterations)
            own = equations.stiffness_without_mass() if is_due else None
            result = replace(result, step_stiffness_matrix=result.stiffness_matrix,
                             stiffness_matrix=None if own is None else axial_stiffness(own))
        if result.status is StepStatus.CONVERGED:
            if inertial or rate == 0.0:  # not that of a drag
                state.largest_force = max(state.largest_force, abs(force))
            if self._sensitivity is not None:
                self._sensitivity.advance()
            if state.motion is not None:
                state.motion.commit(state.latest, state.x, dt, inertial)
            state.commit(depth, dt if inertial else 0.0, watched=asked)
        return result

    def creep(self, pose: Pose | float, dt: float = 0.0, *, tolerance: float = 1e-9, max_iterations: int = 20,
              allowed: Callable[[], int] | None = None) -> Generator[Step]:
        """Steps to a depth, m, or that of a pose, against a drag that is let go; see `Solver.creep`."""
        return creep(self, depth_of(pose), dt, tolerance, max_iterations, allowed)

    def follow_motion(self, density: float) -> bool:
        """Let the tissue have a mass (kg/m3) from now on, for steps that are inertial; it has one."""
        equations = self.equations
        self.committed.motion = Motion(equations.masses, equations.rest, density * equations.node_masses)
        equations.settings[newton.Setting.DENSITY] = density
        self._masses = density * equations.all_masses()
        return True

    def ahead(self, dt: float) -> NextForce | None:
        """See `Solver.ahead`. The tissue's equations, along the way that it goes with the tool within a step.

        With D = how everything moves for a metre of the tool, with which the stiffness D (K + rate M) D is found, the
        force is D (f + M a) for the tissue's forces f and accelerations a. In a next step without motion f stays, as
        far as nothing relaxes, and a is what the differences say of what stands still. Across a change of contact D is
        another one.
        """
        motion, equations = self.committed.motion, self.equations
        _, _, _, force, _, _, stiffness = equations.report.tolist()
        if motion is None or stiffness <= 0.0:
            return None
        more, stiffer = map(float, motion.ahead(self.committed.latest, dt, self._masses, equations.along_with_tool()))
        return NextForce(axial_wrench(force + more), axial_stiffness(max(stiffness + stiffer, 0.0)))

    def ask_for_stiffness(self) -> None:
        """Let every step answer how the force grows with depth."""
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
        """Carry exact derivatives along from now on, before the first step; there are none with effects at points, laws
        of contact or weight."""
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
        """See `FreeTool.clearance`; None for a tool that holds tissue, and with laws of contact."""
        equations, surface = self.equations, self.equations.surface
        own, contact = surface.moves, equations.contact
        if (contact is None or contact.laws or self._holds or not own.any() or surface.anchors[own, 0].any()
                or surface.spans[own, SpanColumn.STAYS].any()):
            return None
        place = surface.positions(self.committed.latest[: 2 * len(self.mesh.nodes)].reshape(-1, 2))
        place[own, 1] += pose.depth - self.datum
        return float(surface.gaps(place)[own].min())

    def move_in_air(self, pose: Pose) -> None:
        """See `FreeTool.move_in_air`."""
        self.committed.move_tool(pose.depth)

    def approach(self, pose: Pose) -> bool:
        """See `FreeTool.approach`."""
        tolerance = AT_REST * float(self.equations.settings[newton.Setting.CONTACT_TOLERANCE])
        begins = not self.relaxes and self.committed.is_at_rest(2 * len(self.mesh.nodes), tolerance)
        if begins:
            self.committed.lift_off()
        else:
            self.move_in_air(pose)
        return begins

    def meet(self, pose: Pose) -> None:
        """See `FreeTool.meet`; of the points that touch in the first half of the increment."""
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
        """Take the tool away at once; see `Solver.lift_off`."""
        self.committed.lift_off()

    def save(self) -> SavedState:
        """All that a committed step leaves behind, for `restore`."""
        return self.committed.save()

    def restore(self, saved: SavedState) -> None:
        """Go back to where `save` was called."""
        self.committed.restore(saved)

    @property
    def pose(self) -> Pose:
        """Of the tool at the last committed state."""
        if self._pose.position[2] != -self.committed.depths[0]:
            self._pose = Pose.at_depth(self.committed.depths[0])
        return self._pose

    @property
    def depth(self) -> float:
        """Tool displacement of the last committed state, m."""
        return self.committed.depths[0]

    @property
    def unchanged(self) -> int:
        """Equilibria since points last met the tool, left it, stuck or slipped, where stiffness is asked for; one more
        where contact settles in a solution: a line through two states leads it to the change."""
        return max(self.committed.unchanged, int(self.equations.settles))

    @property
    def state(self) -> np.ndarray:
        """The last committed state: nodal displacements, then pressure amplitudes; a copy."""
        return self.committed.latest.copy()

    @property
    def sag(self) -> float:
        """How much lower the top stands, on the mean of its area, than it was moulded when the tool touches, m."""
        from scipy.integrate import simpson

        top = self.mesh.sets["top"]
        r = self.mesh.nodes[top, 0]
        return -float(simpson(self.equations.start[2 * top + 1] * r, x=r) / simpson(r, x=r))

    def sample(self) -> Sample:
        """What `fields` needs of the last committed state."""
        equations = self.equations
        if not equations.remembers:
            return Sample(self.state, None)
        stresses = equations.memory.total()
        return Sample(self.state, stresses + equations.effects.stress if equations.effects.formulas else stresses)

    def fields(self, samples: Sequence[Sample]) -> Fields:
        """Fields of states that `sample` gave."""
        equations = self.equations
        reference = equations.reference
        stresses = [sample.stresses for sample in samples if sample.stresses is not None]
        return Fields(self.mesh, equations.material, equations.bulk_modulus,
                      np.array([sample.state for sample in samples]), reference.node_gradients,
                      reference.pressure_modes, reference.weights, equations.moduli,
                      np.array(stresses) if stresses else None)

    def surface(self) -> DeformedSurface:
        """The surface at the last committed state; z counts from where the tool first touches."""
        return deformed_surface(self.mesh, self.state, self.datum)

    def report(self) -> dict[str, Any]:
        """What a recording's metadata say of the solver; see `Solver.report`."""
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
