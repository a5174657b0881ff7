"""Devices of a recording: real sensor and stage by name, or a virtual rig with the specimen of the test."""

from __future__ import annotations

from dataclasses import replace

from calibration.campaign.campaign import Test
from haptics.devices.back_ends import make_sensor, make_stage
from haptics.devices.contracts import Bench, StageLimits
from haptics.devices.virtual.faults import parse_faults
from haptics.devices.virtual.rig import (
    ElasticSpecimenForceModel,
    HistoryDependentForceModel,
    SpecimenForceModel,
    VirtualRig,
)
from scenes.commands.record.protocol_file import ProtocolFile
from scenes.commands.shared.experiment_flags import load_material_or_study_silicone
from tissue_sim import Model, Rig, load_rig
from tissue_sim.errors import InputError

#: Device name of the virtual rig.
VIRTUAL = "virtual:"
#: Back-ends that are not coupled to real hardware.
_SIMULATED_BACK_ENDS = ("virtual", "replay")


def uses_virtual_rig(protocol: ProtocolFile) -> bool:
    """Return whether the run uses the virtual rig.

    Raises:
        InputError: a virtual sensor with a real stage or vice versa (the sensor would not measure the specimen that the
            stage presses), a replayed sensor, or settings of the virtual rig outside ``[virtual]``.
    """
    sensor, stage = (name.partition(":")[0] for name in (protocol.devices.sensor, protocol.devices.stage))
    if (sensor in _SIMULATED_BACK_ENDS) != (stage in _SIMULATED_BACK_ENDS) or (sensor == "replay"):
        raise InputError(f"the sensor {sensor!r} cannot measure the specimen that the stage {stage!r} presses. Make "
                         "both virtual, or give the sensor at the tool", field="devices", file=protocol.path)
    for name, field in ((protocol.devices.sensor, "devices.sensor"), (protocol.devices.stage, "devices.stage")):
        if sensor == "virtual" and name != VIRTUAL:
            raise InputError(f"must be {VIRTUAL!r}; got {name!r}. Settings of the virtual rig belong under [virtual]",
                             field=field, file=protocol.path)
    return sensor == "virtual"


def make_unstarted_bench(protocol: ProtocolFile, test: Test) -> Bench:
    """Return the devices for a test, not started.

    Raises:
        InputError: an unknown device, or a specimen that cannot be simulated.
    """
    if not uses_virtual_rig(protocol):
        return Bench(make_sensor(protocol.devices.sensor), make_stage(protocol.devices.stage))
    return make_virtual_rig(protocol, test).bench


def make_virtual_rig(protocol: ProtocolFile, test: Test) -> VirtualRig:
    """Return the virtual rig of a test; its specimen has the material of ``[virtual]``.

    Raises:
        InputError: the test is not simulated with a tool, or an invalid material or rig file.
    """
    table, limits, folder = protocol.virtual, protocol.limits, protocol.path.parent
    rig = Rig() if table.rig is None else load_rig(folder / table.rig)
    plan = protocol.plans[test.name]
    compliance = 0.0 if table.remembers else rig.compliance
    material = load_material_or_study_silicone(None if table.material is None else folder / table.material)
    if test.experiment is None:
        raise InputError("the kind of test has no tool, so that the virtual rig cannot perform it. Leave the test out",
                         field=test.place, file=protocol.path)
    model = Model(test.experiment, material, replace(Rig(), compliance=compliance))
    specimen: SpecimenForceModel = (HistoryDependentForceModel(model) if table.remembers else
                                    ElasticSpecimenForceModel(model, 1.05 * plan.largest_depth))
    surface = 0.0 if plan.contact == "here" else table.surface_mm * 1e-3
    return VirtualRig(specimen, rig, surface=surface,
                      limits=StageLimits(min(limits.lowest, -0.01), max(limits.highest, 0.01), limits.speed),
                      sign=plan.sign, rate=table.rate_Hz, reach=table.range_N, resolution=table.resolution_N,
                      encoder=table.encoder, faults=parse_faults(table.faults))
