"""Pictures of a diagnosis: where model and data part, by how much, and what explains it. Each returns a figure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calibration.diagnosis.diagnosis import CandidateStatement, RegionGap
from calibration.diagnosis.evidence import Evidence
from calibration.fit.curves import TestCurves
from calibration.fit.fit import Region
from calibration.report.curve_figures import MISFIT, Abscissa, binned, draw_view
from calibration.report.drawing import COLOURS, legend_above, new_figure, panels
from calibration.report.rounding import gain_text, ratio_text
from calibration.report.units import Units
from calibration.report.views import Trace, is_timed, views

#: Without and with what was added: colour and dashes.
BEFORE: dict = {"color": MISFIT, "ls": (0, (5, 2))}
AFTER: dict = {"color": COLOURS[0], "ls": "-"}
#: Of residuals: means of so many bins over the course of a test.
_BINS = 60
#: Deviations from which on a region is no chance, and up to which the axis is linear.
_CALLED, _LINEAR = 1.96, 4.0
#: Width of a region's label, as a share of its panel.
_LABEL = 0.16
#: Inches of a row of bars, and of what stands around them.
_BAR, _AROUND = 0.3, 1.25


def curves_of(evidence: Evidence, name: str) -> TestCurves:
    """A fitted test as this evidence sees it, with the offset and zero of each recording; no bands."""
    problem = evidence.problem
    number = next(i for i, test in enumerate(problem.tests) if test.name == name)
    test, along = problem.tests[number], evidence.evaluation.force
    fitted = tuple(along[rows] for rows, (t, _) in zip(problem.rows, problem.places, strict=True) if t == number)
    first = test.measured[0]
    unknown = np.full(first.force.size, np.nan)
    return TestCurves(first.test, test.measured, first.time, first.displacement, fitted[0], unknown, unknown, unknown,
                      fitted, test.area)


def draw_gap(before: TestCurves, after: TestCurves | None, regions: Sequence[Region], gaps: Sequence[RegionGap],
             label: str, units: Units):
    """One test: recordings with the model before and after, against displacement and in holds, and the residuals.

    Args:
        before, after: the test without and with what was added. regions: of the test, before. gaps: the same before
            and after. label: of the model with what was added.
    """
    drawn = [(before, "model, nothing added", BEFORE)]
    if after is not None:
        drawn.insert(0, (after, f"model with {label}", AFTER))
    seen = views(before, units)
    timed = is_timed(before.measured)
    # Holds from near: what they lose is a small part of the whole course.
    shown = [seen[0], *(view for view in seen[1:] if view.log)]
    figure, axes = panels([len(shown) + 1], 3.4)
    for panel, view in zip(axes, shown, strict=False):
        draw_view(panel, drawn, view)
        # Recordings lie apart by their offsets and zeros: each has its own line.
        for curves, _, look in drawn:
            for m, fitted in zip(curves.measured[1:], curves.fitted[1:], strict=True):
                for along, force, _ in view.lines(replace(Trace.of(m), force=fitted)):
                    panel.plot(along, force, **look, lw=1.2, zorder=3)
    x = Abscissa(units.travel(before.test), units.load(before.test), timed, "time [s]" if timed else seen[0].x)
    spans = [(region, span) for region in regions if not region.adequate
             for span in x.spans(region, before.measured)]
    for panel in axes[-1:] if timed else (axes[0], axes[-1]):
        for _, (start, end) in spans:
            panel.axvspan(start, end, fc=MISFIT, alpha=0.09, lw=0, zorder=0)
            for edge in (start, end):
                panel.axvline(edge, color=MISFIT, alpha=0.3, lw=0.8, zorder=0)
    _draw_residuals(axes[-1], drawn, x)
    _write_sizes(axes[-1], spans, {gap.segment: gap for gap in gaps}, x)
    legend_above(figure)
    return figure


def _draw_residuals(axes, drawn, x: Abscissa) -> None:
    """Data minus model, means of bins: thin of each recording, thick of all; on the right in units of the noise."""
    measured = drawn[0][0].measured
    noise = float(np.sqrt(np.mean([m.noise.deviation**2 for m in measured]))) / x.load.size
    axes.axhspan(-noise, noise, color="0.6", alpha=0.22, lw=0, label="± noise of a sample")
    edges = np.linspace(min(x.of(m).min() for m in measured), max(x.of(m).max() for m in measured), _BINS + 1)
    reach = 1.5 * noise
    for curves, _, look in drawn:
        by_run: dict[int, list[np.ndarray]] = {}
        for m, fitted in zip(curves.measured, curves.fitted, strict=True):
            for run, (means, _) in enumerate(binned(m, (m.force - fitted) / x.load.size, x, edges)):
                by_run.setdefault(run, []).append(means)
                axes.plot(*means, color=look["color"], lw=0.6, alpha=0.4, zorder=2)
                reach = max(reach, float(np.abs(means[1][np.isfinite(means[1])]).max(initial=0.0)))
        for means in by_run.values():
            whole = np.stack(means)
            known = np.isfinite(whole[:, 1]).any(axis=0)
            axes.plot(*np.nanmean(whole[:, :, known], axis=0), **look, lw=2.0, zorder=4)
    axes.axhline(0.0, color="0.3", lw=0.8)
    axes.set(ylim=(-1.15 * reach, 1.4 * reach), title="Data − model", xlabel=x.label,
             ylabel=x.load.label("data − model"))
    right = axes.secondary_yaxis("right", functions=(lambda y: y / noise, lambda y: y * noise))
    right.set_ylabel("in units of the noise")
    right.spines["right"].set_visible(True)


def _write_sizes(axes, spans, gaps: dict[str, RegionGap], x: Abscissa) -> None:
    """Before and after of each region, where it is wide enough for it."""
    left, right = axes.get_xlim()
    for region, (start, end) in spans:
        gap = gaps.get(region.segment)
        if gap is None or end - start < _LABEL * (right - left):
            continue
        sizes = [x.load.text(size, 2) for size in (gap.before_N, gap.after_N) if size is not None]
        axes.text((start + end) / 2, 0.975, f"{region.segment}\n" + "\n→ ".join(sizes),
                  transform=axes.get_xaxis_transform(), ha="center", va="top", fontsize=8, color="#8a3c00", zorder=6)


def draw_evidence(regions: Sequence[RegionGap], units: Units):
    """How improbable the residuals of each region are, before and after."""
    figure = new_figure(12.0, _AROUND + _BAR * len(regions))
    axes = figure.subplots()
    places = -np.arange(len(regions), dtype=float)
    axes.axvspan(0, _CALLED, color="0.6", alpha=0.18, lw=0, label="chance")
    for place, region in zip(places, regions, strict=True):
        if region.after_sigma is not None:
            axes.plot([region.before_sigma, region.after_sigma], [place, place], color="0.75", lw=2, zorder=1)
    axes.plot([region.before_sigma for region in regions], places, "o", color=MISFIT, ms=8, ls="",
              label="nothing added", clip_on=False)
    if any(region.after_sigma is not None for region in regions):
        axes.plot([region.after_sigma for region in regions], places, "D", color=COLOURS[0], ms=6.5, ls="",
                  label="with what was added", clip_on=False)
    axes.set_xscale("symlog", linthresh=_LINEAR, linscale=1.5)
    largest = max([*(region.before_sigma for region in regions),
                   *(region.after_sigma or 0.0 for region in regions), 6.0])
    ticks = [tick for tick in (0, 1, 2, 3, 4, 10, 20, 50, 100, 200, 500, 1000, 10000) if tick < 1.3 * largest]
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.set(xlim=(0, 1.35 * largest), ylim=(places[-1] - 0.7, 0.7),
             xlabel="standard deviations of a normal distribution (linear up to 4, then logarithmic)")
    axes.set_yticks(places, [f"{region.test}, {_course(region)}" for region in regions])
    sizes = axes.secondary_yaxis("right")
    sizes.set_yticks(places, [_sizes(region, units) for region in regions])
    for side in (axes.yaxis, sizes.yaxis):
        side.set_tick_params(length=0, pad=9)
    legend_above(figure)
    return figure


def _course(region: RegionGap) -> str:
    """``ramp at 0.248 mm/s``."""
    return f"{region.segment} at {region.speed_mm_s:g} mm/s" if region.speed_mm_s else region.segment


def _sizes(region: RegionGap, units: Units) -> str:
    sizes = [units.force.text(size, 2) for size in (region.before_N, region.after_N) if size is not None]
    return " → ".join(sizes)


def draw_candidates(candidates: Sequence[CandidateStatement], names: Sequence[str], chosen: Sequence[str]):
    """What the data show of each effect before any fit with it, and how much better the fits with the likeliest are.

    Args:
        candidates: testable ones, best first. names: of each, for people. chosen: names of those that were added.
    """
    figure = new_figure(12.0, _AROUND + _BAR * len(candidates))
    score, gain = figure.subplots(1, 2, sharey=True, width_ratios=(1.25, 1))
    places = -np.arange(len(candidates), dtype=float)
    colours = [COLOURS[0] if each.name in chosen else "#8fb8d6" if each.refitted else "0.75" for each in candidates]
    score.axvspan(-_CALLED, _CALLED, color="0.6", alpha=0.18, lw=0)
    score.barh(places, [each.score or 0.0 for each in candidates], 0.62, color=colours)
    _signed(score, [each.score or 0.0 for each in candidates], _LINEAR)
    score.set(title="Score before any fit with it", xlabel="deviations (grey: chance makes one of them so)")
    score.set_yticks(places, names)
    score.set_ylim(places[-1] - 0.7, 0.7)
    known = [each.delta_BIC for each in candidates if each.delta_BIC is not None]
    for place, each, colour in zip(places, candidates, colours, strict=True):
        if each.delta_BIC is None:
            gain.annotate("not fitted", (0.0, place), (7, 0), textcoords="offset points", va="center", fontsize=8.5,
                          color="0.5", bbox={"fc": "white", "ec": "none", "pad": 0.8})
            continue
        gain.barh(place, each.delta_BIC, 0.62, color=colour)
        gain.text(max(each.delta_BIC, 0.0), place, f"  {gain_text(each.delta_BIC)}{_odds(each)}", va="center",
                  fontsize=8.5)
    _signed(gain, [*known, 0.0], 10.0, room=12.0)
    gain.axvline(10.0, color="0.4", lw=0.9, ls=(0, (3, 2)))
    gain.set(title="Gain of the Schwarz criterion in a fit with it", xlabel="ΔBIC (dashed: less than 10 is none)")
    for axes in (score, gain):
        axes.axvline(0.0, color="0.3", lw=0.8)
        axes.tick_params(axis="y", length=0)
    return figure


def _odds(each: CandidateStatement) -> str:
    """``, 1 : 45`` against the best."""
    ratio = each.evidence_ratio
    return "" if ratio is None or ratio <= 1.0 else f", 1 : {ratio_text(ratio)}"


def _signed(axes, values: Sequence[float], linear: float, room: float = 1.5) -> None:
    """A scale that is linear around zero and logarithmic beyond, with few marks."""
    low, high = min([*values, 0.0]), max([*values, 1.2 * linear])
    axes.set_xscale("symlog", linthresh=linear)
    axes.set_xlim(1.5 * low if low < 0 else -0.06 * linear, room * high)
    ends = [size for size in sorted({linear, 10.0, 100.0, 1e3, 1e4, 1e5, 1e6}) if size >= linear]
    ticks = [*(-size for size in ends if -size > 1.5 * low), 0.0, *(size for size in ends if size < room * high)]
    axes.set_xticks(ticks, list(map(gain_text, ticks)))
    axes.minorticks_off()
