"""Tables of motions and devices by name, such as ``sine``, ``sine:frequency_hz=2`` or ``virtual:``.

A back-end is a function that makes the device from the text after the colon. A package adds a back-end through an entry
point of the table's group, a program through `Registry.register`. Listing the names imports no back-end, so the command
line can list them in its help quickly.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, TypeVar

from tissue_sim.errors import InputError
from tissue_sim.public_names import make_getattr_for_old_names
from tissue_sim.registry import Registry

if TYPE_CHECKING:
    from haptics.devices.contracts import ForceSensor, HapticDevice, Motion, Stage

__getattr__ = make_getattr_for_old_names(__name__, {"open_motion": "make_motion", "open_sensor": "make_sensor",
                                                    "open_stage": "make_stage", "open_haptic": "make_haptic_device"})

Device = TypeVar("Device")

#: Motions of the tool without a device.
MOTIONS: Registry[Callable[[str], Motion]] = Registry("motion", "tissue_sim.motions", {
    "random": "haptics.devices.motions:make_random_motion",
    "sine": "haptics.devices.motions:make_sine_motion",
    "protocol": "haptics.devices.motions:make_motion_from_protocol_text",
    "hand": "haptics.devices.motions:make_target_following_motion",
})
#: Force sensors.
FORCE_SENSORS: Registry[Callable[[str], ForceSensor]] = Registry("force sensor", "tissue_sim.force_sensors", {
    "virtual": "haptics.devices.virtual.force_sensor:make_constant_load_sensor",
    "replay": "haptics.devices.replay:make_replay_sensor",
    "rdt": "haptics.devices.rdt:make_rdt_sensor",
    "ati-serial": "haptics.devices.ati_serial:make_ati_serial_sensor",
    "ati-daq": "haptics.devices.ati_daq:make_ati_daq_sensor",
})
#: Linear stages.
STAGES: Registry[Callable[[str], Stage]] = Registry("stage", "tissue_sim.stages", {
    "virtual": "haptics.devices.virtual.stage:make_stand_alone_virtual_stage",
    "tic": "haptics.devices.tic:make_tic_stage",
    "grbl": "haptics.devices.grbl:make_grbl_stage",
    "phidget": "haptics.devices.phidget:make_phidget_stage",
})
#: Haptic devices.
HAPTIC_DEVICES: Registry[Callable[[str], HapticDevice]] = Registry("haptic device", "tissue_sim.haptic_devices", {
    "virtual": "haptics.devices.virtual.hand:make_virtual_hand_following_motion",
    "haply": "haptics.devices.haply:make_haply_device",
})


def make_motion(name: str) -> Motion:
    """Return the motion with a name such as ``sine:frequency_hz=2``, not started; see `make_haptic_device`."""
    return _make_device_of_registered_back_end(MOTIONS, name)


def make_sensor(name: str) -> ForceSensor:
    """Return the force sensor with a name such as ``virtual:``, not started; see `make_haptic_device`."""
    return _make_device_of_registered_back_end(FORCE_SENSORS, name)


def make_stage(name: str) -> Stage:
    """Return the stage with a name such as ``virtual:``, not started; see `make_haptic_device`."""
    return _make_device_of_registered_back_end(STAGES, name)


def make_haptic_device(name: str) -> HapticDevice:
    """Return the haptic device with a name such as ``virtual:``, without starting it.

    Args:
        name: Name of the back-end, followed by a colon and its settings if it has any, such as ``virtual:``.

    Raises:
        InputError: No back-end has this name (the message names the nearest), or the settings are invalid.
    """
    return _make_device_of_registered_back_end(HAPTIC_DEVICES, name)


def _make_device_of_registered_back_end(table: Registry[Callable[[str], Device]], name: str) -> Device:
    """Return the device with a name ``BACK_END:SETTINGS`` from a table of back-ends, not started.

    Raises:
        InputError: No back-end has this name, or the settings are invalid (the field is the back-end).
    """
    back_end, _, rest = name.partition(":")
    make = table.find(back_end)
    try:
        return make(rest)
    except InputError as error:
        raise error.with_location(field=back_end) from None
