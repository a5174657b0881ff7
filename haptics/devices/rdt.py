"""A force/torque sensor of ATI on the network: Net F/T and Ethernet Axia, by raw data transfer (RDT) over UDP."""

from __future__ import annotations

import contextlib
import math
import socket
import threading
import time
import urllib.error
import urllib.request
from collections import deque
from dataclasses import dataclass
from typing import Any

from haptics.devices.contracts import DeviceError, ForceSample, ForceSensor, SampleStatus
from haptics.protocols import rdt
from haptics.protocols.rdt import BoxSettings, RdtRecord, RdtRequest
from tissue_sim.errors import InputError


@dataclass(frozen=True)
class RdtReceptionSettings:
    """Buffer, waiting times and limits of the reception of RDT records."""

    #: Size of the system's receive buffer, bytes; with the usual default a loaded machine loses records at 7 kHz.
    receive_buffer: int = 4 << 20
    #: Samples kept until they are read; older ones are lost.
    kept_samples: int = 1 << 16
    #: Longest wait for the settings page, and for the records of a tare beyond their duration, s.
    patience: float = 2.0
    #: Longest wait for the first record, s.
    first_record: float = 1.0
    #: Largest difference of sequence numbers at which an old number is a delayed record; a larger one is a restart.
    max_reordering: int = 100
    #: Silence after which an old sequence number is a restart of the box, s.
    restart_pause: float = 0.25
    #: Largest number of records that a tare averages.
    tare_records: int = 100


#: Settings of all sensors of this process.
STREAM = RdtReceptionSettings()


