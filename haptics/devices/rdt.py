"""A force/torque sensor of ATI's on the network: Net F/T and Ethernet Axia, by raw data transfer over UDP."""

from __future__ import annotations

import contextlib
import math
import socket
import threading
import time
import urllib.error
import urllib.request
from collections import deque
from typing import Any

from haptics.devices.contracts import DeviceError, ForceSample, ForceSensor, SampleStatus
from haptics.protocols import rdt
from haptics.protocols.rdt import Record, Request, Settings
from tissue_sim.errors import InputError

#: What the system may keep of datagrams that wait; its default loses some at 7 kHz on a loaded machine.
_RECEIVE_BUFFER = 4 << 20
#: Samples that wait to be read; older ones are lost.
BUFFER = 1 << 16
#: How long an answer may take, s: of the settings page, and of the first record.
_PATIENCE, _FIRST = 2.0, 1.0
#: A record that is behind the newest by up to so many was overtaken on its way; by more, the box began anew.
_OVERTAKEN = 100
#: A silence after which the box may have begun anew, s.
_PAUSE = 0.25
#: Samples whose mean is the tare.
_TARED = 100


class RdtSensor(ForceSensor):
    """Six axes, as the box streams them. A thread receives them as they come.

    The rate is what the box says on its settings page, and 7000 Hz until then. After `start`, `describe` tells what was
    received, and how much was lost, came twice, late, garbled or after the box had begun anew.

    Args:
        host: name or address of the box.
        port, http_port: of its records and of its settings page.

    Raises:
        InputError: an address or a port that is none.
    """

    channels = rdt.CHANNELS

    def __init__(self, host: str, port: int = rdt.PORT, http_port: int = rdt.HTTP_PORT):
        if not host:
            raise InputError("give the address of the box, as in rdt://192.168.1.1", field="host")
        for number, field in ((port, "port"), (http_port, "http_port")):
            if not 0 < number < 65536:
                raise InputError(f"{number} is no port; give 1 to 65535", field=field)
        self._host, self._port, self._http_port = host, port, http_port
        self.rate = 7000.0
        self._settings: Settings | None = None
        self._stream: _Stream | None = None
        self._zero = (0.0,) * 6

    def start(self) -> None:
        if self._stream is not None:
            return
        settings = self._read_settings()
        try:
            force, torque = settings.newtons, settings.newton_metres
        except InputError as error:
            raise DeviceError(f"the box at {self._host}: {error}") from None
        if settings.rate is not None:
            self.rate = settings.rate
        self._settings, self._scales = settings, (force,) * 3 + (torque,) * 3
        self._zero = (0.0,) * 6
        stream = _Stream(self._host, self._port)
        try:
            stream.begin()
        except DeviceError:
            stream.end()
            raise
        self._stream = stream

    def _read_settings(self) -> Settings:
        address = f"http://{self._bracketed}:{self._http_port}{rdt.SETTINGS_PATH}"
        # Without the proxies of the environment: the box is on a network of its own.
        fetch = urllib.request.build_opener(urllib.request.ProxyHandler({})).open
        try:
            with fetch(address, timeout=_PATIENCE) as answer:
                page = answer.read(1 << 20)
        except urllib.error.HTTPError as error:
            raise DeviceError(f"{address} answers {error.code}; there is another device at this address, not an ATI box"
                              ) from None
        except (OSError, ValueError) as error:
            raise DeviceError(f"no ATI box answers at {address} ({_reason(error)}); check its power, the cable, and "
                              "that this computer has an address in its network (a new box is at 192.168.1.1)"
                              ) from None
        try:
            return rdt.read_settings_page(page)
        except InputError as error:
            raise DeviceError(f"{address}: {error}") from None

    @property
    def _bracketed(self) -> str:
        return f"[{self._host}]" if ":" in self._host else self._host

    def read(self) -> tuple[ForceSample, ...]:
        stream = self._started()
        scales, zero = self._scales, self._zero
        return tuple(ForceSample(counts, tuple(scale * (count - offset) for scale, count, offset
                                               in zip(scales, counts, zero, strict=True)), number, status, received)
                     for counts, number, status, received in stream.take())

    def tare(self) -> None:
        stream = self._started()
        wanted = max(1, min(_TARED, math.ceil(0.1 * self.rate)))
        latest = stream.latest(wanted, timeout=_PATIENCE + 2 * wanted / self.rate)
        self._zero = tuple(sum(axis) / len(latest) for axis in zip(*latest, strict=True))

    def stop(self) -> None:
        stream, self._stream = self._stream, None
        if stream is not None:
            stream.end()

    def describe(self) -> dict[str, Any]:
        about: dict[str, Any] = {"sensor": "ATI RDT", "address": f"{self._bracketed}:{self._port}",
                                 "rate_Hz": self.rate, "channels": list(self.channels),
                                 "checked_with": "emulator, fake sensor of pynetft; unverified on hardware"}
        if (settings := self._settings) is not None:
            about |= {"product": settings.product, "calibration": settings.calibration,
                      "unit_of_force": settings.force_unit, "unit_of_torque": settings.torque_unit,
                      "resolution_N": settings.newtons, "resolution_Nm": settings.newton_metres}
        if self._stream is not None:
            about |= self._stream.tally()
        return about

    def _started(self) -> _Stream:
        if self._stream is None:
            raise DeviceError(f"the sensor at {self._host} is not started; start it first")
        return self._stream

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_stream": None, "_settings": None, "_zero": (0.0,) * 6}


