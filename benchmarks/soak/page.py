"""Session of `soak` with the viewer: loop, page, a client, and faults around them."""

from __future__ import annotations

import math
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import scenes.viewer.live_simulation
from benchmarks import child_environment
from benchmarks.soak.scenes import HIGHEST, LAW, draw, model_of
from benchmarks.soak.tissue import LoggedSimulator, calls_in
from scenes.viewer.frame import FRAMES, Phase, SessionFrame
from scenes.viewer.page import Page
from scenes.viewer.scene import Scene
from scenes.viewer.session import Session
from tissue_sim.experiment.kinds.standard_tests import NEEDLE

#: Mean time between two of each, s.
BETWEEN = {"aim": 0.6, "parameters": 3.0, "reset": 6.0, "play": 7.0, "pause": 8.0, "nonsense": 2.0, "garbage": 3.0,
           "reload": 8.0, "tool": 15.0, "kill": 20.0}
#: Longest start of a loop, s.
_PATIENCE = 120.0
#: Longest time in which a killed loop may be shown as running, s.
_NOTICED = 0.5
#: What the page must refuse, each in a sentence.
NONSENSE: tuple[tuple[str, dict[str, Any]], ...] = (
    ("set_parameters", {"values": {"C10": 1e41}}), ("set_parameters", {"values": {"C10": math.nan}}),
    ("set_parameters", {"values": {"C10": -5.0}}), ("set_parameters", {"values": {"C99": 1.0}}),
    ("aim", {"depth": math.nan}), ("play", {"text": "ramp"}), ("play", {"text": "ramp 60mm"}),
    ("play", {"text": "(" * 400}), ("use_scene", {"name": "needle"}), ("replay", {}))


@dataclass
class PageSession:
    """Requests and answers of a session of the page.

    Attributes:
        loops: events of the tissue of each loop, see `Session.events`.
        frames: number of frames.
        asked, refused, unanswered: numbers of commands, of refused commands, and of commands without an answer.
        taken: invalid commands that were accepted.
        killed, noticed_ms: number of killed loops, and time until the page showed each end, ms.
        stale: number of frames of a running loop with read-outs older than half a second.
    """

    flags: list[str]
    loops: list[list[tuple[Any, ...]]] = field(default_factory=list)
    frames: int = 0
    asked: int = 0
    refused: int = 0
    unanswered: int = 0
    taken: list[str] = field(default_factory=list)
    killed: int = 0
    noticed_ms: list[float] = field(default_factory=list)
    stale: int = 0


def play(rng: np.random.Generator, material: Path, folder: Path, seconds: float) -> PageSession:
    """Open a page, use it at random, and close it."""
    drawn = draw(rng, material)
    played = PageSession(drawn[0])
    scenes.viewer.live_simulation.Simulator = partial(LoggedSimulator, folder=folder)  # type: ignore[misc]
    with ExitStack() as stack:
        player = _Player(played, rng, material, drawn, stack)
        player.run(seconds)
    for path in sorted(folder.glob("*.calls"), key=lambda path: path.stat().st_mtime):
        played.loops.append(calls_in(path))
        path.unlink()
    return played