class RdtSensor(ForceSensor):
    """A six-axis sensor whose box streams records; a thread receives them.

    `rate` is 7000 Hz before `start`, and then the rate on the box's settings page. After `start`, `describe` returns
    the numbers of records that were received, lost, duplicated, late and garbled, and of restarts of the box.

    Args:
        host: Name or address of the box.
        port: UDP port of the records.
        http_port: Port of the settings page.

    Raises:
        InputError: The host is empty, or a port is outside 1 to 65535.
    """

    channels = rdt.CHANNELS

    def __init__(self, host: str, port: int = rdt.PORTS.records, http_port: int = rdt.PORTS.settings):
        if not host:
            raise InputError("the address of the box must be given, as in rdt://192.168.1.1; got none", field="host")
        for number, field in ((port, "port"), (http_port, "http_port")):
            if not 0 < number < 65536:
                raise InputError(f"a port must be 1 to 65535; got {number}", field=field)
        self._host, self._port, self._http_port = host, port, http_port
        self.rate = 7000.0
        self._settings: BoxSettings | None = None
        self._stream: _RecordStreamThread | None = None
        self._zero = (0.0,) * 6

    def start(self) -> None:
        """Read the settings of the box, and start the thread that receives its stream of records."""
        if self._stream is not None:
            return
        settings = self._download_settings()
        try:
            force, torque = settings.newtons_per_count, settings.newton_metres_per_count
        except InputError as error:
            raise DeviceError(f"the box at {self._host}: {error}") from None
        if settings.rate is not None:
            self.rate = settings.rate
        self._settings, self._scales = settings, (force,) * 3 + (torque,) * 3
        self._zero = (0.0,) * 6
        stream = _RecordStreamThread(self._host, self._port)
        try:
            stream.start_stream()
        except DeviceError:
            stream.stop_and_close()
            raise
        self._stream = stream

    def _download_settings(self) -> BoxSettings:
        """Download the settings page of the box by HTTP, and return its units, scale and rate."""
        address = f"http://{self._host_in_url}:{self._http_port}{rdt.SETTINGS_PATH}"
        # Proxies of the environment are bypassed, because the box is on a local network.
        fetch = urllib.request.build_opener(urllib.request.ProxyHandler({})).open
        try:
            with fetch(address, timeout=STREAM.patience) as answer:
                page = answer.read(1 << 20)
        except urllib.error.HTTPError as error:
            raise DeviceError(f"{address} answers with HTTP status {error.code}, so it is no ATI box; check the address"
                              ) from None
        except (OSError, ValueError) as error:
            raise DeviceError(f"no ATI box answers at {address} ({_get_connection_error_cause(error)}); check its "
                              "power, the cable, and that this computer has an address in its network (a new box is at "
                              "192.168.1.1)") from None
        try:
            return rdt.parse_settings_page(page)
        except InputError as error:
            raise DeviceError(f"{address}: {error}") from None

    @property
    def _host_in_url(self) -> str:
        """Name or address of the box as in a URL; IPv6 addresses have brackets."""
        return f"[{self._host}]" if ":" in self._host else self._host

    def read(self) -> tuple[ForceSample, ...]:
        """Return the samples received since the last call, forces in N and torques in N m."""
        stream = self._get_stream_or_raise()
        scales, zero = self._scales, self._zero
        return tuple(ForceSample(counts, tuple(scale * (count - offset) for scale, count, offset
                                               in zip(scales, counts, zero, strict=True)), number, status, received)
                     for counts, number, status, received in stream.take_new_records())

    def tare(self) -> None:
        """Wait for the records of the next 0.1 s, at most 100, and set the mean of their counts as zero."""
        stream = self._get_stream_or_raise()
        count = max(1, min(STREAM.tare_records, math.ceil(0.1 * self.rate)))
        latest = stream.wait_for_counts_of_next_records(count, timeout=STREAM.patience + 2 * count / self.rate)
        self._zero = tuple(sum(axis) / len(latest) for axis in zip(*latest, strict=True))

    def stop(self) -> None:
        """End the stream of records and its thread, and close the socket."""
        stream, self._stream = self._stream, None
        if stream is not None:
            stream.stop_and_close()

    def describe(self) -> dict[str, Any]:
        """Return address, rate, calibration, resolution and statistics of the stream; keys carry units."""
        about: dict[str, Any] = {"sensor": "ATI RDT", "address": f"{self._host_in_url}:{self._port}",
                                 "rate_Hz": self.rate, "channels": list(self.channels),
                                 "checked_with": "emulator, fake sensor of pynetft; unverified on hardware"}
        if (settings := self._settings) is not None:
            about |= {"product": settings.product, "calibration": settings.calibration,
                      "unit_of_force": settings.force_unit, "unit_of_torque": settings.torque_unit,
                      "resolution_N": settings.newtons_per_count, "resolution_Nm": settings.newton_metres_per_count}
        if self._stream is not None:
            about |= self._stream.get_statistics()
        return about

    def _get_stream_or_raise(self) -> _RecordStreamThread:
        """Return the thread of the stream; raises a DeviceError if the sensor is not started."""
        if self._stream is None:
            raise DeviceError(f"the sensor at {self._host} is not started; start it first")
        return self._stream

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_stream": None, "_settings": None, "_zero": (0.0,) * 6}


