"""Tests in Newton's soft body, `SolverVBD` on the CPU: linear tetrahedra with a neo-Hookean law.

The energy density is ``W = mu/2 (I1 - 3) + L/2 (J - a)^2``, ``L = lambda + mu``, ``a = 1 + mu/L`` (Smith, De Goes, Kim
2018, without the logarithm). ``k_mu`` and ``k_lambda`` are the constants of Lame at small strains. ``k_damp`` is the
factor of the dissipation ``k_damp/2 |dC/dt|^2`` with ``C = F^T F``, thus of the viscous stress ``4 k_damp dE/dt``; see
`tissue_sim.exports.newton.compute_k_damp`.

Nodes of the base and of a bonded face are particles of zero mass, whose positions are prescribed. In contact the tool
is a kinematic body that nodes touch with the stiffness of a penalty. The friction of Newton is regularised by the
velocity, so that friction forces fade at rest. The tool of a quasi-static test with friction therefore moves slowly
(`VbdSettings.tool_speed`) without waiting.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calibration.targets.runner import TargetTest
from calibration.targets.soft_body import (
    RestSettings,
    SoftBodyRunner,
    SteppedSoftBody,
    compute_deformation_gradients,
    compute_nodal_forces,
)
from tissue_sim.exports.elastic_constants import ElasticConstants
from tissue_sim.exports.newton import compute_k_damp


@dataclass(frozen=True)
class VbdSettings:
    """Numbers of a simulation with vertex block descent.

    Attributes:
        time_step: default time step, s. The steps are implicit, so that long steps come to rest.
        iterations: iterations of block descent per step.
        damping_time: numerical damping of quasi-static tests, s.
        density: density without a stated one, kg/m3; it has no effect at rest.
        particle_radius: radius of the nodes in contact, m.
        contact_stiffness: stiffness of the contact of a node, N/m.
        friction_speed: sliding speed below which friction is less than Coulomb's, m/s.
        tool_speed: speed of the tool in quasi-static tests with friction, m/s.
        contact_gap: distance from the tool in which nodes are listed for contact, m.
        shaft_length: length of the cylinder of a flat punch, m.
    """

    time_step: float = 0.02
    iterations: int = 10
    damping_time: float = 0.07
    density: float = 1000.0
    particle_radius: float = 1e-6
    contact_stiffness: float = 2e3
    friction_speed: float = 1e-4
    tool_speed: float = 2e-3
    contact_gap: float = 2e-3
    shaft_length: float = 0.05


#: Settings of all tests.
SETTINGS = VbdSettings()
#: Rest of a bonded body.
BONDED_REST = RestSettings(max_steps=4000, interval=10)
#: Rest of a body in contact.
CONTACT_REST = RestSettings(speed=2e-5, imbalance=2e-3, tool_speed=0.02, max_steps=4000, interval=10)


def compute_neo_hookean_stress(gradient: np.ndarray, mu: float, lame: float) -> np.ndarray:
    """Return the first Piola-Kirchhoff stress of Newton's law, Pa, of deformation gradients of shape (n, 3, 3)."""
    cofactor = np.stack([np.cross(gradient[:, :, (axis + 1) % 3], gradient[:, :, (axis + 2) % 3])
                         for axis in range(3)], axis=2)
    pressure = (lame + mu) * (np.linalg.det(gradient) - 1.0) - mu
    return mu * gradient + pressure[:, None, None] * cofactor


