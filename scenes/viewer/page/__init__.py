"""The viewer in a browser."""

from __future__ import annotations

import queue
from collections.abc import Callable
from pathlib import Path

import viser

from scenes.field_labels import LABELS
from scenes.viewer.colours import colour_bar_html
from scenes.viewer.frame import Commands, Frame, Phase
from scenes.viewer.page.calibration_controls import CalibrationControls
from scenes.viewer.page.curve_plots import CurvePlots
from scenes.viewer.page.look_controls import LookControls
from scenes.viewer.page.material_controls import MaterialControls
from scenes.viewer.page.motion_controls import MotionControls
from scenes.viewer.page.notices import answer_to
from scenes.viewer.page.readouts import readouts_html, status_html, title_html
from scenes.viewer.page.saving import Saving
from scenes.viewer.page.scene_controls import SceneControls
from scenes.viewer.page.solid import Solid
from scenes.viewer.web_server import LOOPBACK, PORT, open_server

#: Frames from one writing of plots and read-outs to the next.
_WORDS_EVERY = 3
#: Pixels.
_PANEL_WIDTH = 380


class Page:
    """A viewer that people see in their browsers; a back-end of `Session.run`. Close it.

    Args:
        session: gets what people ask for.
        frame: the first one.
        materials: folder of the material files to choose from and to save to.
        host, port, exposed, token: as in `scenes.viewer.web_server.open_server`.
        low_graphics: for browsers that draw without a graphics card.
        dark: begin with a dark page.

    Attributes:
        server: of viser, for tests.

    Raises:
        InputError: the port is taken, the host is refused, or there is no such folder.
    """

    def __init__(self, session: Commands, frame: Frame, materials: Path, *, host: str = LOOPBACK, port: int = PORT,
                 exposed: bool = False, token: str = "", low_graphics: bool = False, dark: bool = False):
        self._frames = 0
        self._tasks: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self.server = server = open_server(host, port, exposed=exposed, token=token)
        try:
            self._lay_out(session, frame, materials, low_graphics, dark)
        except BaseException:
            server.stop()
            raise

    def _lay_out(self, session: Commands, frame: Frame, materials: Path, low_graphics: bool, dark: bool) -> None:
        server, gui = self.server, self.server.gui
        self._solid = Solid(server, frame.scene, low_graphics=low_graphics)
        self._solid.on_drag(lambda depth, across, reply: session.post(
            "aim", reply=reply, depth=depth, **({} if across is None else {"across": across})))
        self._title = gui.add_html(title_html(frame.scene))
        self._status = gui.add_html(status_html(frame))
        self._restart = gui.add_button("Restart", icon=viser.Icon.REFRESH, color="red", visible=False)
        self._readouts = gui.add_html(readouts_html(frame))
        self._bar = gui.add_html("")
        tabs = gui.add_tab_group()
        with tabs.add_tab("Motion"):
            self._motion = MotionControls(server, session, frame)
            self._motion.on_drag_way = self._solid.drag_by
        with tabs.add_tab("Material"):
            self._material = MaterialControls(server, session, frame, materials)
        with tabs.add_tab("Calibrate"):
            self._calibration = CalibrationControls(server, session, frame, materials)
        with tabs.add_tab("Scene"):
            self._scene = SceneControls(server, session, frame)
        with tabs.add_tab("View"):
            self._look = LookControls(server, frame, self._solid.scale)
        with tabs.add_tab("Save"):
            self._saving = Saving(server, self._solid, self._look, self._later)
        curves = gui.add_panel()
        with curves.add_tab("Curves"):
            self._plots = CurvePlots(server, session, frame)
        self._look.on_dark = self._set_dark
        self._look.set_dark(dark)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(_PANEL_WIDTH)
        curves.dock_left()
        curves.set_width(_PANEL_WIDTH)

        @self._restart.on_click
        def _(event: viser.GuiEvent) -> None:
            session.post("restart", reply=answer_to(event))

        @server.on_client_connect
        def _(client: viser.ClientHandle) -> None:
            self._look.place_camera(client, "iso")

    def show(self, frame: Frame) -> None:
        """Write what has changed; without a client, nothing."""
        while not self._tasks.empty():
            self._tasks.get()()
        self._frames += 1
        if not self.server.get_clients():
            return
        with self.server.atomic():
            self._look.show(frame)
            levels = self._solid.levels
            self._solid.show(frame, self._look.look)
            if self._solid.levels is not None and self._solid.levels is not levels:
                label, _ = LABELS[self._look.look.field]
                self._bar.content = colour_bar_html(self._solid.levels, self._solid.colours, label)
            self._saving.show(frame)
            if self._frames % _WORDS_EVERY == 0:
                self._write_words(frame)
        # viser would wait for 1/60 s, and longer where it then finds the next frame half written.
        self.server.flush()

    def close(self) -> None:
        """Close the port and all connections."""
        self.server.stop()

    def _write_words(self, frame: Frame) -> None:
        for handle, html in ((self._title, title_html(frame.scene)), (self._status, status_html(frame)),
                             (self._readouts, readouts_html(frame))):
            if handle.content != html:
                handle.content = html
        stopped = frame.phase is Phase.DIED
        if self._restart.visible != stopped:
            self._restart.visible = stopped
        self._motion.show(frame)
        self._material.show(frame)
        self._calibration.show(frame)
        self._scene.show(frame)
        self._plots.show(frame)

    def _later(self, task: Callable[[], None]) -> None:
        self._tasks.put(task)

    def _set_dark(self, dark: bool) -> None:
        self.server.set_theme(dark_mode=dark)
        self._plots.set_dark(dark)
