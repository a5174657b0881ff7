"""Pictures of the report: data with the curves of all laws, residuals, formulas. matplotlib is imported on use."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence

import numpy as np

from calibration.assess import residual_of
from calibration.fit import Fit
from calibration.replicates import Replicate, loading_path, strain_of
from tissue_sim.laws import find_law

#: Okabe and Ito's palette without yellow and black: apart for every kind of colour vision.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7F3C8D", "#555555")
DASHES = ("-", (0, (6, 2)), (0, (2, 1.2)), (0, (6, 2, 1.5, 2)), (0, (9, 3)), (0, (1, 1)), (0, (4, 1, 1, 1, 1, 1)), "-")
_STYLE = {"font.size": 10, "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True, "grid.alpha": 0.25,
          "legend.frameon": False, "figure.constrained_layout.use": True, "font.family": "DejaVu Sans"}
_DATA_POINTS, _CURVE_POINTS, _BINS = 250, 200, 60
#: Twice the 96 of a CSS inch, for sharp screens.
_FORMULA_DPI = 192


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
    with matplotlib.rc_context(_STYLE):
        figure = _figure(8.0, 6.6)
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2.2, 1.0))
        for i, replicate in enumerate(replicates):
            thin = slice(None, None, max(1, replicate.stress.size // _DATA_POINTS))
            label = f"measured ({len(replicates)} recording{'s' if len(replicates) > 1 else ''})" if i == 0 else None
            # Few points are rings above the curves, many are a cloud below them.
            few = sum(r.stress.size for r in replicates) <= _DATA_POINTS
            style = {"mfc": "none", "mec": "0.2", "zorder": 4} if few else {"color": "0.35", "mew": 0, "alpha": 0.35}
            above.plot(to_x(replicate.abscissa[thin]), to_y(replicate.stress[thin]), "o", ms=4.5, label=label, **style)
        abscissa = loading_path(replicates, _CURVE_POINTS)
        edges = np.linspace(*sorted(strain_of(abscissa[[0, -1]], first.test.kind)), _BINS + 1)
        # Model minus data, with the sign and the unit of the panel above.
        factor = to_y(np.array([1.0]))[0]
        scale, reach = abs(factor), []
        for i, (fit, colour, dashes) in enumerate(zip(fits, _cycle(COLOURS), _cycle(DASHES), strict=False)):
            style = {"color": colour, "ls": dashes, "lw": 1.8, "zorder": 3}
            above.plot(to_x(abscissa), to_y(first.model.stress(find_law(fit.law), abscissa, fit.parameters)),
                       label=find_law(fit.law).title, **style)
            x, mean, low, high = _binned(fit, replicates, edges)
            below.plot(to_x(x), factor * mean, **style)
            if i == 0 and len(replicates) > 1:
                below.fill_between(to_x(x), factor * low, factor * high, color=colour, alpha=0.18, lw=0,
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
        return _png(figure, 150)


def draw_formula(law_name: str) -> bytes | None:
    """The energy as a PNG, None where mathtext cannot set it."""
    import matplotlib

    law = find_law(law_name)
    with matplotlib.rc_context({"mathtext.fontset": "cm"}):
        figure = _figure(0.01, 0.01)
        figure.text(0, 0, f"${law.latex()}$", fontsize=13)
        try:
            return _png(figure, _FORMULA_DPI, bbox_inches="tight", pad_inches=0.03, transparent=True)
        except ValueError:
            return None


def natural_width(png: bytes) -> int:
    """Width in CSS pixels at which the text of `draw_formula` has the size that it was set in."""
    # Width of the image header: https://www.w3.org/TR/png/#11IHDR
    return round(int.from_bytes(png[16:20], "big") * 96 / _FORMULA_DPI)


def as_data_uri(png: bytes) -> str:
    """A PNG that stands inside an HTML page."""
    return "data:image/png;base64," + base64.b64encode(png).decode("ascii")


def _figure(width: float, height: float):
    # Without pyplot: no global state, no display.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height))
    FigureCanvasAgg(figure)
    return figure


def _png(figure, dpi: int, **options) -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=dpi, **options)
    return stream.getvalue()


def _cycle(items: Sequence):
    while True:
        yield from items


def _axes_of(replicate: Replicate):
    """Functions from abscissa and stress to what is plotted, and the labels."""
    sign = replicate.force_sign
    if replicate.mechanical:
        height, area = replicate.test.specimen.height, replicate.area
        rest = 0.0 if replicate.mode == "simple_shear" else 1.0
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
