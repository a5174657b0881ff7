"""A box of ATI's: records over UDP, settings over HTTP."""

from __future__ import annotations

import contextlib
import errno
import socket
import threading
import time
from collections.abc import Iterable, Sequence
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any

from haptics.devices.contracts import Bench, DeviceError, ForceSensor, SampleStatus
from haptics.devices.settings import read_settings
from haptics.devices.virtual.faults import Faults, FaultyLine
from haptics.emulators.emulator import Emulator
from haptics.protocols import rdt
from haptics.protocols.rdt import Record, Settings

#: The status words of an Axia: gage out of range, other error.
_SATURATED, _FAULTY = 0x88000000, 0x80000020
_LARGEST = 2**31 - 1


class RdtEmulator(Emulator):
    """Answers as a box does; one client at a time, the last that asked.

    Channels that the sensor lacks read zero; its bias is taken here, of the counts, as a box does.

    Args:
        sensor: whose samples it sends; it is started and stopped with the emulator.
        host: address to listen on. port, http_port: 0: whichever is free.
        settings: what its page says; None: a million counts in a newton and a newton metre, at the sensor's rate.
        faults: on the line.
    """

    name = "rdt"

    def __init__(self, sensor: ForceSensor, host: str = "127.0.0.1", port: int = 0, http_port: int = 0,
                 settings: Settings | None = None, faults: Faults | None = None):
        self._sensor, self._faults = sensor, faults or Faults()
        self._host, self._ports = host, (port, http_port)
        self._settings = settings
        self._ending = threading.Event()
        self._threads: list[threading.Thread] = []
        self.sent = self.requests = 0

    @property
    def address(self) -> str:
        return f"rdt://{self._host}:{self._ports[0]},http_port={self._ports[1]}"

    def start(self) -> None:
        if self._threads:
            return
        self._sensor.start()
        settings = self._settings or Settings(1e6, 1e6, rate=self._sensor.rate, product="tissue_sim emulator",
                                              calibration="FT00000")
        self._force, self._torque = settings.newtons, settings.newton_metres
        try:
            self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._socket.bind((self._host, self._ports[0]))
            self._pages = HTTPServer((self._host, self._ports[1]), _page_handler(rdt.write_settings_page(settings)))
        except OSError as error:
            self._socket.close()
            self._sensor.stop()
            raise DeviceError(_why_not(self._host, self._ports, error)) from None
        self._ports = self._socket.getsockname()[1], self._pages.server_address[1]
        self._socket.settimeout(0.0)
        self._ending.clear()
        self._threads = [threading.Thread(target=self._serve, name="RDT emulator", daemon=True),
                         threading.Thread(target=self._pages.serve_forever, args=(0.05,), name="RDT page", daemon=True)]
        for thread in self._threads:
            thread.start()

    def _serve(self) -> None:
        began = time.monotonic()
        line = FaultyLine(self._faults, began)
        client, size, left, number = None, 1, 0, 0
        bias = [0] * 6
        held: list[Record] = []
        while not self._ending.wait(0.5e-3):
            samples = self._sensor.read()
            counts = [self._counts(sample.values) for sample in samples]
            for request, sender in self._asked(line):
                if request.command in (rdt.REAL_TIME, rdt.BUFFERED):
                    client, number, left = sender, 0, request.count or -1
                    size = rdt.MOST_RECORDS if request.command == rdt.BUFFERED else 1
                    held.clear()
                elif request.command == rdt.STOP:
                    client = None
                elif request.command == rdt.BIAS and counts:
                    bias = list(counts[-1])
            if client is None:
                continue
            now = time.monotonic()
            for sample, each in zip(samples, counts, strict=True):
                if left == 0:
                    break
                number, left = number + 1, left - 1
                held.append(Record(number & 0xFFFFFFFF, sample.sequence & 0xFFFFFFFF, _status(sample.status),
                                   _wrench(count - zero for count, zero in zip(each, bias, strict=True))))
                if len(held) == size or left == 0:
                    line.put(rdt.pack_records(held), now)
                    held = []
            for datagram in line.take(now):
                # A client that has gone, or a full line, is no concern of the box.
                with contextlib.suppress(OSError):
                    self._socket.sendto(datagram, client)
                    self.sent += 1

    def _asked(self, line: FaultyLine) -> list[tuple[rdt.Request, Any]]:
        asked: list[tuple[rdt.Request, Any]] = []
        while True:
            try:
                data, sender = self._socket.recvfrom(1024)
            except OSError:
                return asked
            request = rdt.unpack_request(data)
            if request is not None and not line.is_silent(time.monotonic()):
                self.requests += 1
                asked.append((request, sender))

    def _counts(self, values: Sequence[float]) -> list[int]:
        by_name = dict(zip(self._sensor.channels, values, strict=True))
        return [round(by_name.get(name, 0.0) / (self._force if name[0] == "F" else self._torque))
                for name in rdt.CHANNELS]

    def stop(self) -> None:
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
        return {"emulator": "ATI RDT", "address": self.address, "sensor": self._sensor.describe(),
                "requests": self.requests, "datagrams": self.sent}


def _page_handler(page: bytes) -> type[BaseHTTPRequestHandler]:
    """Of the settings page, and nothing else."""

    class Pages(BaseHTTPRequestHandler):
        timeout = 5.0

        def do_GET(self) -> None:
            known = self.path.partition("?")[0] == rdt.SETTINGS_PATH
            self.send_response(200 if known else 404)
            self.send_header("Content-Type", "application/xml")
            self.send_header("Content-Length", str(len(page) if known else 0))
            self.end_headers()
            if known:
                self.wfile.write(page)

        def log_message(self, format: str, *args: Any) -> None:
            return

    return Pages


def _wrench(counts: Iterable[int]) -> rdt.Wrench:
    """As far as 32 bits reach."""
    x, y, z, u, v, w = (min(max(count, -_LARGEST), _LARGEST) for count in counts)
    return x, y, z, u, v, w


def _status(status: int) -> int:
    """The word of a sample with these bits of `SampleStatus`."""
    return (_SATURATED if status & SampleStatus.SATURATED else 0) | (_FAULTY if status & SampleStatus.FAULT else 0)


def _why_not(host: str, ports: tuple[int, int], error: OSError) -> str:
    if error.errno == errno.EADDRINUSE:
        return f"port {ports[0]} or {ports[1]} of {host} is in use; stop the other program, or give port=0,http_port=0"
    if error.errno in (errno.EACCES, errno.EPERM):
        return f"no permission to listen on port {ports[1]} of {host}; give a port above 1023, or 0 for any"
    return f"{host} cannot be listened on ({error.strerror or error}); give an address of this computer"


def emulate_rdt(bench: Bench, text: str, faults: Faults) -> RdtEmulator:
    """``rdt:port=49152,http_port=8080``; 0, or left out: whichever is free."""
    given = read_settings(text, port=0, http_port=0)
    return RdtEmulator(bench.sensor, port=int(given["port"]), http_port=int(given["http_port"]), faults=faults)
