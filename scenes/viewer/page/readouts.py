"""HTML texts of the page: title, status, read-outs, agreement with the measurement, and notifications.

The difference between the live force and the model curve is shown with its likely causes. Notifications and file
downloads go to the browser whose user issued a command.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from html import escape
from typing import Literal, TypeVar

import numpy as np
import viser

from scenes.viewer.frame import Phase, SessionFrame
from scenes.viewer.scene import Scene
from scenes.viewer.trace import Trace
from tissue_sim.experiment.tools.tool import list_all_tool_sizes_by_key
from tissue_sim.specimen.cylinder import Cylinder

Pair = tuple[np.ndarray, np.ndarray]
#: Speed below which the tool counts as standing, m/s.
_STANDING_SPEED = 1e-5


@dataclass(frozen=True)
class LargestLiveModelDifference:
    """Largest difference between the live force and the model curve.

    Attributes:
        force: Live force minus model force, N.
        depth: Depth of the largest difference, m.
        speed: Median speed of the moving tool in the newest loading and unloading, m/s.
        late_fraction: Fraction of the points of these branches whose force late ticks extrapolated.
        inertia_fraction: Fraction of these points at which the inertia of the tissue was included.
    """

    force: float
    depth: float
    speed: float
    late_fraction: float
    inertia_fraction: float


def find_largest_live_model_difference(trace: Trace, grid: np.ndarray, live: Pair,
                                       model: Pair) -> LargestLiveModelDifference | None:
    """Compute the largest difference between the live force and the model curve.

    Args:
        trace: Motion and force of the run.
        grid: Depths, m, shape (n,).
        live: Live loading and unloading force on the grid, N, each of shape (n,), NaN where missing.
        model: Loading and unloading force of the model on the grid, N, each of shape (n,), NaN where missing.

    Returns:
        The difference; None if the curves do not overlap.
    """
    gaps = np.concatenate([live_force - model_force for live_force, model_force in zip(live, model, strict=True)])
    if not np.isfinite(gaps).any():
        return None
    worst = int(np.nanargmax(np.abs(gaps)))
    branches = [each for each in trace.get_newest_loading_and_unloading() if each is not None]
    speeds = np.concatenate([np.abs(np.diff(each.depth) / np.diff(each.time)) for each in branches]) \
        if branches else np.zeros(1)
    moving = speeds[speeds > _STANDING_SPEED]
    is_late, includes_inertia = (np.concatenate([getattr(each, name) for each in branches]) if branches
                                 else np.zeros(1) for name in ("is_late", "includes_inertia"))
    return LargestLiveModelDifference(float(gaps[worst]), float(grid[worst % grid.size]),
                                      float(np.median(moving)) if moving.size else 0.0,
                                      float(is_late.mean()), float(includes_inertia.mean()))


def select_forces_of_late_ticks_on_grid(trace: Trace, grid: np.ndarray) -> np.ndarray:
    """Return the forces of the newest loading and unloading that late ticks extrapolated.

    Args:
        trace: Motion and force of the run.
        grid: Equally spaced depths, m, shape (n,).

    Returns:
        Force at the grid depth nearest to each such point, N, shape (n,); NaN elsewhere.
    """
    forces = np.full(grid.size, np.nan)
    for branch in trace.get_newest_loading_and_unloading():
        if branch is not None:
            depth, force = branch.depth[branch.is_late], branch.force[branch.is_late]
            inside = (depth >= grid[0]) & (depth <= grid[-1])
            nearest = np.rint((depth[inside] - grid[0]) / (grid[1] - grid[0])).astype(int)
            forces[nearest] = force[inside]
    return forces


Value = TypeVar("Value")
#: Function that receives None when a command has been executed, or a sentence with the reason for its refusal.
Reply = Callable[[str | None], None]
#: Title of a notification about a command that was refused.
FAILED = "Not done"


def assign_control_value(control: viser.GuiInputHandle[Value], value: Value) -> None:
    """Assign a value to a control of the page."""
    # viser defines the setter apart from the getter, so type checkers see a read-only property.
    control.value = value  # type: ignore[misc]


def make_browser_reply_function(event: viser.GuiEvent | viser.SceneNodeDragEvent, done: str = "") -> Reply:
    """Return a reply function that notifies the browser of an event.

    Args:
        event: Event of the browser.
        done: Sentence to show when the command has been executed; empty: show nothing.
    """
    client = event.client

    def notify_of_outcome(problem: str | None) -> None:
        if problem is not None:
            notify_browser_unless_none(client, FAILED, problem, "red")
        elif done:
            notify_browser_unless_none(client, "Done", done, "teal")

    return notify_of_outcome


def notify_browser_unless_none(client: viser.ClientHandle | None, title: str, sentence: str,
                               colour: Literal["red", "teal"]) -> None:
    """Show a notification in a browser for 12 s; do nothing if `client` is None."""
    if client is not None:
        client.add_notification(title, sentence, color=colour, auto_close_seconds=12.0)


def send_download(client: viser.ClientHandle | None, name: str, content: bytes) -> None:
    """Make a browser download a file without asking; do nothing if `client` is None."""
    if client is not None:
        client.send_file_download(name, content, save_immediately=True)


#: Colour of the dot that shows each phase.
_DOTS = {Phase.STARTING: "#E69F00", Phase.RUNNING: "#009E73", Phase.PAUSED: "#0072B2", Phase.DIED: "#D55E00"}
#: Label of each kind of motion.
_MOTIONS = {"hand": "by hand", "protocol": "protocol", "recording": "measured motion", "device": "device"}


def scene_title_html(scene: Scene) -> str:
    """Return HTML of three lines: test and specimen, tool and interface, material and its source."""
    experiment = scene.experiment
    specimen, tool, friction = experiment.specimen, experiment.tool, experiment.friction
    body = (f"cylinder \u2300 {2e3 * specimen.radius:g} \u00d7 {1e3 * specimen.height:g} mm"
            if isinstance(specimen, Cylinder) else f"{specimen.shape}, {specimen.in_words}")
    sizes = []
    for key, (declaration, name, shapes) in list_all_tool_sizes_by_key().items():
        words, _, unit = key.rpartition("_")
        if tool.shape in shapes and getattr(tool, name):
            sizes.append(f"{words.replace('_', ' ')} {getattr(tool, name) / declaration.factor:.4g} {unit}")
    interface = friction if isinstance(friction, str) else f"friction {friction:g}"
    tool_line = f"{interface} plates" if tool.is_plate else ", ".join([tool.shape, *sizes, interface])
    lines = (f"<b>{escape(scene.kind.title)}</b>, {body}", escape(tool_line),
             f"{escape(scene.material.energy_law.title)}, {escape(scene.source)}")
    return ('<div data-testid="title" style="padding:0.4em 0.75em 0 0.75em;font-size:0.82em;line-height:1.35">'
            + "<br/>".join(lines) + "</div>")


def status_html(frame: SessionFrame) -> str:
    """Return HTML with the phase of the simulation, the kind of motion, and the message of the frame in a box."""
    words = frame.phase.value
    if frame.phase in (Phase.RUNNING, Phase.PAUSED):
        words += f" · {_MOTIONS[frame.motion]}"
    dot = (f'<span style="display:inline-block;width:0.7em;height:0.7em;border-radius:50%;margin-right:0.5em;'
           f'background:{_DOTS[frame.phase]}"></span>')
    lines = [f'<div data-testid="phase" data-phase="{frame.phase.name.lower()}" style="font-weight:600">{dot}'
             f'{escape(words)}</div>']
    if frame.message and frame.message not in ("running", frame.phase.value):
        border = "#D55E00" if frame.phase is Phase.DIED else "#8888"
        lines.append(f'<div data-testid="message" style="border-left:3px solid {border};padding-left:0.6em;'
                     f'margin-top:0.4em;font-size:0.85em">{escape(frame.message)}</div>')
    return f'<div style="padding:0.5em 0.75em 0 0.75em">{"".join(lines)}</div>'


#: Definition of each read-out, shown as a tooltip.
_MEANING = {
    "force": "force of the tissue on the tool along z; positive when the tool pushes into the tissue",
    "depth": "displacement of the tool from the undeformed surface; positive into the tissue",
    "across": "components of the force along x and y, for a solid in 3D",
    "stiffness": "derivative of the static tissue force with respect to depth, without the inertia of the tissue",
    "step-time": "wall time of one step of the solver, median over the last 0.5 s",
    "iterations": "linear solves per tick, mean over the last 0.5 s",
    "rate": "ticks per second of the loop that steps the tissue",
    "late": "percentage of all ticks since the start that began late or were missed by the clock",
    "solution": "status of the newest force",
    "doubtful": "number of ticks of the last second whose force is not an accurate equilibrium force",
    "mesh": "resolution of the mesh, and the largest known error of the force on it",
}
#: Colour of warnings.
_RED = "#C0392B"
#: Colour of outdated numbers.
_GREY = "#777777"
#: Fraction of the points above which a cause of the gap is named.
_NAMED_FRACTION = 0.0005


def _badge_with_tooltip_html(word: str, meaning: str, colour: str) -> str:
    """Return HTML of a highlighted word with a tooltip, in the upper right corner of its container.

    The word takes no space: controls below it stay in place when it appears, so that a click does not miss them.
    """
    return (f'<div data-testid="badge" title="{escape(meaning, quote=True)}" style="position:absolute;top:0;right:0;'
            f'font-size:0.8em;padding:0 0.6em;border-radius:0.3em;color:white;font-weight:600;'
            f'background:{colour}">{escape(word)}</div>')


def readouts_html(frame: SessionFrame) -> str:
    """Return HTML with force and depth in large digits and the other read-outs in a table."""
    now, stale = frame.readouts, frame.phase is Phase.DIED
    large = [("force", "force", "–" if now is None else _format_fixed_without_minus_zero(now.force, 3), "N"),
             ("depth", "depth", "–" if now is None else _format_fixed_without_minus_zero(now.depth * 1e3, 2), "mm")]
    small = [("stiffness", "tissue stiffness",
              "–" if now is None else f"{_format_fixed_without_minus_zero(now.stiffness * 1e-3, 3)} N/mm"),
             ("step-time", "step time", "–" if now is None else f"{now.step_time * 1e3:.2f} ms"),
             ("iterations", "iterations", "–" if now is None else f"{now.iterations:.1f} per tick"),
             ("rate", "loop rate", "–" if now is None else f"{now.rate:.0f} Hz"),
             ("late", "late or missed ticks", "–" if now is None else f"{now.late * 100:.2f} %"),
             ("solution", "force status", "–" if now is None else now.status),
             ("doubtful", "ticks not converged", "–" if now is None else f"{now.unconverged} in the last second"),
             ("mesh", "mesh", "–" if now is None else now.mesh or "–")]
    if frame.snapshot is not None and frame.snapshot.is_three_dimensional:
        small.insert(0, ("across", "force along x and y", "–" if now is None else
                         " and ".join(f"{_format_fixed_without_minus_zero(part, 3)} N" for part in now.across)))
    badge = ""
    if stale and now is not None:
        badge = _badge_with_tooltip_html("old", "The simulation has stopped. These are its last numbers.", _GREY)
    elif now is not None and now.warning:
        badge = _badge_with_tooltip_html(now.status.upper(), now.warning, _RED)
    cells = "".join(f'<div style="flex:1" title="{_MEANING[key]}">'
                    f'<div style="font-size:0.75em;opacity:0.7">{label}</div>'
                    f'<div style="font-size:1.7em;font-weight:600;font-variant-numeric:tabular-nums">'
                    f'<span data-testid="{key}">{value}</span> <span style="font-size:0.6em">{unit}</span></div></div>'
                    for key, label, value, unit in large)
    rows = "".join(f'<tr title="{_MEANING[key]}">'
                   f'<td style="opacity:0.7;padding-right:1em;white-space:nowrap">{label}</td>'
                   f'<td data-testid="{key}" style="font-variant-numeric:tabular-nums">{escape(value)}</td></tr>'
                   for key, label, value in small)
    faded = ";opacity:0.45" if stale else ""
    return (f'<div style="padding:0.3em 0.75em{faded}"><div style="display:flex;position:relative">{cells}{badge}</div>'
            f'<table style="font-size:0.8em;margin-top:0.3em;border-collapse:collapse">{rows}</table></div>')


def model_rmse_html(frame: SessionFrame) -> str:
    """Return HTML with the RMSE between model and measurement over the whole test, or why there is none."""
    curves = frame.curves
    if curves.measurement is None:
        words = ("This scene has no measurement. Upload recordings in the tab Calibrate, or start the viewer with "
                 "--measured FILE.")
    elif curves.residual is None:
        words = "The model curve is being computed."
    else:
        gap, noise = curves.residual, curves.measurement.replicate_force_rms_scatter
        spread = "" if noise is None else f", noise {noise:.3f} N"
        words = (f'<span title="RMSE: root mean square of model minus measurement; noise: standard deviation of the '
                 f'replicates">'
                 f'<span style="font-size:1.15em;font-weight:600">RMSE <span data-testid="rmse">{gap.rmse:.3f}</span> '
                 f"N</span> over {gap.samples} samples{spread}</span>")
        if curves.computing:
            words = (f'<span data-testid="old-curve" style="opacity:0.5">{words}</span> '
                     f'<span style="color:{_RED};font-size:0.85em">of the previous model; the new curve is being '
                     "computed</span>")
        other = curves.measurement.describe_deviating_tool_or_empty(frame.scene.experiment.tool)
        warning = "" if not other else (
            f'<div data-testid="other-tool" style="color:{_RED};font-size:0.85em">measured with another tool: '
            f'{escape(other)}</div>')
        return f'<div style="padding:0 0.75em;font-size:0.9em" data-testid="agreement">{words}{warning}</div>'
    return (f'<div style="padding:0.2em 0.75em;font-size:0.85em;opacity:0.8" data-testid="agreement">{escape(words)}'
            "</div>")


def largest_live_model_difference_html(gap: LargestLiveModelDifference | None) -> str:
    """Return HTML with the largest difference of live force and model curve, and its causes; empty for None."""
    if gap is None:
        return ""
    reasons = []
    if gap.inertia_fraction > _NAMED_FRACTION:
        reasons.append(f"at {gap.speed * 1e3:.2g} mm/s the inertia of the tissue contributes")
    if gap.late_fraction > _NAMED_FRACTION:
        reasons.append(f"{gap.late_fraction:.1%} of the points are extrapolated by late ticks (grey)")
    words = f"live \u2212 model: up to {_format_fixed_without_minus_zero(gap.force, 3)} N at {gap.depth * 1e3:.3g} mm"
    return ('<div data-testid="live-gap" title="The live force is computed on a coarser mesh than the model curve." '
            f'style="padding:0 0.75em;font-size:0.75em">{escape("; ".join([words, *reasons]))}</div>')


def _format_fixed_without_minus_zero(value: float, decimals: int) -> str:
    """Format a number with fixed decimals, without a minus sign before zero."""
    return f"{round(value, decimals) + 0.0:.{decimals}f}"
