"""Motions of the tool in a scene: by hand, along a protocol, or as measured."""

from __future__ import annotations

import numpy as np

import tissue_sim as ts
from haptics.devices.motions import ProtocolMotion, TargetFollowingMotion
from scenes.viewer.measurement import find_typical_replicate_and_branches, make_first_cycle_motion_protocol
from scenes.viewer.reach import require_depths_within_scene
from scenes.viewer.scene import Scene
from tissue_sim.errors import InputError

#: Largest speed of a tool that is moved with the mouse, m/s.
HAND_SPEED = 0.1
#: Number of points of each segment of a protocol.
_POINTS = 21


def make_hand_motion(scene: Scene) -> TargetFollowingMotion:
    """Return a motion by hand that starts at the undeformed surface."""
    return TargetFollowingMotion(0.0, HAND_SPEED, approach=scene.experiment.approach)


def make_protocol_motion(scene: Scene, text: str, speed: float, repeat: bool) -> ProtocolMotion:
    """Return the motion of a protocol; arguments and errors as `Session.play_protocol_on_reset_tissue`."""
    protocol = ts.Protocol.parse(text, _POINTS, speed)
    require_depths_within_scene(scene, protocol, "protocol")
    return ProtocolMotion(protocol, repeat, scene.experiment.approach)


def make_replay_motion_and_force_curve(scene: Scene,
                                       speed: float) -> tuple[ProtocolMotion, tuple[np.ndarray, np.ndarray] | None]:
    """Return the measured motion of a scene.

    Args:
        scene: Scene with a measurement.
        speed: Speed relative to the measurement.

    Returns:
        The motion, and the time since its start, s, and force, N, of the recording; None for a recording without time.

    Raises:
        InputError: The scene has no measurement, or the measured motion is deeper than the scene.
    """
    if scene.measurement is None:
        raise InputError("This scene has no measurement. Start the viewer with --measured FILE.")
    measured, (recording,
               _) = make_first_cycle_motion_protocol(scene.measurement), find_typical_replicate_and_branches(
                   scene.measurement)
    require_depths_within_scene(scene, measured, "recording")
    displacement = measured.displacement
    if scene.min_tool_displacement == 0.0:
        # Noise around zero displacement must not lift a tool that is attached to the tissue.
        displacement = np.maximum(displacement, 0.0)
    replayed = None
    if "time" in recording:
        replayed = (recording.time - measured.time[0]) / speed, recording.force
    protocol = ts.Protocol(measured.time / speed, displacement)
    return ProtocolMotion(protocol, approach=scene.experiment.approach), replayed
