"""Session of `soak` with a server: a client with a moving hand, and faults around it."""

from __future__ import annotations

import json
import math
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.soak.scenes import HIGHEST, LAW, draw
from haptics.devices.motions import TargetFollowingMotion
from haptics.server.client import TissueClient
from haptics.server.wire import REQUEST_SIZE, Reply, ReplyFlags, Request, Status, encode_request

PERIOD = 1e-3
#: Mean time between two of each, s, and duration of the motion to one aim.
BETWEEN = {"aim": 0.6, "parameters": 3.0, "reset": 6.0, "save": 5.0, "restore": 9.0, "wild": 2.0, "noise": 2.0,
           "flood": 4.0, "pause": 8.0, "garbage": 3.0}
#: Depths and times that no scene holds, m and s.
WILD = (math.nan, math.inf, 1e300, -1e300, 0.071, 1e3, 1.7e308)


@dataclass
class Session:
    """Requests and answers of a session of the server.

    Attributes:
        flags: command line of the server.
        resolution: resolution that the server chose.
        events: events in order: ("step", time, depth, status, force, dt, flags, asked, answered), times in s;
            ("parameters", values), ("reset",), ("save", name), ("restore", name), ("fault", what, when).
        words: stderr of the server.
        ended_by: "signal" or "kill".
        exit_code: exit code of the server.
        lost: number of requests without a reply while the server ran.
    """

    flags: list[str]
    resolution: str = ""
    events: list[tuple[Any, ...]] = field(default_factory=list)
    words: str = ""
    ended_by: str = ""
    exit_code: int | None = None
    lost: int = 0


def run(rng: np.random.Generator, material: Path, seconds: float) -> Session:
    """Start a server, use it at random, and end it."""
    flags, deepest = draw(rng, material)
    session = Session(flags)
    process = subprocess.Popen([sys.executable, "-m", "scenes.cli", "serve", "--port", "0", "--json", *session.flags],
                               stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, encoding="utf-8")
    try:
        ports = json.loads(process.stdout.readline())
        _Play(session, rng, ports, deepest).run(seconds)
        session.ended_by = "kill" if rng.random() < 0.3 else "signal"
    finally:
        alive = process.poll() is None
        process.send_signal(signal.SIGKILL if session.ended_by != "signal" else signal.SIGINT)
        _, session.words = process.communicate(timeout=60)
        session.exit_code = process.returncode if alive or process.returncode else None
    return session