class _Stream:
    """The records of a box as they come, received by a thread.

    Args:
        host, port: of the box.
    """

    def __init__(self, host: str, port: int):
        self._host = host
        try:
            family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
            self._socket = socket.socket(family, kind)
        except OSError as error:
            raise DeviceError(f"{host} cannot be reached ({_reason(error)}); check the address") from None
        with contextlib.suppress(OSError):  # a smaller buffer is no reason to refuse
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
        self._address = address
        self._waiting: deque[tuple[tuple[int, ...], int, int, float]] = deque(maxlen=BUFFER)
        self._ending = threading.Event()
        self._counter = RecordCounter()
        #: What a failing line said last.
        self._failure = ""
        self._came = threading.Condition()
        self._thread = threading.Thread(target=self._receive, name="RDT", daemon=True)
        self._overflowed = self._told_overflow = 0

    def begin(self) -> None:
        """Ask for records, and wait for the first.

        Raises:
            DeviceError: none comes.
        """
        try:
            # Only what the box itself sends is received.
            self._socket.connect(self._address)
            self._socket.settimeout(0.1)
            self._socket.send(rdt.pack_request(Request(rdt.REAL_TIME)))
        except OSError as error:
            raise DeviceError(f"{self._host} cannot be reached ({_reason(error)}); check the network") from None
        self._thread.start()
        with self._came:
            if not self._came.wait_for(lambda: self._waiting, _FIRST):
                garbled = self._counter.garbled
                raise DeviceError(f"{self._host} answers on its settings page, and "
                                  + (f"sends {garbled} datagrams that are no records of RDT; another device is there"
                                     if garbled else "sends no records by UDP; switch RDT on in its communication "
                                     "settings, and let a firewall pass its port 49152"))

    def _receive(self) -> None:
        buffer = bytearray(rdt.RECORD_SIZE * rdt.MOST_RECORDS + 1)
        view, waiting, counter = memoryview(buffer), self._waiting, self._counter
        while not self._ending.is_set():
            try:
                size = self._socket.recv_into(buffer)
            except TimeoutError:
                continue
            except OSError as error:
                # A refused port is told once for each datagram that was sent there: the box may come back.
                self._failure = _reason(error)
                if self._ending.wait(0.05):
                    return
                continue
            now = time.monotonic()
            for record, number, status in counter.accept(rdt.unpack_records(bytes(view[:size])), now):
                if len(waiting) == BUFFER:
                    self._overflowed += 1
                waiting.append((record.counts, number, status, now))
            with self._came:
                self._came.notify_all()

    def take(self) -> list[tuple[tuple[int, ...], int, int, float]]:
        """Counts, number, status and time of receipt, s, of all records since the last call."""
        waiting, taken = self._waiting, []
        for _ in range(len(waiting)):
            taken.append(waiting.popleft())
        if taken and self._overflowed != self._told_overflow:
            self._told_overflow = self._overflowed
            counts, number, status, at = taken[0]
            taken[0] = counts, number, status | SampleStatus.GAP, at
        return taken

    def latest(self, count: int, timeout: float) -> list[tuple[int, ...]]:
        """Counts of the next records; they stay to be read.

        Raises:
            DeviceError: they do not come in that time, s, or are not to be trusted.
        """
        with self._came:
            first = self._counter.accepted
            if not self._came.wait_for(lambda: self._counter.accepted - first >= count, timeout):
                raise DeviceError(f"{self._host} sends no records any more; check its power and the cable")
            latest = list(self._waiting)[-count:]
        for _, _, status, _ in latest:
            if status & (SampleStatus.FAULT | SampleStatus.SATURATED):
                raise DeviceError(f"{self._host} says that {rdt.describe_status(self._counter.status)}; a tare of that "
                                  "would be wrong: take the load off and look at its status page")
        return [counts for counts, *_ in latest]

    def tally(self) -> dict[str, Any]:
        """How many records came, and what was wrong with others."""
        counter = self._counter
        tally: dict[str, Any] = {
            "records": counter.accepted, "lost": counter.lost, "twice": counter.twice, "late": counter.late,
            "garbled": counter.garbled, "begun_anew": counter.restarts, "overflowed": self._overflowed}
        if counter.status:
            tally["last_status"] = rdt.describe_status(counter.status)
        if self._failure:
            tally["last_failure"] = self._failure
        return tally

    def end(self) -> None:
        """Ask for no more, and close."""
        self._ending.set()
        if self._thread.is_alive():
            self._thread.join()
        with contextlib.suppress(OSError):
            self._socket.send(rdt.pack_request(Request(rdt.STOP)))
        self._socket.close()


