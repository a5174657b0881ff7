"""MuJoCo: the tissue's force on a body of an `MjModel`.

The wrench is written to ``MjData.xfrc_applied`` before each ``mj_step``. Verified with MuJoCo 4.0.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from tissue_sim.errors import InputError, MissingBackendError, make_hint_with_similar_or_known_words
from tissue_sim.pose import Pose, invert_pose, multiply_poses
from tissue_sim.realtime.tool_coupling import BodyWrench, CouplingLimits, CouplingState, RigidBodyState, ToolCoupling
from tissue_sim.tool_force import Tissue

if TYPE_CHECKING:
    import mujoco

#: Names and sizes of the user sensors that the adapter writes if the model has them.
SENSORS = {"tissue_wrench": 6, "tissue_status": 1, "tissue_error": 1}
#: Change of velocity by the test forces of the mobility, if the body is free, m/s.
TEST_SPEED = 1e-2
#: Ratio of test torques to test forces, m.
TEST_ARM = 1e-2
#: Value of the sensor ``tissue_error`` for an unknown error, N.
UNKNOWN_ERROR = -1.0


class MujocoTissue:
    """Tissue under a tool that is part of a MuJoCo model.

    Call `step` instead of ``mj_step``, or `apply` before each ``mj_step``, and `reset` after ``mj_resetData``.
    ``xfrc_applied`` of the body belongs to the adapter. The model may have user sensors,
    ``<user name="tissue_wrench" dim="6"/>`` (force and torque about the tip, axes of the world), ``tissue_status``
    (`ForceStatus`) and ``tissue_error`` (N, -1 if unknown). ``mj_step`` sets user sensors to zero, and `step` writes
    them again.

    Args:
        model: compiled model.
        data: its state.
        body: name of the body that carries the tool.
        tissue: `Simulator` or other `Tissue`.
        scene: pose in the world of the centre of the undeformed top of the tissue, z axis out of the tissue; or the
            name of a site, whose pose is read once.
        tip: pose of the tool in the frame of the body, z axis from the tip to the handle; or the name of a site of the
            body.
        limits: see `CouplingLimits`.
        real_time: whether the simulation keeps up with the wall clock, see `ToolCoupling`.
        predicts_motion: whether the motion of the tool in a step is predicted by steps of a copy of the data: one in
            the air, seven in contact. Controls must then be set before `apply`. False: the motion is extrapolated, as
            also with a control, passive or actuator callback; tools lighter than the moving tissue then gain energy.

    Attributes:
        coupling: the coupling, with its last wrench.

    Raises:
        InputError: an unknown body or site, a site of another body, a sensor of another size, or an integrator that
            evaluates forces several times per step.
        MissingBackendError: MuJoCo is not installed.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, *, body: str, tissue: Tissue,
                 scene: str | Pose = "tissue", tip: str | Pose = "tip", limits: CouplingLimits | None = None,
                 real_time: bool = False, predicts_motion: bool = True):
        self._mujoco = _import_mujoco()
        self.model, self.data = model, data
        self._ahead = self._mujoco.MjData(model) if predicts_motion else None
        named = self._find("body", body)
        # A body without joints moves with its parent: masses of all bodies that are welded together count.
        weld = int(model.body_weldid[named])
        self._body = weld or named
        if model.opt.integrator == self._mujoco.mjtIntegrator.mjINT_RK4:
            raise InputError("must be 'Euler', 'implicitfast', 'implicit' or 'discrete'; got 'RK4', whose four stages "
                             "would use the force of the start of the step.", field="integrator")
        self._update_kinematics(data)
        mass, inertia, self._center = self._sum_masses_of_welded_bodies(weld)
        self.coupling = ToolCoupling(
            tissue, scene=self._find_fixed_site(scene) if isinstance(scene, str) else scene,
            tip=self._find_tip(tip, weld) if isinstance(tip, str) else self._convert_tip(named, tip), mass=mass,
            inertia=inertia, limits=limits, real_time=real_time)
        self._sensors = self._find_sensors()
        self.coupling.warm_up()

    def apply(self) -> BodyWrench:
        """Compute the wrench for the present state, write it to ``xfrc_applied`` and the sensors, and return it."""
        data, body = self.data, self._body
        center, offset, linear, angular = self._compute_motion(data)
        wrench = self.coupling.compute_wrench(
            RigidBodyState(data.xpos[body].tolist(), data.xquat[body].tolist(), center.tolist(), linear.tolist(),
                           angular.tolist(), *self._predict_motion(offset)), float(data.time))
        data.xfrc_applied[body, :3] = wrench.force
        data.xfrc_applied[body, 3:] = wrench.torque + np.cross(offset, wrench.force)
        self._write_sensors(wrench)
        return wrench

    def step(self) -> BodyWrench:
        """Apply the wrench, advance MuJoCo by one step with ``mj_step``, and return the wrench of the step."""
        wrench = self.apply()
        self._mujoco.mj_step(self.model, self.data)
        self._write_sensors(wrench)
        return wrench

    def reset(self) -> None:
        """Return to the untouched tissue and remove the wrench; call it after ``mj_resetData``."""
        self.coupling.reset()
        self.data.xfrc_applied[self._body] = 0.0

    def save(self) -> CouplingState:
        """Return the state of the tissue and of the coupling; copy `MjData` together with it."""
        return self.coupling.save()

    def restore(self, state: CouplingState) -> None:
        """Restore a saved state; restore `MjData` together with it."""
        self.coupling.restore(state)

    def clone(self, data: mujoco.MjData) -> MujocoTissue:
        """Return an independent adapter at the same state for a copy of the data, for planners."""
        other = object.__new__(type(self))
        other.__dict__.update(self.__dict__)
        other.data, other.coupling = data, self.coupling.clone()
        other._ahead = None if self._ahead is None else self._mujoco.MjData(self.model)
        return other

    def _compute_motion(self, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return centre of mass, its vector from the centre of mass of `_body` alone, velocity, angular velocity."""
        body, velocity = self._body, np.zeros(6)
        self._update_kinematics(data)
        # Angular velocity, then the velocity at the centre of mass of this body alone, axes of the world.
        self._mujoco.mj_objectVelocity(self.model, data, self._mujoco.mjtObj.mjOBJ_BODY, body, velocity, 0)
        center = data.xpos[body] + data.xmat[body].reshape(3, 3) @ self._center
        offset = center - data.xipos[body]
        return center, offset, velocity[3:] + np.cross(velocity[:3], offset), velocity[:3]

    def _predict_motion(self, offset: np.ndarray) -> tuple[Any, ...]:
        """Return velocities after the next ``mj_step`` with the last wrench, and the mobility in this step.

        Nothing is predicted with callbacks of the program, which must not be called for a step that does not take
        place. Without a wrench the mobility is not computed.

        Args:
            offset: vector from the centre of mass of `_body` alone to that of the welded bodies, m.
        """
        library, mass = self._mujoco, self.coupling.mass
        if self._ahead is None or mass is None or any(get() is not None for get in (
                library.get_mjcb_control, library.get_mjcb_passive, library.get_mjcb_act_dyn)):
            return ()
        # A restored state of MuJoCo may not contain ``xfrc_applied``.
        last, applied = self.coupling.last, np.zeros(6)
        if last is not None:
            applied[:3], applied[3:] = last.force, last.torque + np.cross(offset, last.force)
        again = self._step_ahead(applied)
        _, _, linear, angular = self._compute_motion(self._ahead)
        if not applied.any():
            return linear.tolist(), angular.tolist(), None
        time_step, jacobian, to_body = self.model.opt.timestep, np.zeros((6, self.model.nv)), np.eye(6)
        library.mj_jac(self.model, self.data, jacobian[:3], jacobian[3:], self.data.xipos[self._body] + offset,
                       self._body)
        to_body[3:, :3] = np.cross(offset, np.eye(3)).T  # torque of a force at the centre of the welded bodies
        sizes = TEST_SPEED / time_step * mass * np.repeat([1.0, TEST_ARM], 3)
        changes = [self._step_ahead(applied + wrench) - again for wrench in (to_body * sizes).T]
        return linear.tolist(), angular.tolist(), jacobian @ np.transpose(changes) / (time_step * sizes)

    def _step_ahead(self, wrench: np.ndarray) -> np.ndarray:
        """Return ``qvel`` after an ``mj_step`` of a copy of the data with a wrench, shape (nv,)."""
        ahead = self._ahead
        assert ahead is not None
        self._mujoco.mj_copyData(ahead, self.model, self.data)
        ahead.xfrc_applied[self._body] = wrench
        self._mujoco.mj_step(self.model, ahead)
        return np.array(ahead.qvel)

    def _update_kinematics(self, data: mujoco.MjData) -> None:
        """Compute poses and velocities of the present state; ``mj_step`` leaves those of the start of its step."""
        library, model = self._mujoco, self.model
        library.mj_kinematics(model, data)
        library.mj_comPos(model, data)
        library.mj_comVel(model, data)

    def _find(self, kind: str, name: str) -> int:
        """Return the number of a named object of the model."""
        library = self._mujoco
        types = {"body": library.mjtObj.mjOBJ_BODY, "site": library.mjtObj.mjOBJ_SITE}
        number = library.mj_name2id(self.model, types[kind], name)
        if number < 0:
            known = {"body": self.model.nbody, "site": self.model.nsite}[kind]
            names = [library.mj_id2name(self.model, types[kind], index) for index in range(known)]
            raise InputError(f"must be the name of a {kind} of the model; got {name!r}"
                             f"{make_hint_with_similar_or_known_words(name, filter(None, names))}. Add the {kind} to "
                             "the MJCF file, or pass the name of another one.", field=kind)
        return int(number)

    def _sum_masses_of_welded_bodies(self, weld: int) -> tuple[float | None, np.ndarray | None, np.ndarray]:
        """Return mass, inertia about the centre of mass, and centre of mass in the frame of `_body`, of welded bodies.

        Mass and inertia are None if the motion is prescribed: a body that is fixed to the world, or a mocap body.

        Args:
            weld: number of the body with joints to which the tool is welded; 0: the world.
        """
        model, data, origin = self.model, self.data, self._get_pose_of_body(self._body)
        if weld == 0 or model.body_mocapid[weld] >= 0:
            return None, None, model.body_ipos[self._body].copy()
        members = [number for number in range(model.nbody) if model.body_weldid[number] == weld]
        masses = model.body_mass[members]
        to_body = np.array(origin.rotation_matrix).T
        centers = (data.xipos[members] - np.array(origin.position)) @ to_body.T
        center = masses @ centers / masses.sum()
        inertia = np.zeros((3, 3))
        for number, mass, place in zip(members, masses, centers - center, strict=True):
            axes = to_body @ data.ximat[number].reshape(3, 3)
            inertia += axes @ np.diag(model.body_inertia[number]) @ axes.T
            inertia += mass * (place @ place * np.eye(3) - np.outer(place, place))
        return float(masses.sum()), inertia if np.linalg.eigvalsh(inertia).min() > 0.0 else None, center

    def _get_pose_of_body(self, body: int) -> Pose:
        """Return the pose of a body in the world."""
        return _make_pose(self.data.xpos[body], self.data.xquat[body])

    def _get_pose_of_site(self, site: int) -> Pose:
        """Return the pose of a site in the world."""
        rotation = np.zeros(4)
        self._mujoco.mju_mat2Quat(rotation, self.data.site_xmat[site])
        return _make_pose(self.data.site_xpos[site], rotation)

    def _find_fixed_site(self, name: str) -> Pose:
        """Return the pose in the world of a site that does not move."""
        site = self._find("site", name)
        if self.model.body_weldid[self.model.site_bodyid[site]] != 0:
            raise InputError(f"must be a site that is fixed to the world; {name!r} moves with a body. The tissue does "
                             "not move.", field="scene")
        return self._get_pose_of_site(site)

    def _find_tip(self, name: str, weld: int) -> Pose:
        """Return the pose of a site of the tool in the frame of `_body`."""
        site = self._find("site", name)
        owner = int(self.model.site_bodyid[site])
        if owner != self._body and (weld == 0 or self.model.body_weldid[owner] != weld):
            raise InputError(f"must be a site of the body that carries the tool; {name!r} belongs to another body.",
                             field="tip")
        return multiply_poses(invert_pose(self._get_pose_of_body(self._body)), self._get_pose_of_site(site))

    def _convert_tip(self, named: int, tip: Pose) -> Pose:
        """Convert the pose of the tool in the frame of the named body to that in the frame of `_body`."""
        root = invert_pose(self._get_pose_of_body(self._body))
        return multiply_poses(root, multiply_poses(self._get_pose_of_body(named), tip))

    def _find_sensors(self) -> dict[str, int]:
        """Return the first index in ``sensordata`` of each user sensor of `SENSORS` that the model has."""
        library, model, found = self._mujoco, self.model, {}
        for name, size in SENSORS.items():
            number = library.mj_name2id(model, library.mjtObj.mjOBJ_SENSOR, name)
            if number < 0:
                continue
            if model.sensor_type[number] != library.mjtSensor.mjSENS_USER or model.sensor_dim[number] != size:
                raise InputError(f"{name!r} must be a user sensor of dimension {size}.", field="sensor")
            found[name] = int(model.sensor_adr[number])
        return found

    def _write_sensors(self, wrench: BodyWrench) -> None:
        """Write wrench at the tip, status and error to the user sensors of the model."""
        values: dict[str, Any] = {"tissue_status": float(wrench.status)}
        if "tissue_wrench" in self._sensors:
            values["tissue_wrench"] = wrench.force + wrench.torque_about_tip
        values["tissue_error"] = UNKNOWN_ERROR if wrench.force_error is None else wrench.force_error
        for name, start in self._sensors.items():
            self.data.sensordata[start:start + SENSORS[name]] = values[name]


def _import_mujoco() -> Any:
    """Import MuJoCo.

    Raises:
        MissingBackendError: it is not installed.
    """
    try:
        import mujoco
    except ImportError:
        raise MissingBackendError("MuJoCo is not installed. Install tissue_sim[mujoco].") from None
    return mujoco


def _make_pose(position: Any, quaternion: Any) -> Pose:
    """Make a pose from arrays of three and four numbers, w first."""
    x, y, z = (float(part) for part in position)
    w, a, b, c = (float(part) for part in quaternion)
    return Pose((x, y, z), (w, a, b, c))
