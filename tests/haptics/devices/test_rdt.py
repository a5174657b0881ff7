"""ATI boxes on the network, against the emulator: the contract, lost and late records, and other devices."""

import math
import socket
import threading
import time
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, HTTPServer
from itertools import pairwise

import pytest
from device_contracts import ForceSensorContract
from hypothesis import given
from hypothesis import strategies as st
from waiting import wait_until

from haptics.devices import rdt as rdt_device
from haptics.devices.back_ends import make_sensor
from haptics.devices.contracts import DeviceError, SampleStatus
from haptics.devices.rdt import RdtSensor, RecordSequenceTracker
from haptics.devices.virtual.faults import Faults
from haptics.devices.virtual.force_sensor import VirtualForceSensor
from haptics.emulators.rdt import RdtEmulator
from haptics.protocols import rdt
from haptics.protocols.rdt import BoxSettings, RdtRecord
from tissue_sim.errors import InputError

#: Longest wait of a test, s; reached only if the test hangs.
LOAD = (0.1, -0.2, 3.0, 0.01, 0.02, -0.03)


def load(time):
    return LOAD


@pytest.fixture
def emulated():
    """Function that starts an emulator of a sensor under `LOAD`."""
    running = []

    def emulated(faults=None, settings=None, rate=500.0, reach=50.0, saturates=False):
        sensor = VirtualForceSensor((lambda at: (99.0,) * 6) if saturates else load, rdt.CHANNELS, rate, 1e-4, reach)
        emulator = RdtEmulator(sensor, faults=faults, settings=settings)
        emulator.start()
        running.append(emulator)
        return emulator

    yield emulated
    for emulator in running:
        emulator.stop()


@pytest.fixture
def opened(emulated):
    """Function that starts a client of such an emulator."""
    clients = []

    def opened(**options):
        client = make_sensor(emulated(**options).address)
        clients.append(client)
        client.start()
        return client

    yield opened
    for client in clients:
        client.stop()


def received(client, count):
    wait_until(lambda: client.describe()["records"] >= count, f"{count} records")
    return client.read()


class TestRdt(ForceSensorContract):
    load = LOAD
    tolerance = 1.1e-4

    @pytest.fixture
    def sensor(self, emulated):
        self.client = make_sensor(emulated(settings=BoxSettings(1e4, 1e6, rate=500.0)).address)
        yield self.client
        self.client.stop()

    def pass_time(self, seconds):
        due = self.client.describe()["records"] + math.ceil(seconds * self.client.rate)
        wait_until(lambda: self.client.describe()["records"] >= due, "records")

    def now(self):
        return time.monotonic()


def test_the_settings_page_gives_the_scale(opened):
    client = opened(settings=BoxSettings(1000.0, 50.0, "lbf", "lbf-in", 500.0, "Net F/T", "FT123"))
    sample = received(client, 1)[0]
    assert sample.counts[2] == round(1000.0 * LOAD[2] / 4.4482216152605)
    assert sample.values[2] == pytest.approx(LOAD[2], abs=0.6 * 4.45e-3)
    about = client.describe()
    assert (about["unit_of_force"], about["calibration"], client.rate) == ("lbf", "FT123", 500.0)
    assert about["resolution_Nm"] == pytest.approx(0.1129848290276167 / 50.0)


def test_a_saturated_sample_is_marked_and_its_tare_refused(opened):
    client = opened(saturates=True)
    assert received(client, 1)[0].status == SampleStatus.SATURATED | SampleStatus.FAULT
    with pytest.raises(DeviceError, match=r"a gage is out of range .*take the load off"):
        client.tare()


def test_lost_duplicated_and_late_records_are_counted(opened):
    client = opened(faults=Faults(loss=0.1, duplicate=0.1, reorder=0.1, seed=3), rate=2000.0)
    samples = received(client, 1500)
    tally = client.describe()
    assert tally["lost"] > 100 and tally["twice"] > 100 and tally["late"] > 100
    numbers = [sample.sequence for sample in samples]
    assert numbers == sorted(set(numbers))
    for before, after in pairwise(samples):
        assert bool(after.status & SampleStatus.GAP) == (after.sequence != before.sequence + 1)
    # Every number was received, lost or late.
    assert numbers[-1] - numbers[0] + 1 <= len(numbers) + tally["lost"] + tally["late"]


def test_datagrams_of_another_sender_are_ignored(opened):
    """Records have no checksum of their own, so datagrams of other senders must be discarded by the socket."""
    client = opened()
    other = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    other.sendto(b"x" * 36, client._stream._socket.getsockname())  # from another address than the box
    other.close()
    before = client.describe()["records"]
    received(client, before + 50)
    assert client.describe()["garbled"] == 0 and client.describe()["twice"] == 0


def test_a_silent_box_gives_no_samples_and_refuses_the_tare(opened, monkeypatch):
    monkeypatch.setattr(rdt_device, "STREAM", replace(rdt_device.STREAM, patience=0.2))
    client = opened(faults=Faults(disconnect_after=0.3))
    with pytest.raises(DeviceError, match="has stopped sending records"):
        wait_until(lambda: client.tare(), "silence")
    client.read()
    assert client.read() == ()


def test_a_second_client_takes_over_the_stream(emulated):
    emulator = emulated()
    first, second = make_sensor(emulator.address), make_sensor(emulator.address)
    first.start()
    received(first, 10)
    second.start()
    received(second, 50)
    first.stop()
    second.stop()
    wait_until(lambda: emulator.describe()["requests"] >= 3, "the requests of both starts and of the stop")