class VbdBody(SteppedSoftBody):
    """Soft body with a bonded face, or with a kinematic tool in contact.

    Args:
        test: test to simulate.
        constants: elastic constants and damping.
    """

    def __init__(self, test: TargetTest, constants: ElasticConstants):
        # The type hints of both packages reject arguments that they accept.
        wp: Any = importlib.import_module("warp")
        wp.config.log_level = wp.LOG_ERROR  # before Newton is imported, which prints otherwise
        newton: Any = importlib.import_module("newton")
        self.time_step = test.time_step or SETTINGS.time_step
        self._test, self._constants, self._k_damp = test, constants, compute_k_damp(constants)
        mesh = self._mesh = test.tetrahedral_mesh
        self.surface = mesh.surface
        self._base, self._face = mesh.sets["base"], mesh.sets["face"] if test.is_bonded else np.zeros(0, dtype=int)
        builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        builder.add_soft_mesh(pos=wp.vec3(0.0, 0.0, 0.0), rot=wp.quat_identity(), scale=1.0,
                              vel=wp.vec3(0.0, 0.0, 0.0), vertices=[wp.vec3(*node) for node in mesh.nodes.tolist()],
                              indices=mesh.cells.ravel().tolist(), density=constants.density or SETTINGS.density,
                              k_mu=constants.mu, k_lambda=constants.lame, k_damp=self._k_damp,
                              add_surface_mesh_edges=False, particle_radius=SETTINGS.particle_radius)
        self._free = np.setdiff1d(np.arange(len(mesh.nodes)), np.concatenate([self._base, self._face]))
        for node in np.setdiff1d(np.arange(len(mesh.nodes)), self._free).tolist():
            builder.particle_mass[node] = 0.0
        if not test.is_bonded:
            _add_kinematic_tool(newton, wp, builder, test)
        builder.color()
        model = builder.finalize(device="cpu")
        model.soft_contact_ke, model.soft_contact_kd = SETTINGS.contact_stiffness, 0.0
        model.soft_contact_mu = test.friction
        self._solver = self._make_solver(newton, model)
        self._pipeline: Any = None
        self._contacts: Any = None
        self._observables: Any = None
        if not test.is_bonded:
            self._pipeline = newton.CollisionPipeline(model, soft_contact_gap=SETTINGS.contact_gap)
            self._contacts = self._pipeline.contacts()
            self._observables = self._allocate_observables_or_none()
        self._state: Any = model.state()
        self._after: Any = model.state()
        self._control: Any = model.control()
        self._before = self.get_positions()

    def _make_solver(self, newton: Any, model: Any) -> Any:
        """Make the solver of a Newton model."""
        return newton.solvers.SolverVBD(model, iterations=SETTINGS.iterations, friction_epsilon=SETTINGS.friction_speed,
                                        rigid_body_particle_contact_buffer_size=len(self.surface))

    def _allocate_observables_or_none(self) -> Any:
        """Return the arrays for the contact forces; None if the solver does not state them for soft bodies."""
        return self._solver.observables({"contact_f"}, contacts=self._contacts)

    def _compute_stress(self, gradient: np.ndarray, rate: np.ndarray) -> np.ndarray:
        """Return the first Piola-Kirchhoff stress, Pa.

        Args:
            gradient: deformation gradients F, shape (n, 3, 3).
            rate: time derivatives of F^T F, 1/s, shape (n, 3, 3).
        """
        return (compute_neo_hookean_stress(gradient, self._constants.mu, self._constants.lame)
                + 2.0 * self._k_damp * gradient @ rate)

    def advance(self, tool_position: np.ndarray) -> None:
        """Make one time step; see `SteppedSoftBody`."""
        self._before = self.get_positions()
        if self._test.is_bonded:
            positions = self._state.particle_q.numpy()
            positions[self._face] = self._mesh.nodes[self._face] + tool_position - self._test.positions[0]
            self._state.particle_q.assign(positions)
        else:
            for state in (self._state, self._after):
                state.body_q.assign(np.array([[*tool_position, 0.0, 0.0, 0.0, 1.0]], dtype=np.float32))
            self._pipeline.collide(self._state, self._contacts)
        self._solver.step(self._state, self._after, self._control, self._contacts, self.time_step,
                          observables=self._observables)
        self._state, self._after = self._after, self._state

    def get_positions(self) -> np.ndarray:
        """Return the positions of the nodes; see `SteppedSoftBody`."""
        return self._state.particle_q.numpy().astype(float)

    def compute_largest_speed(self) -> float:
        """Return the largest speed; see `SteppedSoftBody`."""
        return float(np.abs(self._state.particle_qd.numpy()[self._free]).max(initial=0.0))

    def compute_forces_on_tool_and_base(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the forces; see `SteppedSoftBody`.

        The force on the base follows from the elastic and viscous stresses at the positions, as does the force on a
        bonded face. In contact the force on the tool is the sum of the contact forces that Newton states,
        or the force on the base if the solver states none.
        """
        mesh, step = self._mesh, self.time_step
        before, after = self._before, self.get_positions()
        old = compute_deformation_gradients(mesh.nodes, mesh.cells, before)

        def stress(gradient: np.ndarray) -> np.ndarray:
            rate = (np.swapaxes(gradient, 1, 2) @ gradient - np.swapaxes(old, 1, 2) @ old) / step
            return self._compute_stress(gradient, rate)

        forces = compute_nodal_forces(mesh.nodes, mesh.cells, after, stress)
        on_base = forces[self._base].sum(axis=0)
        if self._test.is_bonded:
            return -forces[self._face].sum(axis=0), on_base
        if self._observables is None:
            return on_base, on_base
        return self._observables.contact_f.numpy()[:, :3].sum(axis=0, dtype=float), on_base


def _add_kinematic_tool(newton, wp, builder, test: TargetTest) -> None:
    """Add a sphere or a cylinder whose deepest point is the origin of a kinematic body."""
    radius, half = test.tool.require_radius(), 0.5 * SETTINGS.shaft_length
    body = builder.add_body(xform=wp.transform(wp.vec3(*test.positions[0].tolist()), wp.quat_identity()),
                            is_kinematic=True)
    surface = newton.ModelBuilder.ShapeConfig(density=0.0, ke=SETTINGS.contact_stiffness, kd=0.0, mu=test.friction)
    if test.tool.name == "sphere":
        builder.add_shape_sphere(body, xform=wp.transform(wp.vec3(0.0, 0.0, radius), wp.quat_identity()),
                                 radius=radius, cfg=surface)
    else:
        builder.add_shape_cylinder(body, xform=wp.transform(wp.vec3(0.0, 0.0, half), wp.quat_identity()),
                                   radius=radius, half_height=half, cfg=surface)


class NewtonRunner(SoftBodyRunner):
    """Runner of tests in Newton's soft body."""

    title = "Newton VBD"
    program = "Newton"
    package = "newton"
    damping_time = SETTINGS.damping_time
    bonded_rest = BONDED_REST
    contact_rest = CONTACT_REST
    body_type: type[VbdBody] = VbdBody

    def make_body(self, test: TargetTest, constants: ElasticConstants) -> SteppedSoftBody:
        """Make the soft body; see `SoftBodyRunner`."""
        return self.body_type(test, constants)

    def prepare_test(self, test: TargetTest) -> TargetTest:
        """Return a test with times if it has friction, because friction forces fade at rest."""
        if test.times is not None or test.is_bonded or not test.friction:
            return test
        steps = np.linalg.norm(np.diff(test.positions, axis=0), axis=1)
        return replace(test, times=np.concatenate([[0.0], np.cumsum(steps)]) / SETTINGS.tool_speed)


RUNNER = NewtonRunner()
