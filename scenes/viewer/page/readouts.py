"""What the page says in numbers and words."""

from __future__ import annotations

from html import escape

from scenes.viewer.frame import Frame, Phase

#: Phase -> colour of its dot.
_DOTS = {Phase.STARTING: "#E69F00", Phase.RUNNING: "#009E73", Phase.PAUSED: "#0072B2", Phase.DIED: "#D55E00"}
_WORDS = {"hand": "by hand", "protocol": "protocol", "recording": "measured motion", "device": "device"}


def status_html(frame: Frame) -> str:
    """The state of the simulation in a line, and in a box what to do where it has stopped."""
    words = frame.phase.value
    if frame.phase in (Phase.RUNNING, Phase.PAUSED):
        words += f" · {_WORDS[frame.motion]}"
    dot = (f'<span style="display:inline-block;width:0.7em;height:0.7em;border-radius:50%;margin-right:0.5em;'
           f'background:{_DOTS[frame.phase]}"></span>')
    lines = [f'<div data-testid="phase" data-phase="{frame.phase.name.lower()}" style="font-weight:600">{dot}'
             f'{escape(words)}</div>']
    if frame.message and frame.message not in ("running", frame.phase.value):
        border = "#D55E00" if frame.phase is Phase.DIED else "#8888"
        lines.append(f'<div data-testid="message" style="border-left:3px solid {border};padding-left:0.6em;'
                     f'margin-top:0.4em;font-size:0.85em">{escape(frame.message)}</div>')
    return f'<div style="padding:0.5em 0.75em 0 0.75em">{"".join(lines)}</div>'


#: What each number is, shown where the pointer rests on it.
_MEANING = {
    "force": "force of the tissue on the tool, along z; pushing in gives a positive one",
    "depth": "how far the tool is below the undeformed surface",
    "stiffness": "how the tissue's force grows with depth: what a hand feels, without the mass of the tissue",
    "step-time": "wall time of a step of the solver, median of the last half second",
    "iterations": "linear solutions a tick, mean of the last half second",
    "rate": "ticks a second of the loop that steps the tissue",
    "late": "share of all ticks so far that began late or were missed: the clock, not the tissue",
    "solution": "how the newest force came about",
    "doubtful": "ticks of the last second whose force is none of an equilibrium",
    "mesh": "of the tissue, and the largest known error of its force",
}
_RED, _GREY = "#C0392B", "#777777"


def _badge(word: str, meaning: str, colour: str) -> str:
    """A word that nobody misses."""
    return (f'<div data-testid="badge" title="{escape(meaning, quote=True)}" style="display:inline-block;'
            f'margin-top:0.2em;padding:0 0.6em;border-radius:0.3em;color:white;font-weight:600;'
            f'background:{colour}">{escape(word)}</div>')


def readouts_html(frame: Frame) -> str:
    """Force and depth large, the rest in a small table."""
    now, stale = frame.readouts, frame.phase is Phase.DIED
    large = [("force", "force", "–" if now is None else _number(now.force, 3), "N"),
             ("depth", "depth", "–" if now is None else _number(now.depth * 1e3, 2), "mm")]
    small = [("stiffness", "tissue stiffness", "–" if now is None else f"{_number(now.stiffness * 1e-3, 3)} N/mm"),
             ("step-time", "step", "–" if now is None else f"{now.step_time * 1e3:.2f} ms"),
             ("iterations", "iterations", "–" if now is None else f"{now.iterations:.1f} per tick"),
             ("rate", "loop", "–" if now is None else f"{now.rate:.0f} Hz"),
             ("late", "ticks not on time", "–" if now is None else f"{now.late * 100:.2f} %"),
             ("solution", "tissue", "–" if now is None else now.status),
             ("doubtful", "no equilibrium", "–" if now is None else f"{now.doubtful} in the last second"),
             ("mesh", "mesh", "–" if now is None else now.mesh or "–")]
    badge = ""
    if stale and now is not None:
        badge = _badge("old", "the simulation has stopped: these are its last numbers", _GREY)
    elif now is not None and now.warning:
        badge = _badge(now.status.upper(), now.warning, _RED)
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
    return (f'<div style="padding:0.3em 0.75em{faded}"><div style="display:flex">{cells}</div>{badge}'
            f'<table style="font-size:0.8em;margin-top:0.3em;border-collapse:collapse">{rows}</table></div>')


def agreement_html(frame: Frame) -> str:
    """How far the model is from the measurement, over the whole test."""
    curves = frame.curves
    if curves.measurement is None:
        words = "Nothing was measured in this scene: start the viewer with --measured FILE."
    elif curves.residual is None:
        words = "The model's curve is being computed."
    else:
        gap, noise = curves.residual, curves.measurement.noise
        spread = "" if noise is None else f", replicates differ by {noise:.3f} N"
        words = (f'<span style="font-size:1.3em;font-weight:600">RMSE <span data-testid="rmse">{gap.rmse:.3f}</span> '
                 f"N</span> over {gap.samples} samples{spread}")
        other = curves.measurement.other_tool(frame.scene.experiment.tool)
        warning = "" if not other else (
            f'<div data-testid="other-tool" style="color:{_RED};font-size:0.85em">measured with another tool: '
            f'{escape(other)}</div>')
        return f'<div style="padding:0.2em 0.75em" data-testid="agreement">{words}{warning}</div>'
    return (f'<div style="padding:0.2em 0.75em;font-size:0.85em;opacity:0.8" data-testid="agreement">{escape(words)}'
            "</div>")


def _number(value: float, decimals: int) -> str:
    """Without the sign of a zero."""
    return f"{round(value, decimals) + 0.0:.{decimals}f}"
