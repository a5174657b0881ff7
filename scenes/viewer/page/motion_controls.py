"""Controls of the motion: where the tool goes, and whether it goes."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import viser

from scenes.viewer.frame import Commands, Frame, Phase
from scenes.viewer.page.notices import answer_to, set_value
from scenes.viewer.page.solid import DRAGS
from scenes.viewer.scene import Scene

#: Ready-made protocols by what they are called; {depth} is the scene's largest, in mm.
PROTOCOLS = {
    "press and release": "approach 2mm; ramp {depth}mm; hold 1s; unload; retract 2mm",
    "three cycles": "repeat 3 (ramp {depth}mm; unload)",
    "step and hold": "ramp {depth}mm @100mm/s; hold 5s; unload",
    "study, 0.248 mm/s": "ramp {depth}mm @0.248mm/s; hold 10s; unload @0.248mm/s",
}


def _example(name: str, scene: Scene) -> str:
    """A ready-made protocol; it does not lift a tool that cannot be."""
    parts = PROTOCOLS[name].format(depth=f"{scene.deepest * 1e3:g}").split("; ")
    return "; ".join(part for part in parts if scene.highest < 0.0 or not part.startswith(("approach", "retract")))


def _in_steps(reach: tuple[float, float]) -> tuple[float, float]:
    """A range of a slider, mm in steps of 0.01, within one in m; one step where that is narrower."""
    low, high = math.ceil(1e5 * reach[0] - 1e-6) / 100, math.floor(1e5 * reach[1] + 1e-6) / 100
    return min(low, high), max(low, high)


class FollowedSlider:
    """A slider in mm that people move, and that follows the tool where somebody else moves that.

    Attributes:
        slider: viser's.
    """

    def __init__(self, slider: viser.GuiSliderHandle[float]):
        self.slider = slider
        #: What was entered or written last. viser takes a value before it tells of it: another one is news to come.
        self._known = slider.value

    def on_entry(self, go: Callable[[viser.GuiEvent], None]) -> None:
        """Call this for each value that people enter, not for what the program has written."""

        @self.slider.on_update
        async def _(event: viser.GuiEvent) -> None:  # a coroutine: it runs before another value is written
            if event.client is not None:
                self._known = self.slider.value
                go(event)

    def clipped(self, place: float) -> float:
        """The nearest place in its range, mm."""
        return min(max(place, self.slider.min), self.slider.max)

    def follow(self, place: float) -> None:
        """Show a place of the tool, mm. A number outside of the range that somebody types stays while its last digit
        may be missing, where the tool has gone as far as it can: the field names the end that was gone to."""
        if self.slider.value == self._known and abs(place - self.clipped(self._known)) >= 0.01:
            self._known = place
            set_value(self.slider, place)


class MotionControls:
    """The tab with depth, play, pause, reset, step, and the protocol."""

    def __init__(self, server: viser.ViserServer, session: Commands, frame: Frame):
        gui, deepest = server.gui, frame.scene.deepest
        examples = {name: _example(name, frame.scene) for name in PROTOCOLS}
        self._session, self._paused, self._plays = session, False, False
        #: Depths that people have entered, and those of them that the session has obeyed.
        self._entered = self._obeyed = 0
        #: Where the next key goes on from, mm.
        self._aimed = 0.0
        self._depth = FollowedSlider(gui.add_slider(
            "depth [mm]", min=frame.scene.highest * 1e3, max=deepest * 1e3, step=0.01, initial_value=0.0,
            hint="or drag the tool; keys: PageDown and PageUp, with Shift ten times as far"))
        #: Of tissue in space.
        self._across = [FollowedSlider(gui.add_slider(
            f"{name} [mm]", min=low, max=high, step=0.01, initial_value=min(max(round(1e3 * place, 2), low), high),
            visible=False, hint="where the tool's axis meets the height of the touch"))
            for name, place, (low, high) in zip("xy", frame.across, map(_in_steps, frame.scene.reach), strict=True)]
        self._drags = gui.add_dropdown("mouse moves it", tuple(DRAGS), visible=False)
        self.on_drag_way: Callable[[str], None] = lambda _: None
        self._buttons = gui.add_button_group("run", ("Play", "Pause", "Step", "Reset"),
                                              hint="keys: P plays or pauses, N is a step, R resets; Ctrl+K lists all")
        self._source = gui.add_dropdown("motion", self._sources(frame), initial_value="protocol")
        self._named = gui.add_dropdown("example", tuple(PROTOCOLS), initial_value="press and release")
        self._text = gui.add_text("protocol", examples["press and release"],
                                  hint="approach 2mm; ramp 10mm @5mm/s; hold 60s; unload; repeat 3 (ramp 5mm; unload)")
        self._speed = gui.add_number("speed [mm/s]", 5.0, min=0.01, max=200.0, step=0.01,
                                     hint="where the protocol states none")
        self._repeat = gui.add_checkbox("repeat", False)
        self._faster = gui.add_number("times as fast", 10.0, min=0.1, max=1000.0, step=0.1, visible=False,
                                      hint="tissue that relaxes answers otherwise when it is pressed faster")

        #: Why a depth was refused the last time: a slider that is dragged asks many times.
        self._refusal: str | None = None

        self._depth.on_entry(lambda event: self._go(self._depth.slider.value, event))
        for one in self._across:
            one.on_entry(self._go_across)

        @self._drags.on_update
        def _(_: viser.GuiEvent) -> None:
            self.on_drag_way(self._drags.value)

        for key, way, words in (("pagedown", 0.1, "deeper"), ("pageup", -0.1, "up")):
            self._key(gui, f"0.1 mm {words}", key, partial(self._go_on, way))
            self._key(gui, f"1 mm {words}", key, partial(self._go_on, 10 * way), modifier="shift")
        self._key(gui, "Play or pause", "P", lambda event: self._press("Pause" if self._plays else "Play", event))
        self._key(gui, "Step", "N", lambda event: self._press("Step", event))
        self._key(gui, "Reset", "R", lambda event: self._press("Reset", event))

        @self._buttons.on_click
        def _(event: viser.GuiEvent) -> None:
            self._press(self._buttons.value, event)

        @self._named.on_update
        def _(event: viser.GuiEvent) -> None:
            if event.client is not None:
                set_value(self._text, examples[self._named.value])

        @self._source.on_update
        def _(_: viser.GuiEvent) -> None:
            measured = self._source.value != "protocol"
            for handle in (self._named, self._text, self._speed, self._repeat):
                handle.visible = not measured
            self._faster.visible = measured

    @staticmethod
    def _key(gui: viser.GuiApi, label: str, key: Any, act: Callable[[Any], None], modifier: Any = None) -> None:
        """A key of the keyboard, also found by its label in the list that Ctrl+K opens."""
        gui.add_command(label, hotkey=key, modifier=modifier).on_trigger(act)

    def _go_on(self, way: float, event: Any) -> None:
        self._go(self._aimed + way, event)

    def _go(self, depth: float, event: Any) -> None:
        """Let the tool go to a depth, mm."""
        self._aimed = self._depth.clipped(depth)
        self._ask(event, depth=self._aimed * 1e-3)

    def _go_across(self, event: Any) -> None:
        x, y = (one.clipped(one.slider.value) * 1e-3 for one in self._across)
        self._ask(event, across=(x, y))

    def _ask(self, event: Any, **place: Any) -> None:
        """Let the tool go to a place, as `Session.aim` takes it."""
        tell = answer_to(event)

        def obeyed(problem: str | None) -> None:
            self._obeyed += 1
            if problem is not None and problem != self._refusal:
                tell(problem)
            self._refusal = problem

        self._entered += 1
        self._session.post("aim", reply=obeyed, **place)

    @staticmethod
    def _sources(frame: Frame) -> tuple[str, ...]:
        return ("protocol",) if frame.scene.measurement is None else ("protocol", "measured motion")

    def _press(self, button: str, event: viser.GuiEvent) -> None:
        reply = answer_to(event)
        if button == "Play" and self._paused:
            self._session.post("resume", reply=reply)
        elif button == "Play" and self._source.value == "protocol":
            self._session.post("play", reply=reply, text=self._text.value, speed=self._speed.value * 1e-3,
                               repeat=self._repeat.value)
        elif button == "Play":
            self._session.post("replay", reply=reply, speed=self._faster.value)
        else:
            self._session.post(button.lower(), reply=reply)

    def show(self, frame: Frame) -> None:
        """Follow a tool that somebody else moves."""
        self._paused = frame.phase is Phase.PAUSED
        self._plays = not self._paused and frame.motion in ("protocol", "recording")
        sources = self._sources(frame)
        if self._source.options != sources:
            self._source.options = sources
        depth = frame.target if frame.motion == "hand" or frame.readouts is None else frame.readouts.depth
        depth = round(depth * 1e3, 2)
        in_space = (frame.snapshot is not None and frame.snapshot.in_space
                    and frame.scene.reach[0][0] < frame.scene.reach[0][1])
        for handle in (*(one.slider for one in self._across), self._drags):
            if handle.visible != in_space:
                handle.visible = in_space
        if self._entered == self._obeyed:  # What was entered a moment ago is newer than the frame.
            self._aimed = depth
            self._depth.follow(depth)
            for one, place in zip(self._across, frame.across, strict=True):
                one.follow(round(place * 1e3, 2))
