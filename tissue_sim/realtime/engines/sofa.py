"""SOFA: the tissue's force on a rigid instrument, by a Python controller (SofaPython3).

The controller uses four parts of the interface of SOFA: `Sofa.Core.Controller`, ``position`` and ``velocity`` of a
``MechanicalObject`` of the template Rigid3d, ``forces`` of a ``ConstantForceField``, and ``time`` of the root node. It
is tested against a model of these parts, not in SOFA.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from tissue_sim.errors import InputError, MissingBackendError
from tissue_sim.pose import Pose
from tissue_sim.realtime.tool_coupling import CouplingLimits, RigidBodyState, ToolCoupling
from tissue_sim.tool_force import Tissue


def make_sofa_controller(root: Any, instrument: Any, force_field: Any, *, tissue: Tissue, mass: float | None,
                         scene: Pose | None = None, tip: Pose | None = None, inertia: Any = None,
                         limits: CouplingLimits | None = None, real_time: bool = False, sofa: Any = None) -> Any:
    """Make a `Sofa.Core.Controller` that applies the force of a tissue to a rigid instrument.

    SOFA's Rigid3d has the position (x, y, z) and the quaternion (x, y, z, w), and the velocity of its origin, then the
    angular velocity, along the axes of the world. Forces of Rigid3d are the force, then the torque about the origin.
    The origin of a Rigid3d is its centre of mass in ``UniformMass``.

    Add the result to the node of the instrument: ``node.addObject(make_sofa_controller(...))``.

    Args:
        root: root node, whose ``time`` is the simulated time; when it returns to zero, the tissue is reset.
        instrument: ``MechanicalObject`` of the template Rigid3d with one particle.
        force_field: ``ConstantForceField`` of the template Rigid3d on this particle, with one force.
        tissue: `Simulator` or other `Tissue`.
        scene: pose in the world of the centre of the undeformed top of the tissue, z axis out of the tissue.
        tip: pose of the tool in the frame of the instrument, z axis from the tip to the handle.
        mass: mass of the instrument, kg; None: its motion is prescribed.
        inertia: moments of inertia about the centre of mass, kg m2, shape (3,) or (3, 3).
        limits: see `CouplingLimits`.
        real_time: whether the simulation keeps up with the wall clock, see `ToolCoupling`.
        sofa: module ``Sofa``; None: it is imported.

    Raises:
        InputError: an instrument with another template, or with several particles.
        MissingBackendError: SofaPython3 is not available.
    """
    sofa = _import_sofa() if sofa is None else sofa
    shape = np.asarray(instrument.position.value).shape
    if shape != (1, 7):
        raise InputError(f"must have the template Rigid3d and one particle, positions of shape (1, 7); got {shape}.",
                         field="instrument")
    coupling = ToolCoupling(tissue, scene=scene, tip=tip, mass=mass, inertia=inertia, limits=limits,
                            real_time=real_time)
    coupling.warm_up()

    class TissueController(sofa.Core.Controller):
        """Controller that computes the wrench at the beginning of each time step of SOFA."""

        def __init__(self, *args: Any, **options: Any):
            sofa.Core.Controller.__init__(self, *args, **options)
            self.coupling = coupling

        def onAnimateBeginEvent(self, event: Any) -> None:
            """Compute the wrench for the present pose and write it to the force field."""
            x, y, z, i, j, k, w = (float(part) for part in np.asarray(instrument.position.value)[0])
            velocity = np.asarray(instrument.velocity.value, float)[0]
            wrench = coupling.compute_wrench(
                RigidBodyState((x, y, z), (w, i, j, k), (x, y, z), velocity[:3].tolist(), velocity[3:].tolist()),
                float(root.time.value))
            with force_field.forces.writeable() as forces:
                forces[0] = wrench.force + wrench.torque

    return TissueController(name="TissueController")


def _import_sofa() -> Any:
    """Import SofaPython3.

    Raises:
        MissingBackendError: it is not available.
    """
    try:
        import Sofa
    except ImportError:
        raise MissingBackendError("SofaPython3 is not available. Run the scene by runSofa of SOFA v24.06 or later, or "
                                  "add SofaPython3 to PYTHONPATH.") from None
    return Sofa
