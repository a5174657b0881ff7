"""A serial connection to Grbl. A thread reads its lines, requests status reports and calls a function after each."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from haptics.devices.contracts import DeviceError
from haptics.devices.serial_line import SerialLine, probe_controller_and_get_hint
from haptics.protocols import grbl

#: Name of the controller in messages.
_OWNER = "the Grbl"


@dataclass(frozen=True)
class GrblTiming:
    """Waiting times and intervals of a connection to Grbl, s."""

    #: Longest wait for the first report; opening the port resets an Arduino, which then boots.
    boot: float = 4.0
    #: Interval of the report requests during the boot.
    boot_interval: float = 0.25
    #: Longest wait for the answer to a line before the thread runs.
    line: float = 2.0
    #: Interval at which the thread reads the port while the axis moves or a caller waits.
    busy_poll: float = 2e-3
    #: Interval at which the thread reads the port otherwise.
    idle_poll: float = 20e-3
    #: Interval of the report requests while the axis moves or a caller waits.
    busy_report_interval: float = 15e-3
    #: Interval of the report requests otherwise.
    idle_report_interval: float = 0.1
    #: Time without the requested report after which the request is repeated.
    report_retry: float = 0.25


#: Settings of all connections of this process.
TIMING = GrblTiming()


@dataclass(frozen=True)
class AxisReportInMillimetres:
    """A status report of Grbl about one axis; lengths in mm, times in s.

    Attributes:
        state: State of Grbl, one of `grbl.STATES`.
        position: Position of the axis in machine coordinates, mm.
        pins: Letters of the active inputs, see `grbl.StatusReport`.
        received: Time of receipt, s on the clock of `time.monotonic`.
        number: Number of the report since the start.
        requested: Time of the request, s.
        exchange: Number of lines sent and answered at the time of the request; -1: a line was unanswered.
        critical: True if Grbl accepts a reset only.
    """

    state: str
    position: float
    pins: str
    received: float
    number: int
    requested: float
    exchange: int
    critical: bool = False


class GrblConnection:
    """An open serial port with a Grbl. The constructor opens the port.

    Args:
        port: Serial port.
        baud: Baud rate.
        axis: Index of the reported axis, 0 to 2.

    Attributes:
        lock: Lock of all attributes.
        latest: Last report.
        unanswered: Number of lines sent without an answer so far.
        error: Number of the last error; None: none.
        alarm: Number of the last alarm; None: none.
        was_reset: True if Grbl has sent its banner since the last command that clears this flag.
        handled: Number of the report to which the last jogs or cancels responded.
        lost: Message of the error that ended the connection; empty while it works.

    Raises:
        DeviceError: The port cannot be opened.
    """

    def __init__(self, port: str, baud: int, axis: int):
        self._port, self._axis, self._baud, self._name = port, axis, baud, f"the Grbl at {port}"
        self._line = SerialLine(port, baud, _OWNER)
        self.lock = threading.RLock()
        self._received = threading.Condition(self.lock)
        self._writing = threading.Lock()
        self._wakeup, self._ending = threading.Event(), threading.Event()
        self._thread: threading.Thread | None = None
        #: Offset of the work coordinates, mm; None: unknown so far.
        self._offset: float | None = None
        #: Time of the pending report request, s; None: none is pending.
        self._requested: float | None = None
        #: Number of lines sent and answered, and its value at the pending report request.
        self._exchanges, self._exchanges_at_request = 0, -1
        #: Number of banners received.
        self._banners = 0
        #: True while a caller waits for a report.
        self._report_awaited = False
        self._critical = False
        #: Received bytes of an incomplete line.
        self._partial_line = b""
        self.latest = AxisReportInMillimetres("Idle", 0.0, "", time.monotonic(), 0, 0.0, -1)
        self.unanswered, self.handled, self.lost = 0, 0, ""
        self.error: int | None = None
        self.alarm: int | None = None
        self.was_reset = False

    def check_version_and_read_settings(self) -> dict[int, float]:
        """Check that a Grbl 1.1 answers and is not in use, and return its settings ``$$``, values by number.

        Sends no reset, which would lose the position of a moving axis. Cancels a jog that another program has left.

        Raises:
            DeviceError: No Grbl 1.1 answers, or it executes another program's commands.
        """
        state = self._request_and_get_first_state()
        if state == "Jog":
            # Jogs of another program that has ended.
            self.send_bytes(grbl.JOG_CANCEL)
        elif state in ("Run", "Hold", "Home"):
            raise DeviceError(f"{self._name} is in the state {state} because of another program; end that program, and "
                              "start again")
        lines = self._query_answer_lines(b"$I\n")
        versions = [version for version in map(grbl.parse_version_and_date_or_none, lines) if version]
        if not versions or not versions[0][0].startswith("1.1"):
            version = versions[0][0] if versions else "no version"
            raise DeviceError(f"{self._name} reports {version}; install Grbl 1.1, which can jog")
        settings = [setting for setting in map(grbl.parse_setting_or_none, self._query_answer_lines(b"$$\n"))
                    if setting]
        return dict(settings)

    def _request_and_get_first_state(self) -> str:
        """Request reports until the first one arrives, return its state, such as ``"Idle"``; DeviceError if none."""
        end, requested, received = time.monotonic() + TIMING.boot, -1.0, b""
        while time.monotonic() < end:
            if time.monotonic() - requested > TIMING.boot_interval:
                requested = time.monotonic()
                self.send_bytes(grbl.STATUS)
            received += self._line.read()
            for line in received.decode("latin-1").split("\n")[:-1]:
                report = grbl.parse_report_or_none(line.strip())
                if report:
                    return report.state
            time.sleep(TIMING.busy_poll)
        if received:
            raise DeviceError(f"the device at {self._port} is no Grbl, or its baud rate is not {self._baud} (it sent "
                              f"{received[:20]!r}); check the baud rate and the device"
                              f"{probe_controller_and_get_hint(self._line)}")
        raise DeviceError(f"nothing answers at {self._port} within {TIMING.boot:g} s; check that the Grbl has power, "
                          f"the cable and the baud rate ({self._baud}){probe_controller_and_get_hint(self._line)}")

    def _query_answer_lines(self, command: bytes) -> list[str]:
        """Send a command before the thread runs, and return the lines before its ``ok``; DeviceError for an error."""
        self.send_bytes(command)
        lines: list[str] = []
        end = time.monotonic() + TIMING.line
        while time.monotonic() < end:
            line = self._line.read_line_or_raise(TIMING.line).decode("latin-1").strip()
            answer = grbl.parse_answer_kind_and_number_or_none(line)
            if answer == ("ok", 0):
                return lines
            if answer:
                cause = grbl.describe_error(answer[1]) if answer[0] == "error" else grbl.describe_alarm(answer[1])
                raise DeviceError(f"{self._name} answers {command.decode().strip()} with {line}: {cause}")
            lines.append(line)
        raise DeviceError(f"{self._name} sends no 'ok' after its answer to {command.decode().strip()} within "
                          f"{TIMING.line:g} s; check the cable")

    def start_thread(self, act: Callable[[GrblConnection], bool]) -> None:
        """Start the thread. It calls `act` with the lock held; `act` returns True while a motion is in progress."""
        self._thread = threading.Thread(target=self._run_thread, args=(act,), name="Grbl", daemon=True)
        self._thread.start()

    def _run_thread(self, act: Callable[[GrblConnection], bool]) -> None:
        """Read lines, act and request reports until the end or an error; the body of the thread."""
        while not self._ending.is_set():
            try:
                data = self._line.read()
                with self.lock:
                    lines = self._buffer_bytes_and_get_lines(data)
                    for line in lines:
                        self._handle_line(line)
                    busy = act(self) or self._report_awaited or self.unanswered > 0
                    self._request_report_if_due(TIMING.busy_report_interval if busy else TIMING.idle_report_interval)
                    if lines:
                        self._received.notify_all()
            except DeviceError as error:
                with self.lock:
                    self.lost = str(error)
                    act(self)
                    self._received.notify_all()
                return
            self._wakeup.wait(TIMING.busy_poll if busy else TIMING.idle_poll)
            self._wakeup.clear()

    def _buffer_bytes_and_get_lines(self, data: bytes) -> list[str]:
        """Add bytes to the buffer; remove and return its complete lines. Keeps 1000 bytes of an incomplete one."""
        *lines, self._partial_line = (self._partial_line + data).split(b"\n")
        self._partial_line = self._partial_line[-1000:]
        return [line.decode("latin-1").strip() for line in lines]

    def _handle_line(self, line: str) -> None:
        """Update the attributes from a received line: report, answer, alarm or banner; ignores other lines."""
        report, answer = grbl.parse_report_or_none(line), grbl.parse_answer_kind_and_number_or_none(line)
        if report is not None:
            self._store_requested_report(report)
        elif answer is not None:
            kind, number = answer
            if kind == "ALARM":
                self.alarm, self._critical = number, number in (1, 2)
                last = self.latest
                self.latest = AxisReportInMillimetres("Alarm", last.position, last.pins, last.received, last.number,
                                                      last.requested, -1, self._critical)
                # Grbl discards its queue on an alarm and answers none of its lines.
                self.unanswered = 0
            else:
                self.unanswered = max(self.unanswered - 1, 0)
                if kind == "error":
                    self.error = number
            self._exchanges += 1
        elif grbl.parse_banner_version_or_none(line) is not None:
            self.was_reset, self.unanswered, self._critical = True, 0, False
            self._banners += 1
            self._exchanges += 1

    def _store_requested_report(self, report: grbl.StatusReport) -> None:
        """Store a report as `latest`, in machine coordinates; ignores a report that was not requested."""
        if report.offset is not None and self._axis < len(report.offset):
            self._offset = report.offset[self._axis]
        coordinates = report.machine if report.machine is not None else report.work
        if coordinates is None or self._axis >= len(coordinates) or self._requested is None:
            return
        requested, exchange, self._requested = self._requested, self._exchanges_at_request, None
        position = coordinates[self._axis]
        if report.machine is None:
            if self._offset is None:
                return  # Grbl sends the offset in one of the next reports
            position += self._offset
        if report.state != "Alarm":
            self._critical = False
        self.latest = AxisReportInMillimetres(report.state, position, report.pins, time.monotonic(),
                                              self.latest.number + 1, requested, exchange, self._critical)
        self._report_awaited = False

    def _request_report_if_due(self, interval: float) -> None:
        """Request a report if the last one was requested `interval` s ago, or a pending request has had no answer."""
        now = time.monotonic()
        if ((now - self.latest.requested >= interval) if self._requested is None else
                (now - self._requested > TIMING.report_retry)):
            self._requested = now
            self._exchanges_at_request = self._exchanges if self.unanswered == 0 else -1
            self.send_bytes(grbl.STATUS)

    @property
    def has_report_after_last_answer(self) -> bool:
        """True if all sent lines have an answer and `latest` was requested after the last answer."""
        return self.unanswered == 0 and self.latest.exchange == self._exchanges

    def wait_for_new_report_or_none(self, timeout: float) -> AxisReportInMillimetres | None:
        """Wait up to `timeout` s for a report requested after this call; return it, or None. Requires the lock."""
        begin = time.monotonic()
        self._wakeup.set()
        while self.latest.requested < begin or not self.latest.number:
            remaining = begin + timeout - time.monotonic()
            if remaining <= 0 or self.lost:
                return None
            self._report_awaited = True
            # A single wait for news instead of polling, which would take the lock from the thread.
            self._received.wait(remaining)
        return self.latest

    def send_line(self, line: bytes) -> None:
        """Send a line that Grbl answers with ``ok`` or an error; does not wait for the answer. Requires the lock."""
        self.unanswered += 1
        self._exchanges += 1
        self.send_bytes(line)

    def send_bytes(self, data: bytes) -> None:
        """Send bytes that Grbl does not answer; callable from any thread.

        Raises:
            DeviceError: The port has disappeared.
        """
        has_lock = self._writing.acquire(timeout=0.1)
        try:
            self._line.write(data)
        finally:
            if has_lock:
                self._writing.release()

    def reset_and_wait_for_banner(self) -> None:
        """Reset Grbl and wait for its banner, at most `GrblTiming.line` s; clears `alarm`. Requires the lock."""
        self.alarm, before = None, self._banners
        self.send_bytes(grbl.RESET)
        end = time.monotonic() + TIMING.line
        while self._banners == before and not self.lost and time.monotonic() < end:
            self._received.wait(0.1)

    def wake_thread(self) -> None:
        """End the present wait of the thread, so that it reads the port and calls `act` at once."""
        self._wakeup.set()

    def close(self) -> None:
        """End the thread and close the port."""
        self._ending.set()
        self._wakeup.set()
        if self._thread is not None:
            self._thread.join()
        self._line.close()