class _Player:
    """Users and programs around one page."""

    def __init__(self, played: PageSession, rng: np.random.Generator, material: Path, drawn: tuple[list[str], float],
                 stack: ExitStack):
        self._played, self._rng, self._material = played, rng, material
        _, self._deepest = drawn
        model = model_of(played.flags)
        self._session = Session(Scene(NEEDLE, model.experiment, model.material))
        stack.callback(self._session.close)
        self._page = Page(self._session, self._session.update_and_make_frame(), material.parent, port=0,
                          low_graphics=True)
        stack.callback(self._page.close)
        self._port = self._page.server.get_port()
        self._reader: subprocess.Popen | None = None
        stack.callback(self._end_reader)
        self._next = {what: float(rng.exponential(mean)) for what, mean in BETWEEN.items()}
        self._waiting: list[tuple[str, float]] = []
        self._killed: float | None = None
        self._began = 0.0
        self._newest: tuple[float, float] = (0.0, time.monotonic())

    def run(self, seconds: float) -> None:
        self._wait_for_ticks()
        self._start_reader()
        self._began = due = time.monotonic()
        while (now := time.monotonic() - self._began) < seconds:
            for what, when in self._next.items():
                if now >= when:
                    self._next[what] = now + float(self._rng.exponential(BETWEEN[what]))
                    getattr(self, f"_{what}")()
            self._see(self._session.update_and_make_frame())
            due = max(due + 1.0 / FRAMES.rate, time.monotonic())
            time.sleep(max(0.0, due - time.monotonic()))
        self._session.update_and_make_frame()  # obeys what was asked last
        self._played.unanswered = len(self._waiting)

    def _see(self, frame: SessionFrame) -> None:
        self._page.show(frame)
        self._played.frames += 1
        now = time.monotonic()
        if self._killed is not None and frame.phase is Phase.DIED:
            self._played.noticed_ms.append(round(1e3 * (now - self._killed), 1))
            self._killed = None
            self._session.post("restart")
            self._wait_for_ticks()
        elif frame.phase is Phase.RUNNING and frame.readouts is not None:
            if frame.readouts.time != self._newest[0]:
                self._newest = frame.readouts.time, now
            self._played.stale += now - self._newest[1] > _NOTICED

    def _wait_for_ticks(self) -> None:
        """Wait for the first tick of a loop; the time is not part of the session."""
        asked = time.monotonic()
        until = asked + _PATIENCE
        while ((frame := self._session.update_and_make_frame()).phase not in (Phase.RUNNING, Phase.PAUSED)
               or frame.readouts is None):
            if time.monotonic() > until or frame.phase is Phase.DIED:
                raise SystemExit(f"the simulation does not start ({frame.phase.value}): "
                                 f"{self._session.simulation.message}; {frame.scene.model}")
            time.sleep(0.05)
        self._newest = frame.readouts.time, time.monotonic()
        self._began += time.monotonic() - asked

    def _post(self, command: str, then: Callable[[str | None], None] = lambda _: None, **values: Any) -> None:
        ticket = command, time.monotonic()
        self._waiting.append(ticket)
        self._played.asked += 1

        def answered(problem: str | None) -> None:
            self._waiting.remove(ticket)
            self._played.refused += problem is not None
            then(problem)

        self._session.post(command, reply=answered, **values)

    @property
    def _reach(self) -> float:
        return min(self._deepest, self._session.scene.max_tool_displacement)

    def _aim(self) -> None:
        self._post("aim", depth=float(self._rng.uniform(-HIGHEST, self._reach)))

    def _parameters(self) -> None:
        factors = self._rng.choice([0.05, 0.3, 1.0, 3.0, 20.0], 2, p=[0.1, 0.2, 0.4, 0.2, 0.1])
        self._post("set_parameters", values={name: float(factor * value) for (name, value), factor
                                             in zip(LAW.items(), factors, strict=True)})

    def _reset(self) -> None:
        self._post("reset")

    def _play(self) -> None:
        depth = 1e3 * self._rng.uniform(0.2, 1.0) * self._reach
        self._post("play", text=f"approach 1mm; ramp {depth:.3g}mm; hold 0.5s; unload; retract 1mm",
                   speed=float(self._rng.uniform(5e-3, 5e-2)), repeat=bool(self._rng.random() < 0.5))

    def _pause(self) -> None:
        self._post(str(self._rng.choice(["pause", "resume", "step"])))

    def _nonsense(self) -> None:
        command, values = NONSENSE[self._rng.integers(len(NONSENSE))]

        def must_be_refused(problem: str | None) -> None:
            # A later command of its kind makes this one void.
            if problem is None:
                self._played.taken.append(f"{command} {values}"[:80])

        self._session.update_and_make_frame()  # what was asked before is obeyed, and nothing comes after
        self._post(command, must_be_refused, **values)
        self._session.update_and_make_frame()

    def _garbage(self) -> None:
        """Send bytes that are not a request, and open silent connections."""
        for head in (b"", b"GET / HTTP/1.1\r\nHost: evil\r\n\r\n", b"GET /" + b"../" * 200 + b" HTTP/1.1\r\n\r\n"):
            with suppress(OSError), socket.create_connection(("127.0.0.1", self._port), timeout=0.2) as line:
                line.sendall(head + self._rng.bytes(2000))

    def _reload(self) -> None:
        self._end_reader()
        self._start_reader()

    def _tool(self) -> None:
        flags, self._deepest = draw(self._rng, self._material)
        experiment = model_of(flags).experiment
        self._post("use_scene", name=NEEDLE.name, tool=experiment.tool, friction=experiment.friction)
        self._session.update_and_make_frame()
        if self._session.simulation.phase is not Phase.DIED:
            self._wait_for_ticks()

    def _kill(self) -> None:
        if self._session.simulation.phase is Phase.RUNNING and self._killed is None:
            os.kill(self._session.simulation.haptic_loop_process.pid, signal.SIGKILL)
            self._killed = time.monotonic()
            self._played.killed += 1

    def _start_reader(self) -> None:
        self._reader = subprocess.Popen([sys.executable, "-m", "benchmarks.viewer.client", str(self._port)],
                                        stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
                                        env=child_environment())

    def _end_reader(self) -> None:
        if self._reader is not None:
            self._reader.kill()
            self._reader.wait()
            self._reader.stdin.close()
            self._reader = None