class _RecordStreamThread:
    """A thread that receives the records of a box.

    Args:
        host: Name or address of the box.
        port: UDP port of the records.
    """

    def __init__(self, host: str, port: int):
        self._host = host
        try:
            family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
            self._socket = socket.socket(family, kind)
        except OSError as error:
            raise DeviceError(f"{host} cannot be reached ({_get_connection_error_cause(error)}); check the "
                              "address") from None
        with contextlib.suppress(OSError):  # a smaller buffer works, too
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, STREAM.receive_buffer)
        self._address = address
        #: Counts, number, status and time of receipt, s.
        self._waiting: deque[tuple[tuple[int, ...], int, int, float]] = deque(maxlen=STREAM.kept_samples)
        self._ending = threading.Event()
        self._counter = RecordSequenceTracker()
        #: Last error of the socket; empty: none.
        self._failure = ""
        self._arrived = threading.Condition()
        self._thread = threading.Thread(target=self._receive_datagrams, name="RDT", daemon=True)
        #: Number of records lost because they were not read, and its value at the last report of a gap.
        self._overflowed = self._reported_overflow = 0

    def start_stream(self) -> None:
        """Request the stream of records, start the receiving thread, and wait for the first record.

        Raises:
            DeviceError: No record arrives.
        """
        try:
            # Connecting the socket discards datagrams from other senders.
            self._socket.connect(self._address)
            self._socket.settimeout(0.1)
            self._socket.send(rdt.pack_request(RdtRequest(rdt.RdtCommand.REAL_TIME)))
        except OSError as error:
            raise DeviceError(f"{self._host} cannot be reached ({_get_connection_error_cause(error)}); check the "
                              "network") from None
        self._thread.start()
        with self._arrived:
            if not self._arrived.wait_for(lambda: self._waiting, STREAM.first_record):
                garbled = self._counter.garbled
                raise DeviceError(f"{self._host} answers on its settings page, but "
                                  + (f"sends {garbled} datagrams that are no RDT records; check that it is an ATI box"
                                     if garbled else "sends no records by UDP; switch RDT on in its communication "
                                     "settings, and let a firewall pass its port 49152"))

    def _receive_datagrams(self) -> None:
        """Receive datagrams and keep their new records until `stop_and_close`; the body of the thread."""
        buffer = bytearray(rdt.RECORD_SIZE * rdt.DATAGRAM.max_records + 1)
        view, waiting, counter = memoryview(buffer), self._waiting, self._counter
        while not self._ending.is_set():
            try:
                size = self._socket.recv_into(buffer)
            except TimeoutError:
                continue
            except OSError as error:
                # The system reports each datagram sent to a closed port; the box may return later.
                self._failure = _get_connection_error_cause(error)
                if self._ending.wait(0.05):
                    return
                continue
            now = time.monotonic()
            for record, number, status in counter.select_new_records(rdt.unpack_records_or_none(bytes(view[:size])),
                                                                     now):
                if len(waiting) == STREAM.kept_samples:
                    self._overflowed += 1
                waiting.append((record.counts, number, status, now))
            with self._arrived:
                self._arrived.notify_all()

    def take_new_records(self) -> list[tuple[tuple[int, ...], int, int, float]]:
        """Remove all records since the last call; return counts, number, status and time of receipt, s, of each."""
        waiting, taken = self._waiting, []
        for _ in range(len(waiting)):
            taken.append(waiting.popleft())
        if taken and self._overflowed != self._reported_overflow:
            self._reported_overflow = self._overflowed
            counts, number, status, at = taken[0]
            taken[0] = counts, number, status | SampleStatus.GAP, at
        return taken

    def wait_for_counts_of_next_records(self, count: int, timeout: float) -> list[tuple[int, ...]]:
        """Wait for the next `count` records and return the six counts of each, without removing the records.

        Raises:
            DeviceError: They do not arrive within `timeout` seconds, or report a saturation or a fault.
        """
        with self._arrived:
            first = self._counter.accepted
            if not self._arrived.wait_for(lambda: self._counter.accepted - first >= count, timeout):
                raise DeviceError(f"{self._host} has stopped sending records; check its power and the cable")
            latest = list(self._waiting)[-count:]
        for _, _, status, _ in latest:
            if status & (SampleStatus.FAULT | SampleStatus.SATURATED):
                raise DeviceError(f"{self._host} reports that {rdt.describe_status(self._counter.status)}, so a tare "
                                  "would be wrong; take the load off and check its status page")
        return [counts for counts, *_ in latest]

    def get_statistics(self) -> dict[str, Any]:
        """Return the numbers of records received, lost, duplicated, late and garbled, and the last status and error."""
        counter = self._counter
        counts: dict[str, Any] = {
            "records": counter.accepted, "lost": counter.lost, "twice": counter.twice, "late": counter.late,
            "garbled": counter.garbled, "begun_anew": counter.restarts, "overflowed": self._overflowed}
        if counter.status:
            counts["last_status"] = rdt.describe_status(counter.status)
        if self._failure:
            counts["last_failure"] = self._failure
        return counts

    def stop_and_close(self) -> None:
        """End the thread, request the end of the stream of records, and close the socket."""
        self._ending.set()
        if self._thread.is_alive():
            self._thread.join()
        with contextlib.suppress(OSError):
            self._socket.send(rdt.pack_request(RdtRequest(rdt.RdtCommand.STOP)))
        self._socket.close()