class _Play:
    """Client of a session."""

    def __init__(self, session: Session, rng: np.random.Generator, ports: dict[str, Any], deepest: float):
        self._session, self._rng, self._events, self._deepest = session, rng, session.events, deepest
        self._port, self._hand = ports["port"], TargetFollowingMotion(-HIGHEST, speed=0.12, response=25.0)
        self._line = socket.create_connection(("127.0.0.1", ports["configuration_port"]), timeout=30.0)
        self._lines = self._line.makefile("rb")
        self._stranger = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._stranger.setblocking(False)
        self._states: list[str] = []
        self._next = {what: float(rng.exponential(mean)) for what, mean in BETWEEN.items()}
        self._resets = True
        self._last: tuple[float, float] = (0.0, -HIGHEST)

    def run(self, seconds: float) -> None:
        self._session.resolution = self._ask("describe")["resolution"]
        self._began = time.monotonic()
        with TissueClient(self._port, timeout=2.0) as client:
            tick = 0
            while (now := time.monotonic() - self._began) < seconds:
                for what, when in self._next.items():
                    if now >= when:
                        self._next[what] = now + float(self._rng.exponential(BETWEEN[what]))
                        getattr(self, f"_{what}")(client)
                self._step(client, time.monotonic() - self._began)
                tick = max(tick + 1, int((time.monotonic() - self._began) / PERIOD))
                time.sleep(max(0.0, self._began + tick * PERIOD - time.monotonic()))
        self._lines.close()
        self._line.close()
        self._stranger.close()

    def _step(self, client: TissueClient, now: float, depth: float | None = None, at: float | None = None) -> None:
        depth = self._hand.depth(now) if depth is None else depth
        reset, self._resets = self._resets, False
        at = now if at is None else at
        if reset:
            self._events.append(("reset",))
        try:
            reply: Reply = client.step(depth, at=at, reset=reset)
        except (TimeoutError, ConnectionError):
            self._session.lost += 1
            return
        if reply.status < Status.BUSY:
            self._last = (at, depth)
        self._events.append(("step", at, depth, reply.status, reply.force[2], reply.dt,
                             bool(reply.flags & ReplyFlags.LIMITED), now, time.monotonic() - self._began))

    def _fault(self, what: str) -> None:
        self._events.append(("fault", what, time.monotonic() - self._began))

    def _aim(self, _: TissueClient) -> None:
        self._hand.aim(float(self._rng.uniform(-HIGHEST, self._deepest)))

    def _parameters(self, _: TissueClient) -> None:
        factors = self._rng.choice([0.05, 0.3, 1.0, 3.0, 20.0], 2, p=[0.1, 0.2, 0.4, 0.2, 0.1])
        values = {name: float(factor * value) for (name, value), factor in zip(LAW.items(), factors, strict=True)}
        if "error" not in self._ask("set_parameters", parameters=values):
            self._events.append(("parameters", values))
            self._fault("parameters")

    def _reset(self, _: TissueClient) -> None:
        self._fault("reset")
        self._resets = True

    def _save(self, _: TissueClient) -> None:
        name = f"s{self._rng.integers(4)}"
        if "error" not in self._ask("save", name=name):
            self._states.append(name)
            self._events.append(("save", name))

    def _restore(self, _: TissueClient) -> None:
        if self._states and "error" not in self._ask("restore", name=(name := str(self._rng.choice(self._states)))):
            self._events.append(("restore", name))
            self._fault("restore")

    def _wild(self, client: TissueClient) -> None:
        self._fault("wild poses")
        for _ in range(5):
            now = time.monotonic() - self._began
            self._step(client, now, depth=float(self._rng.choice(WILD)))
            self._step(client, now, depth=self._last[1], at=float(self._rng.choice([math.nan, 1e300, -1e9])))

    def _noise(self, _: TissueClient) -> None:
        """Send damaged requests and random bytes from another client."""
        self._fault("noise")
        for _ in range(50):
            packet = bytearray(encode_request(Request(int(self._rng.integers(2**62)), 0.0, session=3)))
            for _ in range(self._rng.integers(1, 6)):
                packet[self._rng.integers(len(packet))] = self._rng.integers(256)
            self._throw(bytes(packet[: self._rng.integers(REQUEST_SIZE + 1)]) + self._rng.bytes(self._rng.integers(4)))

    def _flood(self, _: TissueClient) -> None:
        self._fault("flood")
        for sequence in range(2000):
            self._throw(encode_request(Request(sequence, 0.0, session=5)))

    def _pause(self, _: TissueClient) -> None:
        time.sleep(0.3)
        self._fault("pause")

    def _garbage(self, _: TissueClient) -> None:
        """Send lines that are not commands; each must be answered."""
        for line in (b"{}", b"[" * 2000, b"\xff\xfe", b'{"command": "restore", "name": "' + b"x" * 500 + b'"}',
                     b'{"command": "set_parameters", "parameters": {"C10": 1e41}}',
                     b'{"command": "set_parameters", "parameters": {"C10": ' + b"9" * 5000 + b"}}"):
            self._line.sendall(line + b"\n")
            assert "error" in json.loads(self._lines.readline())

    def _throw(self, packet: bytes) -> None:
        with suppress(OSError):  # a full buffer
            self._stranger.sendto(packet, ("127.0.0.1", self._port))

    def _ask(self, command: str, **more: Any) -> dict[str, Any]:
        self._line.sendall(json.dumps({"command": command, **more}).encode() + b"\n")
        return json.loads(self._lines.readline())
