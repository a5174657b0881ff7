"""Web page of the viewer, served to browsers by viser."""

from __future__ import annotations

import queue
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import viser

from scenes.field_labels import LABELS
from scenes.viewer.bands import colour_bar_html
from scenes.viewer.frame import CommandReceiver, Phase, SessionFrame
from scenes.viewer.page.calibration_controls import CalibrationControls
from scenes.viewer.page.curve_plots import CurvePlots
from scenes.viewer.page.motion_controls import MotionControls
from scenes.viewer.page.readouts import make_browser_reply_function, readouts_html, scene_title_html, status_html
from scenes.viewer.page.saving import SaveControls
from scenes.viewer.page.scene_controls import MaterialControls, SceneControls
from scenes.viewer.page.solid import ScenePicture
from scenes.viewer.page.view_controls import ViewControls
from scenes.viewer.web_server import LOOPBACK, SERVER, open_viewer_server


@dataclass(frozen=True)
class PageUpdateAndPanelSettings:
    """Rate of updates and width of the page.

    Attributes:
        update_interval: Number of frames between two updates of the plots, read-outs and controls.
        panel_width: Width of each side panel, pixels.
    """

    update_interval: int = 3
    panel_width: int = 380


_SETTINGS = PageUpdateAndPanelSettings()


class Page:
    """Web page that displays the frames of a session and posts the commands of its users; call `close` at the end.

    Args:
        session: Receives the commands of the users.
        frame: First frame, from which the controls take their initial values.
        materials: Folder from which material files are listed and into which they are saved.
        host, port, exposed, token: As in `scenes.viewer.web_server.open_viewer_server`.
        low_graphics: Draw fewer segments, for browsers that render without a graphics card.
        dark: Start with the dark colour scheme.

    Attributes:
        server: The viser server, for tests.

    Raises:
        InputError: The port is in use, the host is invalid, or the folder does not exist.
    """

    def __init__(self, session: CommandReceiver, frame: SessionFrame, materials: Path, *, host: str = LOOPBACK,
                 port: int = SERVER.port, exposed: bool = False, token: str = "", low_graphics: bool = False,
                 dark: bool = False):
        self._frames = 0
        self._tasks: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self.server = server = open_viewer_server(host, port, exposed=exposed, token=token)
        try:
            self._add_controls(session, frame, materials, low_graphics, dark)
        except BaseException:
            server.stop()
            raise

    def _add_controls(self, session: CommandReceiver, frame: SessionFrame, materials: Path, low_graphics: bool,
                      dark: bool) -> None:
        """Add the picture, the texts, the control tabs and the plots to the page, and connect their callbacks."""
        server, gui = self.server, self.server.gui
        self._solid = ScenePicture(server, frame.scene, low_graphics=low_graphics)
        self._solid.register_drag_callback(lambda depth, across, reply: session.post(
            "aim", reply=reply, depth=depth, **({} if across is None else {"across": across})))
        self._title = gui.add_html(scene_title_html(frame.scene))
        self._status = gui.add_html(status_html(frame))
        self._restart = gui.add_button("Restart", icon=viser.Icon.REFRESH, color="red", visible=False)
        self._readouts = gui.add_html(readouts_html(frame))
        self._bar = gui.add_html("")
        tabs = gui.add_tab_group()
        with tabs.add_tab("Motion"):
            self._motion = MotionControls(server, session, frame)
            self._motion.on_drag_mode = self._solid.set_drag_direction
        with tabs.add_tab("Material"):
            self._material = MaterialControls(server, session, frame, materials)
        with tabs.add_tab("Calibrate"):
            self._calibration = CalibrationControls(server, session, frame, materials)
        with tabs.add_tab("Scene"):
            self._scene = SceneControls(server, session, frame)
        with tabs.add_tab("View"):
            self._look = ViewControls(server, frame, self._solid.scale)
        with tabs.add_tab("Save"):
            self._saving = SaveControls(server, self._solid, self._look, self._tasks.put)
        curves = gui.add_panel()
        with curves.add_tab("Curves"):
            self._plots = CurvePlots(server, session, frame)
        self._look.on_dark = self._apply_colour_scheme
        self._look.set_colour_scheme(dark)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(_SETTINGS.panel_width)
        curves.dock_left()
        curves.set_width(_SETTINGS.panel_width)

        @self._restart.on_click
        def restart_simulation_on_click(event: viser.GuiEvent) -> None:
            """Post the command that restarts the simulation."""
            session.post("restart", reply=make_browser_reply_function(event))

        @server.on_client_connect
        def set_camera_on_connect(client: viser.ClientHandle) -> None:
            """Set the preset view "iso" for a new browser."""
            self._look.move_camera_to_preset(client, "iso")

    def show(self, frame: SessionFrame) -> None:
        """Send the changes since the last frame to the browsers; without a connected browser, send nothing."""
        while not self._tasks.empty():
            self._tasks.get()()
        self._frames += 1
        if not self.server.get_clients():
            return
        with self.server.atomic():
            self._look.update_controls(frame)
            levels = self._solid.levels
            self._solid.draw_frame(frame, self._look.options)
            if self._solid.levels is not None and self._solid.levels is not levels:
                label, _ = LABELS[self._look.options.field]
                self._bar.content = colour_bar_html(self._solid.levels, self._solid.colours, label)
            self._saving.keep_frame_and_record_replay(frame)
            if self._frames % _SETTINGS.update_interval == 0:
                self._update_texts_and_controls(frame)
        # Without the flush viser waits 1/60 s, and longer if the next frame is then incomplete.
        self.server.flush()

    def close(self) -> None:
        """Stop the server and close all connections."""
        self.server.stop()

    def _update_texts_and_controls(self, frame: SessionFrame) -> None:
        """Update the texts, the controls of all tabs and the plots."""
        for handle, html in ((self._title, scene_title_html(frame.scene)), (self._status, status_html(frame)),
                             (self._readouts, readouts_html(frame))):
            if handle.content != html:
                handle.content = html
        stopped = frame.phase is Phase.DIED
        if self._restart.visible != stopped:
            self._restart.visible = stopped
        self._motion.update_controls(frame)
        self._material.update_controls(frame)
        self._calibration.update_controls(frame)
        self._scene.update_controls(frame)
        self._plots.update_plots(frame)

    def _apply_colour_scheme(self, dark: bool) -> None:
        """Select the dark or the light colour scheme of the page and its plots."""
        self.server.set_page_theme(dark_mode=dark)
        self._plots.set_colour_scheme_of_next_update(dark)
