"""Run a viewer until somebody stops it."""

from __future__ import annotations

import gc
import json as json_format
import sys
import threading
import webbrowser
from pathlib import Path
from typing import Any

from scenes.stop_signals import stopped_by_signals
from scenes.viewer.frame import NullViewer, Phase
from scenes.viewer.scene import Scene
from scenes.viewer.session import Session
from scenes.viewer.trace import Trace
from scenes.viewer.web_server import exposure
from tissue_sim.errors import InputError
from tissue_sim.experiment.protocol import STUDY_SPEED

#: What a browser without a graphics card is asked for.
HALF_RESOLUTION = {"fixedDpr": "0.5"}


def run_page(scene: Scene, materials: Path, page: dict[str, Any], *, seconds: float | None = None, json: bool = False,
             **options: Any) -> int:
    """Serve the page until Ctrl-C, SIGTERM or the end of the time.

    Args:
        scene: what to look at.
        materials: folder of material files.
        page: ``host``, ``port``, ``exposed``, ``token``, ``open``, ``low_graphics``, ``dark``.
        seconds: None: until it is stopped.
        json: say the address as an object.
        options: of `Session`.

    Returns:
        Exit code.

    Raises:
        InputError: what the page refuses; nothing runs then.
    """
    from scenes.viewer.page import Page

    page = dict(page)
    opens = page.pop("open")
    session = Session(scene, **options)
    try:
        viewer = Page(session, session.frame(), materials, **page)
        try:
            address = viewer.server.address(**(HALF_RESOLUTION if page["low_graphics"] else {}))
            if json:
                print(json_format.dumps({"url": viewer.server.address()}), flush=True)
            else:
                print(f"{address}   (Ctrl-C stops)", flush=True)
            if page["exposed"]:
                print(f"tissue-sim: warning: {exposure(page['host'], viewer.server.get_port())}", file=sys.stderr)
            if opens:
                webbrowser.open_new_tab(address)
            gc.collect()
            gc.freeze()  # what is there stays, and need not be looked through between two frames
            stop = threading.Event()
            with stopped_by_signals(stop.set):
                session.run(viewer, stop, seconds)
        finally:
            gc.unfreeze()
            viewer.close()
    finally:
        session.close()
    return 0


def run_headless(scene: Scene, seconds: float, *, protocol: str | None = None, speed: float = STUDY_SPEED,
                 **options: Any) -> dict[str, Any]:
    """Play a protocol without a screen, and say what was felt.

    Args:
        seconds: from the first tick on; the solver may have to be compiled before it.
        protocol: to play; None: the tool stays at the touch.
        speed: where the protocol states none, m/s.
        options: of `Session`.

    Raises:
        InputError: a protocol that is refused.
    """
    session, viewer = Session(scene, **options), NullViewer()
    try:
        stop = threading.Event()
        with stopped_by_signals(stop.set):
            while not stop.is_set() and session.frame().phase is Phase.STARTING:
                stop.wait(0.05)
            refused: list[str | None] = []
            if protocol is not None:
                session.post("play", text=protocol, speed=speed, reply=refused.append)
            session.run(viewer, stop, seconds)
            while session.waits_for_curve and not stop.is_set():
                viewer.show(session.frame())
                stop.wait(0.05)
        frame = viewer.latest or session.frame()  # stopped before its time
        if refused and refused[0] is not None and frame.phase is not Phase.DIED:
            raise InputError(refused[0])
        trace = frame.curves.trace or Trace()
        now = frame.readouts
        return {
            "frames": viewer.frames, "seconds": seconds, "phase": frame.phase.value, "message": frame.message,
            "time_s": trace.time.tolist(), "displacement_mm": (trace.depth * 1e3).tolist(),
            "force_N": trace.force.tolist(), "largest_force_N": float(trace.force.max(initial=0.0)),
            "rate_Hz": None if now is None else now.rate, "late_percent": None if now is None else 100 * now.late,
            "RMSE_N": None if frame.curves.residual is None else frame.curves.residual.rmse,
        }
    finally:
        session.close()
