"""What the page says in numbers and words."""

from __future__ import annotations

from html import escape

from scenes.viewer.frame import Frame, Phase
from scenes.viewer.live_gap import LiveGap
from scenes.viewer.scene import Scene
from tissue_sim.experiment.tools.tool import tool_sizes
from tissue_sim.specimen.cylinder import Cylinder

#: Phase -> colour of its dot.
_DOTS = {Phase.STARTING: "#E69F00", Phase.RUNNING: "#009E73", Phase.PAUSED: "#0072B2", Phase.DIED: "#D55E00"}
_WORDS = {"hand": "by hand", "protocol": "protocol", "recording": "measured motion", "device": "device"}


def title_html(scene: Scene) -> str:
    """What is looked at, in two lines: test and specimen, tool and material."""
    experiment = scene.experiment
    specimen, tool, held = experiment.specimen, experiment.tool, experiment.friction
    body = (f"cylinder \u2300 {2e3 * specimen.radius:g} \u00d7 {1e3 * specimen.height:g} mm"
            if isinstance(specimen, Cylinder) else f"{specimen.shape}, {specimen.in_words}")
    sizes = []
    for key, (what, name, shapes) in tool_sizes().items():
        words, _, unit = key.rpartition("_")
        if tool.shape in shapes and getattr(tool, name):
            sizes.append(f"{words.replace('_', ' ')} {getattr(tool, name) / what.factor:.4g} {unit}")
    face = held if isinstance(held, str) else f"friction {held:g}"
    of_tool = f"{face} plates" if tool.is_plate else ", ".join([tool.shape, *sizes, face])
    lines = (f"<b>{escape(scene.kind.title)}</b>, {body}", escape(of_tool),
             f"{escape(scene.material.energy_law.title)}, {escape(scene.source)}")
    return ('<div data-testid="title" style="padding:0.4em 0.75em 0 0.75em;font-size:0.82em;line-height:1.35">'
            + "<br/>".join(lines) + "</div>")


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
    "across": "force along x and along y: of tissue in space, off its axis or under a tool that leans or slides",
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
#: Share of the points that is worth a reason.
_SOME = 0.0005


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
    if frame.snapshot is not None and frame.snapshot.in_space:
        small.insert(0, ("across", "force across", "–" if now is None else
                         " and ".join(f"{_number(part, 3)} N" for part in now.across)))
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
        words = ("Nothing was measured in this scene: upload recordings under Calibrate, or start the viewer with "
                 "--measured FILE.")
    elif curves.residual is None:
        words = "The model's curve is being computed."
    else:
        gap, noise = curves.residual, curves.measurement.noise
        spread = "" if noise is None else f", noise {noise:.3f} N"
        words = (f'<span title="model minus measurement, root mean square; noise: by which replicates differ">'
                 f'<span style="font-size:1.15em;font-weight:600">RMSE <span data-testid="rmse">{gap.rmse:.3f}</span> '
                 f"N</span> over {gap.samples} samples{spread}</span>")
        if curves.computing:
            words = (f'<span data-testid="old-curve" style="opacity:0.5">{words}</span> '
                     f'<span style="color:{_RED};font-size:0.85em">of the model before; the new one is being computed'
                     "</span>")
        other = curves.measurement.other_tool(frame.scene.experiment.tool)
        warning = "" if not other else (
            f'<div data-testid="other-tool" style="color:{_RED};font-size:0.85em">measured with another tool: '
            f'{escape(other)}</div>')
        return f'<div style="padding:0 0.75em;font-size:0.9em" data-testid="agreement">{words}{warning}</div>'
    return (f'<div style="padding:0.2em 0.75em;font-size:0.85em;opacity:0.8" data-testid="agreement">{escape(words)}'
            "</div>")


def live_gap_html(gap: LiveGap | None) -> str:
    """By how much what was felt differs from the model, and what the model does not have."""
    if gap is None:
        return ""
    reasons = []
    if gap.inertial > _SOME:
        reasons.append(f"at {gap.speed * 1e3:.2g} mm/s the tissue's mass counts")
    if gap.late > _SOME:
        reasons.append(f"{gap.late:.1%} carried on by late ticks (grey)")
    words = f"live \u2212 model: up to {_number(gap.force, 3)} N at {gap.depth * 1e3:.3g} mm"
    return ('<div data-testid="live-gap" title="live is felt on a coarser mesh than the model is computed on" '
            f'style="padding:0 0.75em;font-size:0.75em">{escape("; ".join([words, *reasons]))}</div>')


def _number(value: float, decimals: int) -> str:
    """Without the sign of a zero."""
    return f"{round(value, decimals) + 0.0:.{decimals}f}"
