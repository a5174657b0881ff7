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


def readouts_html(frame: Frame) -> str:
    """Force and depth large, the rest in a small table."""
    now = frame.readouts
    large = [("force", "force", "–" if now is None else _number(now.force, 3), "N"),
             ("depth", "depth", "–" if now is None else _number(now.depth * 1e3, 2), "mm")]
    small = [("stiffness", "tissue stiffness", "–" if now is None else f"{_number(now.stiffness * 1e-3, 3)} N/mm"),
             ("step-time", "step", "–" if now is None else f"{now.step_time * 1e3:.2f} ms"),
             ("iterations", "iterations", "–" if now is None else f"{now.iterations:.1f} per tick"),
             ("rate", "loop", "–" if now is None else f"{now.rate:.0f} Hz"),
             ("late", "late ticks", "–" if now is None else f"{now.late * 100:.2f} %"),
             ("solution", "tissue", "–" if now is None else now.status),
             ("mesh", "mesh", "–" if now is None else now.mesh or "–")]
    cells = "".join(f'<div style="flex:1"><div style="font-size:0.75em;opacity:0.7">{label}</div>'
                    f'<div style="font-size:1.7em;font-weight:600;font-variant-numeric:tabular-nums">'
                    f'<span data-testid="{key}">{value}</span> <span style="font-size:0.6em">{unit}</span></div></div>'
                    for key, label, value, unit in large)
    rows = "".join(f'<tr><td style="opacity:0.7;padding-right:1em;white-space:nowrap">{label}</td>'
                   f'<td data-testid="{key}" style="font-variant-numeric:tabular-nums">{escape(value)}</td></tr>'
                   for key, label, value in small)
    return (f'<div style="padding:0.3em 0.75em"><div style="display:flex">{cells}</div>'
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
        return f'<div style="padding:0.2em 0.75em" data-testid="agreement">{words}</div>'
    return (f'<div style="padding:0.2em 0.75em;font-size:0.85em;opacity:0.8" data-testid="agreement">{escape(words)}'
            "</div>")


def _number(value: float, decimals: int) -> str:
    """Without the sign of a zero."""
    return f"{round(value, decimals) + 0.0:.{decimals}f}"
