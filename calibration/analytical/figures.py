"""Pictures of the analytical report: data with the curves of all laws, and residuals. matplotlib is imported on use."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calibration.analytical.assess import residual_of
from calibration.analytical.replicates import Replicate, loading_path
from calibration.fit.fit import Fit
from calibration.report.drawing import STYLE, cloud, counted, line_styles, new_figure, thinned, to_png
from tissue_sim.laws import find_law

_CURVE_POINTS, _BINS = 200, 60


def draw_test(fits: Sequence[Fit], replicates: Sequence[Replicate]) -> bytes:
    """Data and curves above, residuals below, of one test.

    As the field plots it: force against displacement for recordings of force, otherwise nominal stress in kPa against
    stretch or shear strain; compression positive.

    Args:
        fits: in the order of the legend. replicates: of one test.

    Returns:
        A PNG.
    """
    import matplotlib

    first = replicates[0]
    noise = float(np.sqrt(np.mean([r.noise**2 for r in replicates])))
    to_x, to_y, x_label, y_label, r_label = _axes_of(first)
    with matplotlib.rc_context(STYLE):
        figure = new_figure(8.0, 6.6)
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2.2, 1.0))
        for i, replicate in enumerate(replicates):
            thin = thinned(replicate.stress.size)
            label = f"measured ({counted(len(replicates), 'recording')})" if i == 0 else None
            style = cloud(sum(r.stress.size for r in replicates))
            above.plot(to_x(replicate.abscissa[thin]), to_y(replicate.stress[thin]), "o", ms=4.5, label=label, **style)
        abscissa = loading_path(replicates, _CURVE_POINTS)
        edges = np.linspace(*sorted(first.test.kind.strain(abscissa[[0, -1]])), _BINS + 1)
        # Model minus data, with the sign and the unit of the panel above.
        factor = to_y(np.array([1.0]))[0]
        scale, reach = abs(factor), []
        for i, (fit, look) in enumerate(zip(fits, line_styles(), strict=False)):
            style = {**look, "lw": 1.8, "zorder": 3}
            above.plot(to_x(abscissa), to_y(first.model.stress(find_law(fit.law), abscissa, fit.parameters)),
                       label=find_law(fit.law).title, **style)
            x, mean, low, high = _binned(fit, replicates, edges)
            below.plot(to_x(x), factor * mean, **style)
            if i == 0 and len(replicates) > 1:
                below.fill_between(to_x(x), factor * low, factor * high, color=look["color"], alpha=0.18, lw=0,
                                   label="spread of the recordings, best law")
            widest = np.abs([mean, low, high] if i == 0 else mean)
            reach.append(scale * widest.max(initial=0.0))
        # A law that is far off would flatten all the others.
        limit = 1.2 * max(reach[0], float(np.median(reach)), 2.5 * noise * scale)
        below.set_ylim(-limit, limit)
        below.axhspan(-2 * noise * scale, 2 * noise * scale, color="0.6", alpha=0.35, lw=0, label="± 2 noise")
        below.axhline(0.0, color="0.3", lw=0.8)
        above.set_ylabel(y_label)
        below.set_ylabel(r_label)
        below.set_xlabel(x_label)
        above.legend(loc="best")
        below.legend(loc="upper left", fontsize=8, ncols=2, framealpha=0.9)
        figure.align_ylabels((above, below))
        return to_png(figure)


def _axes_of(replicate: Replicate):
    """Functions from abscissa and stress to what is plotted, and the labels."""
    sign = replicate.force_sign
    if replicate.mechanical:
        height, area = replicate.test.specimen.height, replicate.area
        rest = replicate.rest
        return (lambda a: sign * (a - rest) * height * 1e3, lambda p: sign * area * p, "displacement [mm]", "force [N]",
                "model − data [N]")
    stress = "nominal stress, compression positive [kPa]" if sign < 0 else "nominal stress [kPa]"
    return lambda a: a, lambda p: sign * p * 1e-3, replicate.model.abscissa, stress, "model − data [kPa]"


def _binned(fit: Fit, replicates: Sequence[Replicate], edges: np.ndarray):
    """Mean residual of all replicates in bins of strain, and the extremes of the replicates' own means, Pa."""
    rows = np.full((len(replicates), edges.size - 1), np.nan)
    places = np.full((len(replicates), edges.size - 1), np.nan)
    for i, replicate in enumerate(replicates):
        residual = residual_of(fit, replicate)
        bins = np.clip(np.searchsorted(edges, replicate.strain, side="right") - 1, 0, edges.size - 2)
        count = np.bincount(bins, minlength=edges.size - 1)
        full = count > 0
        rows[i, full] = np.bincount(bins, residual, edges.size - 1)[full] / count[full]
        places[i, full] = np.bincount(bins, replicate.abscissa, edges.size - 1)[full] / count[full]
    seen = np.isfinite(rows).any(axis=0)
    return (np.nanmean(places[:, seen], axis=0), np.nanmean(rows[:, seen], axis=0), np.nanmin(rows[:, seen], axis=0),
            np.nanmax(rows[:, seen], axis=0))
