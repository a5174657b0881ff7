"""Tests in MuJoCo's flex: linear tetrahedra with the law of Saint Venant and Kirchhoff.

The energy density is ``W = mu E:E + lambda/2 (tr E)^2`` with the strain of Green and Lagrange,
``E = (F^T F - I) / 2``. Rayleigh damping ``damping`` times the stiffness is the damping time of Kelvin and Voigt. The
integrator ``discrete`` is implicit in the positions, so that steps of 10 ms with damping come to rest; MuJoCo 4 refuses
elastic flexes with the integrators ``implicit`` and ``implicitfast``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.targets.runner import Progress, TargetCurve, TargetTest
from calibration.targets.soft_body import (
    RestSettings,
    SoftBodyRunner,
    SteppedSoftBody,
    compute_nodal_forces,
)
from tissue_sim.experiment.tools.tool import Tool
from tissue_sim.exports.elastic_constants import ElasticConstants
from tissue_sim.exports.mujoco import format_numbers, make_flex_element
from tissue_sim.material.material import Material


@dataclass(frozen=True)
class FlexSettings:
    """Numbers of a simulation with a flex.

    Attributes:
        time_step: default time step, s.
        damping_time: numerical damping of quasi-static tests, s; the constants of the material replace it if they have
            a larger damping time or if the test has times.
        face_stiffness: stiffness of the springs that move each node of a bonded face, N/m; so large that the nodes
            follow within a few micrometres.
        density: density without a stated one, kg/m3; it has no effect at rest.
        shaft_length: length of the cylinder of a flat punch, m.
        iterations: largest number of iterations of MuJoCo's solver.
        tolerance: tolerance of MuJoCo's solver.
        tool_mass: mass of a tool in contact, whose velocity is prescribed at each step, kg; so large that the contact
            does not change its motion.
        impedance: parameters ``solimp`` of the contact: it is nearly rigid from a penetration of 10 micrometres.
    """

    time_step: float = 0.01
    damping_time: float = 0.1
    face_stiffness: float = 1e4
    density: float = 1000.0
    shaft_length: float = 0.05
    iterations: int = 100
    tolerance: float = 1e-10
    tool_mass: float = 1e3
    impedance: tuple[float, float, float] = (0.95, 0.999, 1e-5)


#: Settings of all tests.
SETTINGS = FlexSettings()
#: Rest of a bonded body.
BONDED_REST = RestSettings(speed=1e-4)
#: Rest of a body in contact. Nodes that leave and enter the contact move faster than bonded ones.
CONTACT_REST = RestSettings(speed=5e-4, imbalance=2e-3, force_change=2e-3, tool_speed=0.02, max_steps=600)


def compute_saint_venant_kirchhoff_stress(gradient: np.ndarray, mu: float, lame: float) -> np.ndarray:
    """Return the first Piola-Kirchhoff stress, Pa, of deformation gradients of shape (n, 3, 3)."""
    strain = 0.5 * (np.swapaxes(gradient, 1, 2) @ gradient - np.eye(3))
    trace = np.trace(strain, axis1=1, axis2=2)[:, None, None]
    return gradient @ (2.0 * mu * strain + lame * trace * np.eye(3))


class FlexBody(SteppedSoftBody):
    """Flex with a bonded face, or in contact with a tool of prescribed motion.

    Args:
        test: test to simulate.
        constants: elastic constants and damping.
    """

    def __init__(self, test: TargetTest, constants: ElasticConstants):
        import mujoco

        self.time_step = test.time_step or SETTINGS.time_step
        mesh = self._mesh = test.tetrahedral_mesh
        self.surface = mesh.surface
        self._mujoco, self._test, self._constants = mujoco, test, constants
        self.model = mujoco.MjModel.from_xml_string(_write_model(test, constants, self.time_step))
        self.data = mujoco.MjData(self.model)
        self._springs, self._tool = np.zeros(0, dtype=int), test.positions[0]
        if test.is_bonded:
            joints = self.model.body_jntadr[self.model.flex_vertbodyid[mesh.sets["face"]]]
            self._springs = self.model.jnt_qposadr[joints][:, None] + np.arange(3)
            self.model.jnt_stiffness[joints[:, None] + np.arange(3)] = SETTINGS.face_stiffness
            self._rest = self.model.qpos0[self._springs]

    def advance(self, tool_position: np.ndarray) -> None:
        """Make one time step; see `SteppedSoftBody`."""
        if self._test.is_bonded:
            self.model.qpos_spring[self._springs] = self._rest + tool_position - self._test.positions[0]
        else:
            # The three slides of the tool are the first joints. A mocap body would have no velocity for the friction.
            self.data.qpos[:3] = self._tool
            self.data.qvel[:3] = (tool_position - self._tool) / self.time_step
            self._tool = tool_position
        self._mujoco.mj_step(self.model, self.data)

    def get_positions(self) -> np.ndarray:
        """Return the positions of the nodes; see `SteppedSoftBody`."""
        self._mujoco.mj_kinematics(self.model, self.data)
        self._mujoco.mj_flex(self.model, self.data)
        return self.data.flexvert_xpos.copy()

    def compute_largest_speed(self) -> float:
        """Return the largest speed; see `SteppedSoftBody`."""
        return float(np.abs(self.data.qvel[0 if self._test.is_bonded else 3:]).max())

    def compute_forces_on_tool_and_base(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the forces; see `SteppedSoftBody`. That on the tool is that of the springs or of the contacts."""
        forces = compute_nodal_forces(
            self._mesh.nodes, self._mesh.cells, self.get_positions(),
            lambda F: compute_saint_venant_kirchhoff_stress(F, self._constants.mu, self._constants.lame))
        on_base = forces[self._mesh.sets["base"]].sum(axis=0)
        if self._test.is_bonded:
            stretches = self.data.qpos[self._springs] - self.model.qpos_spring[self._springs]
            return SETTINGS.face_stiffness * stretches.sum(axis=0), on_base
        return self._sum_contact_forces(), on_base

    def describe_failure(self) -> str:
        """Return why the state is not usable; see `SteppedSoftBody`."""
        if self.data.warning[self._mujoco.mjtWarning.mjWARN_BADQACC].number:
            return "MuJoCo reports accelerations that are not finite"
        return super().describe_failure()

    def _sum_contact_forces(self) -> np.ndarray:
        """Return the sum of the contact forces on the tool, N, shape (3,)."""
        total, force = np.zeros(3), np.zeros(6)
        for number in range(self.data.ncon):
            contact = self.data.contact[number]
            self._mujoco.mj_contactForce(self.model, self.data, number, force)
            # The force acts on the second body of the pair, in the frame of the contact.
            sign = -1.0 if contact.geom[0] >= 0 else 1.0
            total += sign * (contact.frame.reshape(3, 3).T @ force[:3])
        return total


