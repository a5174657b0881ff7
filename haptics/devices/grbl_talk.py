"""A conversation with Grbl: one thread reads what it says, asks for reports, and lets somebody act on them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from haptics.devices.contracts import DeviceError
from haptics.devices.serial_line import SerialLine
from haptics.devices.who_answers import who_answers
from haptics.protocols import grbl

#: How long an Arduino that was reset by opening its port needs to say something, s; how often it is asked meanwhile, s.
_BOOT, _ASK_EACH = 4.0, 0.25
#: Longest wait for the answer to a line before anything moves, s.
_LINE = 2.0
#: How often the thread looks at the line, s: while something moves or is waited for, and otherwise.
_BUSY, _IDLE = 2e-3, 20e-3
#: How often it asks for a report, s: while something moves, and otherwise.
_EACH_BUSY, _EACH_IDLE = 15e-3, 0.1
#: A report that has not come for so long is asked for again, s.
_ASK_AGAIN = 0.25
_OWNER = "the Grbl"


@dataclass(frozen=True)
class Seen:
    """The last report.

    Attributes:
        state, pins: see `grbl.Report`. place: of the axis in machine coordinates, mm.
        received: s on the clock of `time.monotonic`. number: of the report.
        asked: when it was asked for, s.
        turn: of the conversation when it was asked for; -1: a line had no answer then.
        critical: whether Grbl takes nothing but a reset.
    """

    state: str
    place: float
    pins: str
    received: float
    number: int
    asked: float
    turn: int
    critical: bool = False


class GrblTalk:
    """Opens the port.

    Args:
        port, baud: of the line. axis: number of the one that is reported.

    Attributes:
        lock: of everything here.
        seen: the last report.
        unanswered: lines that were sent and have no answer.
        refused: number of the last error. alarm: number of the last alarm.
        was_reset: whether Grbl has said its banner since the start.
        fed: number of the report on which jogs were sent last.
        lost: the sentence, when the line is gone.

    Raises:
        DeviceError: the port cannot be opened.
    """

    def __init__(self, port: str, baud: int, axis: int):
        self._port, self._axis, self._baud, self._name = port, axis, baud, f"the Grbl at {port}"
        self._line = SerialLine(port, baud, _OWNER)
        self.lock = threading.RLock()
        self._news = threading.Condition(self.lock)
        self._writing = threading.Lock()
        self._poke, self._ending = threading.Event(), threading.Event()
        self._thread: threading.Thread | None = None
        self._offset: float | None = None
        self._asked: float | None = None
        #: Counts lines sent and answered; as it was when the report was asked for.
        self._turn, self._asked_turn = 0, -1
        #: How often it has said its banner.
        self._banners = 0
        #: Whether somebody waits for a report.
        self._wanted = False
        self._critical = False
        self._kept = b""
        self.seen = Seen("Idle", 0.0, "", time.monotonic(), 0, 0.0, -1)
        self.unanswered, self.fed, self.lost = 0, 0, ""
        self.refused: int | None = None
        self.alarm: int | None = None
        self.was_reset = False

    def meet(self) -> dict[int, float]:
        """See that a Grbl 1.1 answers and stands, without a reset: that would lose the position of one that moves.

        Returns:
            Its settings, by number.
        """
        state = self._first_report()
        if state == "Jog":
            # Somebody else's, at most a moment old: given up.
            self.send(grbl.JOG_CANCEL)
        elif state in ("Run", "Hold", "Home"):
            raise DeviceError(f"{self._name} is in the state {state} for somebody else; end that, and start "
                              "again")
        lines = self._ask_at_rest(b"$I\n")
        versions = [version for version in map(grbl.parse_version, lines) if version]
        if not versions or not versions[0][0].startswith("1.1"):
            told = versions[0][0] if versions else "no version"
            raise DeviceError(f"{self._name} tells {told}; install Grbl 1.1, which can jog")
        settings = [setting for setting in map(grbl.parse_setting, self._ask_at_rest(b"$$\n")) if setting]
        return dict(settings)

    def _first_report(self) -> str:
        end, asked, heard = time.monotonic() + _BOOT, -1.0, b""
        while time.monotonic() < end:
            if time.monotonic() - asked > _ASK_EACH:
                asked = time.monotonic()
                self.send(grbl.STATUS)
            heard += self._line.read()
            for line in heard.decode("latin-1").split("\n")[:-1]:
                report = grbl.parse_report(line.strip())
                if report:
                    return report.state
            time.sleep(_BUSY)
        if heard:
            raise DeviceError(f"what answers at {self._port} is no Grbl, or is read at another baud rate than "
                              f"{self._baud} (it says {heard[:20]!r}); check the baud rate and which device this is"
                              f"{who_answers(self._line)}")
        raise DeviceError(f"nothing answers at {self._port} within {_BOOT:g} s; check that the Grbl has power, the "
                          f"cable and the baud rate ({self._baud}){who_answers(self._line)}")

    def _ask_at_rest(self, command: bytes) -> list[str]:
        """The lines before the ``ok`` of a command."""
        self.send(command)
        lines: list[str] = []
        end = time.monotonic() + _LINE
        while time.monotonic() < end:
            line = self._line.read_line(_LINE).decode("latin-1").strip()
            answer = grbl.parse_answer(line)
            if answer == ("ok", 0):
                return lines
            if answer:
                why = grbl.error_text(answer[1]) if answer[0] == "error" else grbl.alarm_text(answer[1])
                raise DeviceError(f"{self._name} answers {command.decode().strip()} with {line}: {why}")
            lines.append(line)
        raise DeviceError(f"{self._name} does not end its answer to {command.decode().strip()}; check the cable")

    def run(self, act: Callable[[GrblTalk], bool]) -> None:
        """Begin to listen; `act` is called in the thread, with the lock, and says whether something moves."""
        self._thread = threading.Thread(target=self._listen, args=(act,), name="Grbl", daemon=True)
        self._thread.start()

    def _listen(self, act: Callable[[GrblTalk], bool]) -> None:
        while not self._ending.is_set():
            try:
                data = self._line.read()
                with self.lock:
                    lines = self._lines(data)
                    for line in lines:
                        self._hear(line)
                    busy = act(self) or self._wanted or self.unanswered > 0
                    self._ask_for_report(_EACH_BUSY if busy else _EACH_IDLE)
                    if lines:
                        self._news.notify_all()
            except DeviceError as error:
                with self.lock:
                    self.lost = str(error)
                    act(self)
                    self._news.notify_all()
                return
            self._poke.wait(_BUSY if busy else _IDLE)
            self._poke.clear()

    def _lines(self, data: bytes) -> list[str]:
        *lines, self._kept = (self._kept + data).split(b"\n")
        self._kept = self._kept[-1000:]
        return [line.decode("latin-1").strip() for line in lines]

    def _hear(self, line: str) -> None:
        report, answer = grbl.parse_report(line), grbl.parse_answer(line)
        if report is not None:
            self._report(report)
        elif answer is not None:
            kind, number = answer
            if kind == "ALARM":
                self.alarm, self._critical = number, number in (1, 2)
                self.seen = Seen("Alarm", self.seen.place, self.seen.pins, self.seen.received, self.seen.number,
                                 self.seen.asked, -1, self._critical)
                # What was sent is thrown away.
                self.unanswered = 0
            else:
                self.unanswered = max(self.unanswered - 1, 0)
                if kind == "error":
                    self.refused = number
            self._turn += 1
        elif grbl.parse_banner(line) is not None:
            self.was_reset, self.unanswered, self._critical = True, 0, False
            self._banners += 1
            self._turn += 1

    def _report(self, report: grbl.Report) -> None:
        if report.offset is not None and self._axis < len(report.offset):
            self._offset = report.offset[self._axis]
        numbers = report.machine if report.machine is not None else report.work
        if numbers is None or self._axis >= len(numbers) or self._asked is None:
            return
        asked, turn, self._asked = self._asked, self._asked_turn, None
        place = numbers[self._axis]
        if report.machine is None:
            if self._offset is None:
                return  # one of the next reports tells it
            place += self._offset
        if report.state != "Alarm":
            self._critical = False
        self.seen = Seen(report.state, place, report.pins, time.monotonic(), self.seen.number + 1, asked, turn,
                         self._critical)
        self._wanted = False

    def _ask_for_report(self, each: float) -> None:
        now = time.monotonic()
        if (now - self.seen.asked >= each) if self._asked is None else (now - self._asked > _ASK_AGAIN):
            self._asked, self._asked_turn = now, self._turn if self.unanswered == 0 else -1
            self.send(grbl.STATUS)

    @property
    def is_settled(self) -> bool:
        """Whether all lines have their answer, and the last report was asked for after those."""
        return self.unanswered == 0 and self.seen.turn == self._turn

    def fresh(self, timeout: float) -> Seen | None:
        """A report that was asked for after this call; None: none came in time, or the line is lost. Needs the lock."""
        begin = time.monotonic()
        self._poke.set()
        while self.seen.asked < begin or not self.seen.number:
            left = begin + timeout - time.monotonic()
            if left <= 0 or self.lost:
                return None
            self._wanted = True
            # Waked by news only: whoever looks again and again keeps the thread from its line.
            self._news.wait(left)
        return self.seen

    def ask(self, line: bytes) -> None:
        """Send a line that Grbl answers. Needs the lock."""
        self.unanswered += 1
        self._turn += 1
        self.send(line)

    def send(self, data: bytes) -> None:
        """Send bytes that Grbl does not answer; from any thread.

        Raises:
            DeviceError: the port is gone.
        """
        mine = self._writing.acquire(timeout=0.1)
        try:
            self._line.write(data)
        finally:
            if mine:
                self._writing.release()

    def reset(self) -> None:
        """A soft reset, and the wait for its banner. Needs the lock."""
        self.alarm, before = None, self._banners
        self.send(grbl.RESET)
        end = time.monotonic() + _LINE
        while self._banners == before and not self.lost and time.monotonic() < end:
            self._news.wait(0.1)

    def wake(self) -> None:
        """Let the thread look at once."""
        self._poke.set()

    def close(self) -> None:
        """End the thread, and close the port."""
        self._ending.set()
        self._poke.set()
        if self._thread is not None:
            self._thread.join()
        self._line.close()
