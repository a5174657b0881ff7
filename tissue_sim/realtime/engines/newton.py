"""Newton: the tissue's force on a body of a `newton.Model`.

The wrench is added to ``State.body_f`` before each step of a Newton solver. Verified with Newton 1.8 and Warp 1.19 on
the CPU.
"""

from __future__ import annotations

import operator
from typing import Any

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.pose import Pose
from tissue_sim.realtime.tool_coupling import BodyWrench, CouplingLimits, CouplingState, RigidBodyState, ToolCoupling
from tissue_sim.tool_force import Tissue


class NewtonTissue:
    """Tissue under a tool that is a body of a Newton model.

    Newton's conventions: quaternions are (x, y, z, w); ``body_qd`` is the velocity of the centre of mass, then the
    angular velocity; ``body_f`` is the force, then the torque about the centre of mass, all along the axes of the
    world. Newton computes in single precision.

    Call ``State.clear_forces()`` and then `apply` before each step of the solver.

    Args:
        model: finalised `newton.Model`.
        body: label of the body that carries the tool, or its number.
        tissue: `Simulator` or other `Tissue`.
        scene: pose in the world of the centre of the undeformed top of the tissue, z axis out of the tissue; Newton's
            default has z up, and the quaternion of a `Pose` is (w, x, y, z).
        tip: pose of the tool in the frame of the body, z axis from the tip to the handle.
        limits: see `CouplingLimits`.
        real_time: whether the simulation keeps up with the wall clock, see `ToolCoupling`.

    Attributes:
        coupling: the coupling, with its last wrench.
        time: simulated time since the start or the last reset, s.

    Raises:
        InputError: an unknown body, or a label of several bodies.
    """

    def __init__(self, model: Any, *, body: str | int, tissue: Tissue, scene: Pose | None = None,
                 tip: Pose | None = None, limits: CouplingLimits | None = None, real_time: bool = False):
        self._body = _find_body(model, body)
        self._center = model.body_com.numpy()[self._body].astype(float)
        mass = float(model.body_mass.numpy()[self._body])
        if not mass > 0.0 and not int(model.body_flags.numpy()[self._body]) & _get_kinematic_flag():
            raise InputError(f"must have a mass, or be kinematic; {body!r} has no mass and is not kinematic. Name the "
                             "body that carries the mass of the tool.", field="body")
        inertia = model.body_inertia.numpy()[self._body].astype(float)
        has_inertia = mass > 0.0 and np.linalg.eigvalsh(inertia).min() > 0.0
        self.coupling = ToolCoupling(tissue, scene=scene, tip=tip, mass=mass or None,
                                     inertia=inertia if has_inertia else None, limits=limits, real_time=real_time)
        self.coupling.warm_up()
        self.time = 0.0

    def apply(self, state: Any, dt: float) -> BodyWrench:
        """Compute the wrench for a state, add it to ``state.body_f``, and return it.

        Args:
            state: `newton.State` at the start of the next step of the solver.
            dt: length of the next step, s.
        """
        x, y, z, i, j, k, w = state.body_q.numpy()[self._body].astype(float)
        velocity = state.body_qd.numpy()[self._body].astype(float)
        length = float(np.linalg.norm([w, i, j, k]))
        center = np.full(3, np.nan)
        if length > 0.0 and np.isfinite(length):
            turn = Pose((0.0, 0.0, 0.0), (w / length, i / length, j / length, k / length)).rotation_matrix
            center = np.array([x, y, z]) + np.array(turn) @ self._center
        wrench = self.coupling.compute_wrench(
            RigidBodyState((x, y, z), (w, i, j, k), center.tolist(), velocity[:3].tolist(), velocity[3:].tolist()),
            self.time)
        self.time += dt
        forces = state.body_f.numpy()
        forces[self._body] += np.array(wrench.force + wrench.torque, forces.dtype)
        state.body_f.assign(forces)
        return wrench

    def reset(self) -> None:
        """Return to the untouched tissue at time zero; call it together with the reset of the engine."""
        self.coupling.reset()
        self.time = 0.0

    def save(self) -> tuple[CouplingState, float]:
        """Return the state of the tissue, of the coupling, and the time."""
        return self.coupling.save(), self.time

    def restore(self, state: tuple[CouplingState, float]) -> None:
        """Restore a saved state."""
        self.coupling.restore(state[0])
        self.time = state[1]


def _get_kinematic_flag() -> int:
    """Return the flag of bodies whose motion is prescribed."""
    import newton

    return int(newton.BodyFlags.KINEMATIC)


def _find_body(model: Any, body: str | int) -> int:
    """Return the number of a body.

    Raises:
        InputError: no body or several bodies have this label, or there is no body of this number.
    """
    labels = list(model.body_label)
    if not isinstance(body, str):
        number = operator.index(body)
        if not 0 <= number < len(labels):
            raise InputError(f"must be 0 to {len(labels) - 1}; got {number}.", field="body")
        return number
    found = [number for number, label in enumerate(labels) if label == body] or [
        number for number, label in enumerate(labels) if label.rsplit("/", 1)[-1] == body]
    if len(found) != 1:
        raise InputError(f"must be the label of one body; {len(found)} bodies have the label {body!r}. "
                         f"Labels: {', '.join(labels)}.", field="body")
    return found[0]