def _write_model(test: TargetTest, constants: ElasticConstants, time_step: float) -> str:
    """Return the MJCF text of a test."""
    mesh, friction = test.tetrahedral_mesh, test.friction
    contact = '<contact selfcollide="none" contype="0" conaffinity="0"/>'
    tool = ""
    if not test.is_bonded:
        surface = (f'condim="{3 if friction else 1}" friction="{friction:.9g} 0 0" '
                   f'solimp="{format_numbers(SETTINGS.impedance)}"')
        contact = f'<contact selfcollide="none" {surface}/>'
        slides = "".join(f'<joint type="slide" axis="{axis}"/>' for axis in ("1 0 0", "0 1 0", "0 0 1"))
        tool = (f'<body name="tool">{slides}<inertial pos="0 0 0" mass="{SETTINGS.tool_mass:g}" '
                f'diaginertia="1 1 1"/>{_write_tool_geometry(test.tool, surface)}</body>')
    flag = '<flag contact="disable"/>' if test.is_bonded else ""
    flex = make_flex_element(constants, mesh, constants.density or SETTINGS.density, contact=contact)
    return (f'<mujoco><option timestep="{time_step:.9g}" integrator="discrete" solver="Newton" cone="elliptic" '
            f'gravity="0 0 0" iterations="{SETTINGS.iterations}" tolerance="{SETTINGS.tolerance:g}">{flag}</option>'
            f'<size memory="4G"/><worldbody>{tool}{flex}</worldbody></mujoco>')


def _write_tool_geometry(tool: Tool, surface: str) -> str:
    """Return the geom of a sphere or a cylinder whose deepest point is the origin of its body."""
    radius, half = tool.require_radius(), 0.5 * SETTINGS.shaft_length
    if tool.name == "sphere":
        return f'<geom type="sphere" size="{radius:.9g}" pos="0 0 {radius:.9g}" {surface}/>'
    return f'<geom type="cylinder" size="{radius:.9g} {half:.9g}" pos="0 0 {half:.9g}" {surface}/>'


class MujocoRunner(SoftBodyRunner):
    """Runner of tests in MuJoCo's flex."""

    title = "MuJoCo flex"
    program = "MuJoCo"
    package = "mujoco"
    damping_time = SETTINGS.damping_time
    bonded_rest = BONDED_REST
    contact_rest = CONTACT_REST

    def make_body(self, test: TargetTest, constants: ElasticConstants) -> SteppedSoftBody:
        """Make the flex; see `SoftBodyRunner`."""
        return FlexBody(test, constants)

    def run(self, test: TargetTest, material: Material | ElasticConstants, progress: Progress | None = None
            ) -> TargetCurve:
        """Simulate a test without the log file of MuJoCo; see `TargetRunner`."""
        if self.describe_missing_program():
            return super().run(test, material, progress)
        import mujoco

        printed = mujoco.get_mju_user_warning()
        # MuJoCo writes the warnings of its solver into a file in the current folder; a body at rest is checked instead.
        mujoco.set_mju_user_warning(lambda message: None)
        try:
            return super().run(test, material, progress)
        finally:
            mujoco.set_mju_user_warning(printed)


RUNNER = MujocoRunner()
