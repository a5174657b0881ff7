"""RDT with programs that are not ours: pynetft against our emulator, our client against pynetft's fake sensor.

pynetft 2.1.3 (PyPI); its fake sensor comes with its source release only.
"""

import importlib.util
import subprocess
import sys
import tarfile
from importlib.metadata import version

import pynetft
import pytest
from waiting import wait_until

from haptics.devices.contracts import SampleStatus
from haptics.devices.rdt import RdtSensor
from haptics.devices.virtual.faults import Faults
from haptics.devices.virtual.force_sensor import VirtualForceSensor
from haptics.emulators.rdt import RdtEmulator
from haptics.protocols import rdt
from haptics.protocols.rdt import BoxSettings

PATIENCE = 60.0
LOAD = (0.1, -0.2, 3.0, 0.01, 0.02, -0.03)


def load(time):
    return LOAD


def emulator(settings=None, faults=None, rate=500.0):
    return RdtEmulator(VirtualForceSensor(load, rdt.CHANNELS, rate, 1e-4), settings=settings, faults=faults)


def foreign_client(emulated, **options):
    _, _, ports = emulated.address.rpartition(":")
    port, _, http_port = ports.partition(",http_port=")
    return pynetft.Client(pynetft.Config(sensor_host="127.0.0.1", rdt_port=int(port), http_port=int(http_port),
                                         receive_timeout=5.0, configuration_timeout=10.0, **options), queue_size=4096)


def test_a_foreign_client_reads_our_emulator():
    with emulator(BoxSettings(1e6, 1e6, "N", "N-m", 500.0)) as emulated, foreign_client(emulated) as client:
        samples = [sample for _, sample in zip(range(200), client.samples(timeout=PATIENCE), strict=False)]
        health = client.health()
    for sample in samples:
        assert (*sample.force, *sample.torque) == pytest.approx(LOAD, abs=1e-4)
        assert sample.status == 0
    assert [sample.rdt_sequence for sample in samples] == list(range(samples[0].rdt_sequence,
                                                                     samples[0].rdt_sequence + 200))
    assert health.lost_count == health.malformed_count == health.out_of_order_count == 0


def test_a_foreign_client_takes_our_units():
    with emulator(BoxSettings(1000.0, 50.0, "lbf", "lbf-in", 500.0)) as emulated, foreign_client(emulated) as client:
        sample = next(client.samples(timeout=PATIENCE))
    assert sample.force_unit == pynetft.ForceUnit.POUND_FORCE
    assert sample.torque_unit == pynetft.TorqueUnit.POUND_FORCE_INCH
    assert sample.force[2] == pytest.approx(LOAD[2] / 4.4482216152605, abs=1e-3)


@pytest.mark.slow
def test_a_foreign_client_and_ours_count_the_same_losses():
    """Each on an emulator with the same faults, of the same seed."""
    faults = Faults(loss=0.1, duplicate=0.05, seed=5)
    with emulator(faults=faults) as emulated, foreign_client(emulated) as client:
        wait_until(lambda: client.health().received_count >= 400, "records")
        theirs = client.health()
    assert theirs.lost_count > 10 and theirs.duplicate_count > 5
    with emulator(faults=faults) as emulated:
        host, _, http_port = emulated.address.removeprefix("rdt://").partition(",http_port=")
        ours = RdtSensor("127.0.0.1", int(host.rpartition(":")[2]), int(http_port))
        ours.start()
        wait_until(lambda: ours.describe()["records"] >= 400, "records")
        tally = ours.describe()
        ours.stop()
    share = theirs.lost_count / (theirs.received_count + theirs.lost_count)
    assert tally["lost"] / (tally["records"] + tally["lost"]) == pytest.approx(share, abs=0.05)


@pytest.fixture(scope="module")
def fake_sensor_module(tmp_path_factory):
    """pynetft's fake sensor, from its source release."""
    folder = tmp_path_factory.mktemp("pynetft")
    got = subprocess.run([sys.executable, "-m", "pip", "download", "-q", "--no-deps", "--no-binary", "pynetft",
                          f"pynetft=={version('pynetft')}", "-d", folder], capture_output=True, text=True, timeout=300,
                         check=False)
    archives = list(folder.glob("*.tar.gz"))
    if got.returncode or not archives:
        pytest.skip("pynetft's fake sensor is in its source release only, which pip could not download: "
                    + (got.stderr.strip().splitlines() or ["no archive came"])[-1])
    with tarfile.open(archives[0]) as archive:
        member = next(name for name in archive.getnames() if name.endswith("tests/integration/fake_sensor.py"))
        # Python 3.11.2 cannot be told to extract safely yet.
        source = folder / "fake_sensor.py"
        source.write_bytes(archive.extractfile(member).read())
    spec = importlib.util.spec_from_file_location("pynetft_fake_sensor", source)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def fake(fake_sensor_module):
    sensor = fake_sensor_module.FakeSensor()
    yield sensor
    sensor.close()


@pytest.mark.slow
def test_our_client_reads_a_foreign_server(fake):
    fake.configure(product_name="ATI Net F/T", counts_per_force=1000, counts_per_torque=100, force_unit="lbf",
                   torque_unit="lbf-in")
    fake.queue_record((10, -20, 30, 4, -5, 6))
    fake.queue_malformed()
    fake.queue_record((11, 0, 0, 0, 0, 0), rdt_sequence=2)
    fake.queue_record((12, 0, 0, 0, 0, 0), rdt_sequence=5, status=0x80000001)
    fake.queue_record((12, 0, 0, 0, 0, 0), rdt_sequence=5)
    client = RdtSensor("127.0.0.1", fake.rdt_port, fake.http_port)
    client.start()
    wait_until(lambda: client.describe()["records"] + client.describe()["twice"] >= 4, "records")
    samples, tally = client.read(), client.describe()
    client.stop()
    assert fake.wait_for_command(rdt.RdtCommand.STOP, timeout=PATIENCE)
    assert [sample.counts for sample in samples[:1]] == [(10, -20, 30, 4, -5, 6)]
    assert samples[0].values[1] == pytest.approx(-20 * 4.4482216152605 / 1000)
    assert samples[0].values[3] == pytest.approx(4 * 0.1129848290276167 / 100)
    assert [sample.sequence for sample in samples][:3] == [0, 1, 4]
    assert samples[2].status == SampleStatus.GAP | SampleStatus.FAULT
    assert (tally["lost"], tally["garbled"]) == (2, 1)
