"""What stands on the bench: devices by name, or a virtual rig with the specimen of the test."""

from __future__ import annotations

from dataclasses import replace

from calibration.campaign.campaign import Test
from haptics.devices.back_ends import open_sensor, open_stage
from haptics.devices.contracts import Bench, StageLimits
from haptics.devices.virtual.faults import read_faults
from haptics.devices.virtual.rig import ElasticSpecimen, HistoryDependentSpecimen, Specimen, VirtualRig
from scenes.commands.record.protocol_file import ProtocolFile
from scenes.commands.shared.tissue_flags import read_material
from tissue_sim import Model, Rig, load_rig
from tissue_sim.errors import InputError

VIRTUAL = "virtual:"
#: Back-ends that know nothing of what is really pressed.
_FEELS_NOTHING = ("virtual", "replay")


def is_virtual(protocol: ProtocolFile) -> bool:
    """Whether nothing that moves is really there.

    Raises:
        InputError: a virtual sensor on a real stage, or the other way round: it would not feel what is pressed.
    """
    sensor, stage = (name.partition(":")[0] for name in (protocol.devices.sensor, protocol.devices.stage))
    if (sensor in _FEELS_NOTHING) != (stage in _FEELS_NOTHING) or (sensor == "replay"):
        raise InputError(f"a sensor {sensor!r} does not feel what a stage {stage!r} presses; make both virtual, or "
                         "give the sensor that is on the tool", field="devices", file=protocol.path)
    for name, field in ((protocol.devices.sensor, "devices.sensor"), (protocol.devices.stage, "devices.stage")):
        if sensor == "virtual" and name != VIRTUAL:
            raise InputError(f"{name!r}: what a virtual bench is like stands under [virtual]; give {VIRTUAL!r}",
                             field=field, file=protocol.path)
    return sensor == "virtual"


def open_bench(protocol: ProtocolFile, test: Test) -> Bench:
    """The devices for a test; none is started.

    Raises:
        InputError: no such device, or a specimen that cannot be simulated.
    """
    if not is_virtual(protocol):
        return Bench(open_sensor(protocol.devices.sensor), open_stage(protocol.devices.stage))
    return virtual_rig(protocol, test).bench


def virtual_rig(protocol: ProtocolFile, test: Test) -> VirtualRig:
    """The virtual rig of a test: its specimen of the material of ``[virtual]``."""
    table, limits, folder = protocol.virtual, protocol.limits, protocol.path.parent
    rig = Rig() if table.rig is None else load_rig(folder / table.rig)
    plan = protocol.plans[test.name]
    compliance = 0.0 if table.remembers else rig.compliance
    material = read_material(None if table.material is None else folder / table.material)
    if test.experiment is None:
        raise InputError("there is nothing to press", field=test.place, file=protocol.path)
    model = Model(test.experiment, material, replace(Rig(), compliance=compliance))
    specimen: Specimen = (HistoryDependentSpecimen(model) if table.remembers else
                          ElasticSpecimen(model, 1.05 * plan.depth))
    surface = 0.0 if plan.contact == "here" else table.surface_mm * 1e-3
    return VirtualRig(specimen, rig, surface=surface,
                      limits=StageLimits(min(limits.lowest, -0.01), max(limits.highest, 0.01), limits.speed),
                      sign=plan.sign, rate=table.rate_Hz, reach=table.range_N, resolution=table.resolution_N,
                      encoder=table.encoder, faults=read_faults(table.faults))
