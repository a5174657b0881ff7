"""Emulator of an ATI box with raw data transfer (RDT): records over UDP, settings page over HTTP."""

from __future__ import annotations

import contextlib
import errno
import socket
import threading
import time
from collections.abc import Iterable, Sequence
from enum import IntEnum
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any

from haptics.devices.contracts import Bench, DeviceError, ForceSensor, SampleStatus
from haptics.devices.settings import parse_number_settings
from haptics.devices.virtual.faults import Faults, FaultyMessageQueue
from haptics.emulators.emulator import Emulator
from haptics.protocols import rdt
from haptics.protocols.rdt import BoxSettings, RdtRecord


class AxiaErrorStatusWord(IntEnum):
    """Complete status words of an Axia: bit 31 (error) with one further bit."""

    #: A gage is out of range.
    SATURATED = 0x88000000
    #: Another error.
    FAULTY = 0x80000020


#: Largest count in 32 bits.
_LARGEST_COUNT = 2**31 - 1


class RdtEmulator(Emulator):
    """Emulate a box that sends the samples of a sensor to one client, the last one that requested them.

    Channels that the sensor lacks read 0. The command "bias" is applied to the counts, as in a box.

    Args:
        sensor: Source of the samples; the emulator starts and stops it.
        host: Address to listen on.
        port: UDP port of the records; 0: any free port.
        http_port: Port of the settings page; 0: any free port.
        settings: Contents of the settings page; None: 1e6 counts per N and N m, at the rate of the sensor.
        faults: Faults of the connection.

    Attributes:
        sent: Number of datagrams sent.
        requests: Number of requests received.
    """

    name = "rdt"

    def __init__(self, sensor: ForceSensor, host: str = "127.0.0.1", port: int = 0, http_port: int = 0,
                 settings: BoxSettings | None = None, faults: Faults | None = None):
        self._sensor, self._faults = sensor, faults or Faults()
        self._host, self._ports = host, (port, http_port)
        self._settings = settings
        self._ending = threading.Event()
        self._threads: list[threading.Thread] = []
        self.sent = self.requests = 0

    @property
    def address(self) -> str:
        """Name for `make_sensor` that connects to this emulator: host, UDP port and HTTP port."""
        return f"rdt://{self._host}:{self._ports[0]},http_port={self._ports[1]}"

    def start(self) -> None:
        """Start the sensor, the stream of datagrams and the settings page; has no effect on a started emulator.

        Raises:
            DeviceError: a port cannot be opened.
        """
        if self._threads:
            return
        self._sensor.start()
        settings = self._settings or BoxSettings(1e6, 1e6, rate=self._sensor.rate, product="tissue_sim emulator",
                                                 calibration="FT00000")
        self._force, self._torque = settings.newtons_per_count, settings.newton_metres_per_count
        try:
            self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._socket.bind((self._host, self._ports[0]))
            handler = _make_page_handler(rdt.encode_settings_page(settings))
            self._pages = HTTPServer((self._host, self._ports[1]), handler)
        except OSError as error:
            self._socket.close()
            self._sensor.stop()
            raise DeviceError(_describe_listen_failure(self._host, self._ports, error)) from None
        self._ports = self._socket.getsockname()[1], self._pages.server_address[1]
        self._socket.settimeout(0.0)
        self._ending.clear()
        self._threads = [threading.Thread(target=self._answer_requests_and_stream_records, name="RDT emulator",
                                          daemon=True),
                         threading.Thread(target=self._pages.serve_forever, args=(0.05,), name="RDT page", daemon=True)]
        for thread in self._threads:
            thread.start()

    def _answer_requests_and_stream_records(self) -> None:
        """Execute requests, and send records while a client requests them, until `stop`; the body of the thread."""
        began = time.monotonic()
        line = FaultyMessageQueue(self._faults, began)
        client, size, remaining, number = None, 1, 0, 0
        bias = [0] * 6
        pending: list[RdtRecord] = []
        while not self._ending.wait(0.5e-3):
            samples = self._sensor.read()
            counts = [self._convert_sample_to_counts(sample.values) for sample in samples]
            for request, sender in self._receive_waiting_requests_and_senders(line):
                if request.command in (rdt.RdtCommand.REAL_TIME, rdt.RdtCommand.BUFFERED):
                    client, number, remaining = sender, 0, request.count or -1
                    size = rdt.DATAGRAM.max_records if request.command == rdt.RdtCommand.BUFFERED else 1
                    pending.clear()
                elif request.command == rdt.RdtCommand.STOP:
                    client = None
                elif request.command == rdt.RdtCommand.BIAS and counts:
                    bias = list(counts[-1])
            if client is None:
                continue
            now = time.monotonic()
            for sample, each in zip(samples, counts, strict=True):
                if remaining == 0:
                    break
                number, remaining = number + 1, remaining - 1
                pending.append(RdtRecord(number & 0xFFFFFFFF, sample.sequence & 0xFFFFFFFF,
                                         _convert_to_axia_status_word(sample.status),
                                         _clip_counts_to_32_bits(count - zero for count,
                                                                 zero in zip(each, bias, strict=True))))
                if len(pending) == size or remaining == 0:
                    line.put_message(rdt.pack_records(pending), now)
                    pending = []
            for datagram in line.take_due_messages(now):
                # Like a box, the emulator ignores a client that has closed its port, and a full send buffer.
                with contextlib.suppress(OSError):
                    self._socket.sendto(datagram, client)
                    self.sent += 1

    def _receive_waiting_requests_and_senders(self, line: FaultyMessageQueue) -> list[tuple[rdt.RdtRequest, Any]]:
        """Return the requests received so far without waiting, each with its sender's address; ignores other data."""
        requests: list[tuple[rdt.RdtRequest, Any]] = []
        while True:
            try:
                data, sender = self._socket.recvfrom(1024)
            except OSError:
                return requests
            request = rdt.unpack_request_or_none(data)
            if request is not None and not line.is_disconnected(time.monotonic()):
                self.requests += 1
                requests.append((request, sender))

    def _convert_sample_to_counts(self, values: Sequence[float]) -> list[int]:
        """Return the six counts of a sample whose values are in N and N m; channels that the sensor lacks are 0."""
        by_name = dict(zip(self._sensor.channels, values, strict=True))
        return [round(by_name.get(name, 0.0) / (self._force if name[0] == "F" else self._torque))
                for name in rdt.CHANNELS]

    def stop(self) -> None:
        """End the stream and the settings page, and stop the sensor."""
        if not self._threads:
            return
        self._ending.set()
        self._pages.shutdown()
        for thread in self._threads:
            thread.join()
        self._threads = []
        self._socket.close()
        self._pages.server_close()
        self._sensor.stop()

    def describe(self) -> dict[str, Any]:
        """Return address, description of the sensor and counts of requests and datagrams."""
        return {"emulator": "ATI RDT", "address": self.address, "sensor": self._sensor.describe(),
                "requests": self.requests, "datagrams": self.sent}