class RecordSequenceTracker:
    """Assign numbers to new records, and count lost, duplicated and late records.

    Attributes:
        accepted: Number of new records.
        lost: Number of sequence numbers that never arrived, without late ones.
        twice: Number of duplicates.
        late: Number of records that arrived after a newer one.
        garbled: Number of datagrams without records.
        restarts: Number of restarts of the box's sequence numbers.
        status: Last status word that was not 0.
    """

    def __init__(self) -> None:
        self.accepted = self.lost = self.twice = self.late = self.garbled = self.restarts = self.status = 0
        self._last: RdtRecord | None = None
        #: Number of the last accepted record since the start, and its time of receipt, s.
        self._number, self._received = -1, -math.inf
        #: Recent sequence numbers of the box that were skipped.
        self._missing: deque[int] = deque(maxlen=STREAM.max_reordering)
        self._has_restarted = False

    def select_new_records(self, records: list[RdtRecord] | None, now: float) -> list[tuple[RdtRecord, int, int]]:
        """Return the new records of a datagram, each with its number from 0 and its `SampleStatus`; update the counts.

        Args:
            records: Records of the datagram; None: the datagram contains no records.
            now: Time of receipt, s.
        """
        if records is None:
            self.garbled += 1
            return []
        new = []
        for record in records:
            if (number := self._count_record_and_get_number_or_none(record, now)) is None:
                continue
            status = SampleStatus.GOOD
            if self._has_restarted or number > self._number + 1:
                status |= SampleStatus.GAP
            if record.status:
                self.status = record.status
                if rdt.has_exceeded_range(record.status):
                    status |= SampleStatus.SATURATED
                if rdt.is_sample_unreliable(record.status):
                    status |= SampleStatus.FAULT
            self._number, self._last, self._received, self._has_restarted = number, record, now, False
            self.accepted += 1
            new.append((record, number, int(status)))
        return new

    def _count_record_and_get_number_or_none(self, record: RdtRecord, now: float) -> int | None:
        """Return the number of a record, from 0; None: late or duplicate. Counts lost, late and duplicate records."""
        last = self._last
        if last is None:
            return 0
        ahead = record.sequence - last.sequence & 0xFFFFFFFF
        if 0 < ahead < 1 << 31:
            self.lost += ahead - 1
            self._missing.extend(range(record.sequence - min(ahead - 1, STREAM.max_reordering), record.sequence))
            return self._number + ahead
        behind = last.sequence - record.sequence & 0xFFFFFFFF
        sampled_later = 0 < (record.sample - last.sample & 0xFFFFFFFF) < 1 << 31
        has_paused = now - self._received > STREAM.restart_pause
        if sampled_later or behind > STREAM.max_reordering or has_paused:
            # The box counts from 1 again; the number of lost records is unknown.
            self.restarts += 1
            self._has_restarted = True
            self._missing.clear()
            return self._number + 1
        if record.sequence in self._missing:
            self._missing.remove(record.sequence)
            self.late += 1
            self.lost -= 1
        else:
            self.twice += 1
        return None


def _get_connection_error_cause(error: BaseException) -> str:
    """Return the cause of a connection error in a few words, as a part of a message."""
    inner = getattr(error, "reason", error)
    return getattr(inner, "strerror", None) or str(inner) or type(inner).__name__


def make_rdt_sensor(text: str) -> RdtSensor:
    """Make a sensor from ``rdt://192.168.1.1``, or with ports ``rdt://192.168.1.1:49152,http_port=80``."""
    address, _, rest = text.removeprefix("//").partition(",")
    name, _, given = rest.partition("=")
    if name.strip() not in ("", "http_port"):
        raise InputError(f"the setting after the address must be http_port; got {name.strip()!r}", field="settings")
    host, port = address, str(rdt.PORTS.records)
    if address.startswith("["):
        host, _, rest = address[1:].partition("]")
        port = rest.removeprefix(":") or port
    elif address.count(":") == 1:
        host, _, port = address.partition(":")
    try:
        numbers = int(port.rstrip("/")), int(given) if given else rdt.PORTS.settings
    except ValueError:
        raise InputError(f"a port must be a whole number, as in rdt://ADDRESS:PORT,http_port=PORT; got {text!r}",
                         field="port") from None
    return RdtSensor(host.rstrip("/"), *numbers)
