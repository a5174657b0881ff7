"""Processes that `viewer` measures: the viewer, a client, Chromium, and the loop alone."""

import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

import tissue_sim as ts
from benchmarks import ROOT, child_environment
from benchmarks.viewer.client import READOUTS
from benchmarks.viewer.ticks import MOTION, SETTLING, TickCount
from haptics.devices.motions import ProtocolMotion
from haptics.loop.loop import LoopSettings
from haptics.loop.process import LoopProcess
from haptics.safety.limits import ForceLimiter
from haptics.safety.rendering import ForceRendering
from scenes.viewer.live_simulation import BUDGET

#: Notes every change of the read-outs, with the page's clock in ms.
_WATCH = """names => {
    const seen = window.__seen = [];
    const shown = () => names.map(name => document.querySelector(`[data-testid=${name}]`)?.textContent).join("|");
    let last = shown();
    new MutationObserver(() => {
        const now = shown();
        if (now !== last) seen.push([performance.now(), last = now]);
    }).observe(document.body, {subtree: true, childList: true, characterData: true});
}"""


@contextmanager
def script(name: str, *arguments: str) -> Iterator[subprocess.Popen]:
    """Run a module of this folder in a child process with line-buffered pipes; on exit, close its input and wait."""
    process = subprocess.Popen([sys.executable, "-m", f"benchmarks.viewer.{name}", *arguments], text=True,
                               encoding="utf-8", env=child_environment(), stdin=subprocess.PIPE,
                               stdout=subprocess.PIPE)
    try:
        yield process
    finally:
        process.stdin.close()
        process.wait()
        process.stdout.close()


def line_of(process: subprocess.Popen) -> str:
    """Return the next line of output of a process.

    Raises:
        SystemExit: the process has ended.
    """
    line = process.stdout.readline()
    if not line:
        raise SystemExit(f"{process.args[2]} has ended with code {process.wait()}; see what it printed")
    return line


class ViewerProcess:
    """Running process of `worker`.

    Attributes:
        port: of its page; elements: of its mesh; loop: the number of its loop's process.
    """

    def __init__(self, process: subprocess.Popen):
        self._process = process
        ready = json.loads(line_of(process))
        self.port, self.elements, self.loop = ready["port"], ready["elements"], ready["loop"]

    def run(self, seconds: float, viewer: str = "page", motion: str = "moves", clients: int = 1) -> dict:
        """Return the result of one run; see `worker.run`."""
        asked = {"viewer": viewer, "motion": motion, "clients": clients, "seconds": seconds}
        self._process.stdin.write(json.dumps(asked) + "\n")
        self._process.stdin.flush()
        return json.loads(line_of(self._process))


@contextmanager
def viewing(resolution: str) -> Iterator[ViewerProcess]:
    """Start a viewer of the needle."""
    with script("worker", resolution) as process:
        yield ViewerProcess(process)


@contextmanager
def reading(port: int) -> Iterator[Callable[[], list]]:
    """Start a client; the yielded function ends the client and returns its messages."""
    with script("client", str(port)) as process:
        line_of(process)

        def messages() -> list:
            process.stdin.close()
            return json.loads(line_of(process))

        yield messages


def looked_at(port: int, work: Callable[[], dict]) -> tuple[dict, list[tuple[float, str]]] | None:
    """Run `work` while Chromium shows the page with software rendering.

    Returns the result of `work`, and time (s of `time.monotonic`) and text of each change of the read-outs; None
    without Chromium or Playwright."""
    chromium = _chromium()
    if chromium is None:
        return None
    with chromium.chromium() as browser:
        page = browser.new_page(viewport={"width": 1000, "height": 700})
        chromium.open_viewer(page, f"http://127.0.0.1:{port}")
        page.evaluate(_WATCH, READOUTS)
        zero = _zero_of(page)
        done = work()
        seen = page.evaluate("() => window.__seen")
    return done, [(zero + 1e-3 * when, text) for when, text in seen]


def _chromium():
    """Return the module that drives Chromium for the documentation; None if Chromium is not available."""
    if importlib.util.find_spec("playwright") is None:
        return None
    spec = importlib.util.spec_from_file_location("docs_chromium", ROOT / "docs" / "chromium.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module if module.chromium_path() else None


def _zero_of(page) -> float:
    """Return the time of the page's clock zero, s of `time.monotonic`, from the shortest of several requests."""
    found = []
    for _ in range(50):
        asked = time.monotonic()
        now = 1e-3 * page.evaluate("() => performance.now()")
        answered = time.monotonic()
        found.append((answered - asked, 0.5 * (asked + answered) - now))
    return min(found)[1]


@contextmanager
def stopped(pid: int) -> Iterator[None]:
    """Stop a process during the context (SIGSTOP)."""
    os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(pid, signal.SIGCONT)


@contextmanager
def loop_alone(model: ts.Model) -> Iterator[tuple[int, Callable[[float], dict]]]:
    """The number of a process, and a function that counts the ticks of a number of seconds: the same loop in the same
    motion, with no viewer, and nothing published but its ring."""
    motion = ProtocolMotion(ts.Protocol.parse(MOTION, 21, 5e-3), repeat=True)
    loop = LoopProcess(partial(ts.Simulator, model, budget=BUDGET), motion, ForceRendering(ForceLimiter(1e3, 1e3)),
                       LoopSettings())
    with loop:
        loop.wait_until_ready(120.0)
        loop.pause()
        with loop.open_ring_reader() as ring:

            def run(seconds: float) -> dict:
                loop.resume()
                time.sleep(SETTLING)
                count = TickCount(ring)
                time.sleep(seconds)
                counted = count.counted()
                loop.pause()
                return counted

            yield loop.pid, run