def _make_page_handler(page: bytes) -> type[BaseHTTPRequestHandler]:
    """Return the class of HTTP handlers that serve `page` at the path of the settings page, and nothing else."""

    class SettingsPageHandler(BaseHTTPRequestHandler):
        """Handler of one HTTP request for the settings page."""
        timeout = 5.0

        def do_GET(self) -> None:
            """Send the settings page, or the status 404 for another path."""
            exists = self.path.partition("?")[0] == rdt.SETTINGS_PATH
            self.send_response(200 if exists else 404)
            self.send_header("Content-Type", "application/xml")
            self.send_header("Content-Length", str(len(page) if exists else 0))
            self.end_headers()
            if exists:
                self.wfile.write(page)

        def log_message(self, format: str, *args: Any) -> None:
            """Print nothing."""
            return

    return SettingsPageHandler


def _clip_counts_to_32_bits(counts: Iterable[int]) -> rdt.Wrench:
    """Return six counts, clipped to the range of signed 32-bit numbers."""
    x, y, z, u, v, w = (min(max(count, -_LARGEST_COUNT), _LARGEST_COUNT) for count in counts)
    return x, y, z, u, v, w


def _convert_to_axia_status_word(status: int) -> int:
    """Return the status word of an Axia for the bits of a `SampleStatus`; 0 without saturation and fault."""
    return ((AxiaErrorStatusWord.SATURATED if status & SampleStatus.SATURATED else 0)
            | (AxiaErrorStatusWord.FAULTY if status & SampleStatus.FAULT else 0))


def _describe_listen_failure(host: str, ports: tuple[int, int], error: OSError) -> str:
    """Return the message, cause and remedy, for ports on which the emulator cannot listen."""
    if error.errno == errno.EADDRINUSE:
        return f"port {ports[0]} or {ports[1]} of {host} is in use; stop the other program, or give port=0,http_port=0"
    if error.errno in (errno.EACCES, errno.EPERM):
        return f"no permission to listen on port {ports[1]} of {host}; give a port above 1023, or 0 for any"
    return f"{host} cannot be opened for listening ({error.strerror or error}); give an address of this computer"


def make_rdt_emulator(bench: Bench, text: str, faults: Faults) -> RdtEmulator:
    """Make an emulator from settings ``port=49152,http_port=8080``; 0, the default, selects any free port."""
    given = parse_number_settings(text, port=0, http_port=0)
    return RdtEmulator(bench.sensor, port=int(given["port"]), http_port=int(given["http_port"]), faults=faults)