class RecordCounter:
    """Which records are new, and what happened to the others.

    Attributes:
        accepted: new ones. lost: numbers that never came, late ones less. twice, late: came again, after a newer one.
        garbled: datagrams that hold no records. restarts: how often the box began to count anew.
        status: of the last record that reported something.
    """

    def __init__(self) -> None:
        self.accepted = self.lost = self.twice = self.late = self.garbled = self.restarts = self.status = 0
        self._last: Record | None = None
        #: Number of the last sample, and what it is more than the box's own.
        self._number, self._heard = -1, -math.inf
        #: Numbers of the box that were jumped over, not long ago.
        self._missing: deque[int] = deque(maxlen=_OVERTAKEN)
        self._anew = False

    def accept(self, records: list[Record] | None, now: float) -> list[tuple[Record, int, int]]:
        """The new ones of a datagram, with number since the start and status; None: it held none."""
        if records is None:
            self.garbled += 1
            return []
        new = []
        for record in records:
            if (number := self._number_of(record, now)) is None:
                continue
            status = SampleStatus.GOOD
            if self._anew or number > self._number + 1:
                status |= SampleStatus.GAP
            if record.status:
                self.status = record.status
                if rdt.is_out_of_range(record.status):
                    status |= SampleStatus.SATURATED
                if rdt.is_fault(record.status):
                    status |= SampleStatus.FAULT
            self._number, self._last, self._heard, self._anew = number, record, now, False
            self.accepted += 1
            new.append((record, number, int(status)))
        return new

    def _number_of(self, record: Record, now: float) -> int | None:
        """Of a new record since the start; None: it is not new."""
        last = self._last
        if last is None:
            return 0
        ahead = record.sequence - last.sequence & 0xFFFFFFFF
        if 0 < ahead < 1 << 31:
            self.lost += ahead - 1
            self._missing.extend(range(record.sequence - min(ahead - 1, _OVERTAKEN), record.sequence))
            return self._number + ahead
        behind = last.sequence - record.sequence & 0xFFFFFFFF
        sampled_later = 0 < (record.sample - last.sample & 0xFFFFFFFF) < 1 << 31
        if sampled_later or behind > _OVERTAKEN or now - self._heard > _PAUSE:
            # The box counts from 1 again; how much was lost, nobody knows.
            self.restarts += 1
            self._anew = True
            self._missing.clear()
            return self._number + 1
        if record.sequence in self._missing:
            self._missing.remove(record.sequence)
            self.late += 1
            self.lost -= 1
        else:
            self.twice += 1
        return None


def _reason(error: BaseException) -> str:
    """What an error of a line says, in few words."""
    inner = getattr(error, "reason", error)
    return getattr(inner, "strerror", None) or str(inner) or type(inner).__name__


def open_rdt(text: str) -> RdtSensor:
    """``rdt://192.168.1.1``, or with ports: ``rdt://192.168.1.1:49152,http_port=80``."""
    address, _, rest = text.removeprefix("//").partition(",")
    name, _, given = rest.partition("=")
    if name.strip() not in ("", "http_port"):
        raise InputError(f"unknown setting {name.strip()!r}; only http_port can be set", field="settings")
    host, port = address, str(rdt.PORT)
    if address.startswith("["):
        host, _, rest = address[1:].partition("]")
        port = rest.removeprefix(":") or port
    elif address.count(":") == 1:
        host, _, port = address.partition(":")
    try:
        numbers = int(port.rstrip("/")), int(given) if given else rdt.HTTP_PORT
    except ValueError:
        raise InputError(f"{text!r} holds a port that is no whole number; give rdt://ADDRESS:PORT,http_port=PORT",
                         field="port") from None
    return RdtSensor(host.rstrip("/"), *numbers)