class Page:
    """A web server that is no ATI box."""

    def __init__(self, code, body):
        class Pages(BaseHTTPRequestHandler):
            def do_GET(self):
                self.send_response(code)
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, format, *args):
                return

        self.server = HTTPServer(("127.0.0.1", 0), Pages)
        self.port = self.server.server_address[1]
        threading.Thread(target=self.server.serve_forever, args=(0.01,), daemon=True).start()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.server.shutdown()
        self.server.server_close()


@pytest.mark.parametrize(("code", "body", "said"), [
    (404, b"", "answers with HTTP status 404, so it is no ATI box"),
    (200, b"<html>printer", "must be the XML page of an ATI box"),
    (200, b"<n><cfgcpf>1</cfgcpf><cfgcpt>1</cfgcpt><scfgfu>stone</scfgfu></n>",
     "the unit of force must be a known unit; got 'stone' from the box"),
    (200, rdt.encode_settings_page(BoxSettings(1.0, 1.0)), "sends no records by UDP; switch RDT on"),
])
def test_another_device_at_the_address_raises(code, body, said, monkeypatch):
    monkeypatch.setattr(rdt_device, "STREAM", replace(rdt_device.STREAM, first_record=0.1))
    with Page(code, body) as page, pytest.raises(DeviceError) as caught:
        RdtSensor("127.0.0.1", 9, page.port).start()
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_an_address_without_a_box_raises():
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        with pytest.raises(DeviceError, match=r"no ATI box answers at http://127\.0\.0\.1:.*check its power"):
            RdtSensor("127.0.0.1", 9, unused.getsockname()[1]).start()


def test_a_port_in_use_raises_with_the_remedy(emulated):
    taken = int(emulated().address.rpartition("=")[2])
    sensor = VirtualForceSensor(load, rdt.CHANNELS)
    with pytest.raises(DeviceError, match=r"in use; stop the other program"):
        RdtEmulator(sensor, http_port=taken).start()


@pytest.mark.parametrize(("text", "field"), [
    ("rdt://", "host"), ("rdt://box:0", "port"), ("rdt://box:x", "port"), ("rdt://box,http_port=99999", "http_port"),
    ("rdt://box,rate=3", "settings")])
def test_invalid_addresses_are_refused(text, field):
    with pytest.raises(InputError) as caught:
        make_sensor(text)
    assert caught.value.field.endswith(field)


@pytest.mark.parametrize(("text", "address"), [
    ("rdt://192.168.1.1", "192.168.1.1:49152"), ("rdt:192.168.1.1:50000", "192.168.1.1:50000"),
    ("rdt://[::1]:50000,http_port=8080", "[::1]:50000"), ("rdt://box.lab/", "box.lab:49152"),
])
def test_addresses_are_read(text, address):
    assert make_sensor(text).describe()["address"] == address


def numbered(*pairs, status=0):
    return [RdtRecord(sequence, sample, status, (0,) * 6) for sequence, sample in pairs]


def test_a_restart_of_the_box_is_detected():
    """The sequence restarts at 1; the sample number continues, or restarts after a loss of power."""
    counter = RecordSequenceTracker()
    counter.select_new_records(numbered((1, 70), (2, 80), (3, 90)), 0.0)
    (_, number, status), *rest = counter.select_new_records(numbered((1, 170), (2, 180)), 0.01)
    assert (number, status, counter.restarts) == (3, SampleStatus.GAP, 1)
    assert [number for _, number, _ in rest] == [4]
    (_, number, status), = counter.select_new_records(numbered((1, 5)), 10.0)
    assert (number, status, counter.restarts) == (5, SampleStatus.GAP, 2)


def test_a_delayed_record_is_late_and_no_restart():
    counter = RecordSequenceTracker()
    counter.select_new_records(numbered((1, 1), (2, 2), (4, 4)), 0.0)
    assert counter.select_new_records(numbered((3, 3)), 0.001) == [] and (counter.late, counter.lost) == (1, 0)
    assert counter.select_new_records(numbered((3, 3), (4, 4)), 0.001) == []
    assert counter.twice == 2 and not counter.restarts


def test_sequence_numbers_continue_beyond_32_bits():
    counter = RecordSequenceTracker()
    counter.select_new_records(numbered((2**32 - 1, 7)), 0.0)
    (_, number, status), = counter.select_new_records(numbered((0, 8)), 0.001)
    assert (number, status, counter.lost, counter.restarts) == (1, SampleStatus.GOOD, 0, 0)


@given(st.lists(st.integers(0, 400), min_size=1, max_size=200, unique=True))
def test_sequence_numbers_are_unique_and_in_order(order):
    counter, given_out = RecordSequenceTracker(), []
    for sequence in order:
        given_out += counter.select_new_records(numbered((sequence + 1, sequence + 1)), 0.0)
    numbers = [number for _, number, _ in given_out]
    assert numbers == sorted(set(numbers)) and counter.accepted == len(given_out)
    assert counter.accepted + counter.late + counter.twice == len(order)


def test_a_passed_threshold_is_no_fault():
    (_, _, status), = RecordSequenceTracker().select_new_records(numbered((1, 1), status=0x00010000), 0.0)
    assert status == SampleStatus.GOOD
