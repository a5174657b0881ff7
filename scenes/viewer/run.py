"""Run a session with the page, or without a screen, until it is stopped."""

from __future__ import annotations

import gc
import json as json_format
import sys
import threading
import webbrowser
from pathlib import Path
from typing import Any

from scenes.viewer.frame import NullViewer, Phase
from scenes.viewer.scene import Scene
from scenes.viewer.session import Session
from scenes.viewer.trace import Trace
from scenes.viewer.web_server import describe_network_access
from tissue_sim.errors import InputError
from tissue_sim.experiment.protocol import STUDY_SPEED
from tissue_sim.signals import call_stop_at_signals

#: Query parameters of the address with which viser renders at half resolution, for browsers without a graphics card.
HALF_RESOLUTION = {"fixedDpr": "0.5"}


def run_viewer_page(scene: Scene, materials: Path, page: dict[str, Any], *, seconds: float | None = None,
                    json: bool = False,
                    **options: Any) -> int:
    """Serve the page of a session until Ctrl-C, SIGTERM or the end of a given time.

    Args:
        scene: First scene.
        materials: Folder of material files.
        page: Options of `Page`: ``host``, ``port``, ``exposed``, ``token``, ``low_graphics``, ``dark``; and ``open``,
            whether to open a browser.
        seconds: Time after which the function returns, s; None: no limit.
        json: Print the address as a JSON object.
        options: Options of `Session`.

    Returns:
        Exit code.

    Raises:
        InputError: The page cannot start, for example because the port is in use.
    """
    from scenes.viewer.page import Page

    page = dict(page)
    opens = page.pop("open")
    session = Session(scene, **options)
    try:
        viewer = Page(session, session.update_and_make_frame(), materials, **page)
        try:
            address = viewer.server.make_page_address(**(HALF_RESOLUTION if page["low_graphics"] else {}))
            if json:
                print(json_format.dumps({"url": viewer.server.make_page_address()}), flush=True)
            else:
                print(f"{address}   (Ctrl-C stops)", flush=True)
            if page["exposed"]:
                warning = describe_network_access(page["host"], viewer.server.get_port())
                print(f"tissue-sim: warning: {warning}", file=sys.stderr)
            if opens:
                webbrowser.open_new_tab(address)
            gc.collect()
            gc.freeze()  # exempts the existing objects from garbage collection, which would delay frames
            stop = threading.Event()
            with call_stop_at_signals(stop.set):
                session.run(viewer, stop, seconds)
        finally:
            gc.unfreeze()
            viewer.close()
    finally:
        session.close()
    return 0


def run_headless_and_return_results(scene: Scene, seconds: float, *, protocol: str | None = None,
                                    speed: float = STUDY_SPEED, **options: Any) -> dict[str, Any]:
    """Play a protocol without a screen, and return the recorded curve.

    Args:
        scene: The scene.
        seconds: Duration after the first tick, s; compilation of the solver comes before.
        protocol: Protocol to play; None: the tool stays at the undeformed surface.
        speed: Speed of segments for which the protocol states none, m/s.
        options: Options of `Session`.

    Returns:
        Phase, message, curve, rates and RMSE with the keys of ``tissue-sim view --headless --json``.

    Raises:
        InputError: The session refuses the protocol.
    """
    session, viewer = Session(scene, **options), NullViewer()
    try:
        stop = threading.Event()
        with call_stop_at_signals(stop.set):
            while not stop.is_set() and session.update_and_make_frame().phase is Phase.STARTING:
                stop.wait(0.05)
            refused: list[str | None] = []
            if protocol is not None:
                session.post("play", text=protocol, speed=speed, reply=refused.append)
            session.run(viewer, stop, seconds)
            while session.is_waiting_for_curve and not stop.is_set():
                viewer.show(session.update_and_make_frame())
                stop.wait(0.05)
        # No frame was shown if a signal stopped the run early.
        frame = viewer.latest or session.update_and_make_frame()
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
