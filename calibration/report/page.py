"""Shared parts of the HTML reports: page, tables, lists, and formatted numbers of a fit."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from html import escape

from calibration.campaign.measured import MeasuredCurve
from calibration.fit.fit import Fit
from calibration.fit.typical_material import get_shared_and_population_mean_material
from calibration.report.drawing import (
    get_formula_width_in_css_pixels,
    make_png_data_uri,
    render_law_formula_png_or_none,
)
from calibration.report.rounding import format_interval, format_value_and_error, format_value_rounded_by_error
from calibration.report.symbols import format_html_symbol
from calibration.report.units import DisplayUnit, ReportUnits
from tissue_sim.laws import find_law

#: Relative step of a parameter for the finite-difference derivative of a modulus.
_STEP = 1e-4
_STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, -apple-system, "Segoe UI", sans-serif; color: #1b1f24; background: #fff;
       max-width: 76rem; margin: 2rem auto; padding: 0 1.2rem; }
h1 { font-size: 1.55rem; margin: 0 0 .2rem; } h2 { font-size: 1.15rem; margin: 2rem 0 .5rem; }
h3 { font-size: 1rem; margin: 1rem 0 .3rem; } table.narrow { width: auto; }
.verdict { background: #eef4fa; border-left: 4px solid #0072b2; padding: .7rem 1rem; margin: 1rem 0; }
dl.verdict { display: grid; grid-template-columns: max-content 1fr; gap: .45rem 1.1rem; }
dl.verdict dt { font-weight: 600; color: #00466e; } dl.verdict dd { margin: 0; }
@media (max-width: 40rem) { dl.verdict { grid-template-columns: 1fr; gap: .1rem; }
                            dl.verdict dd { margin: 0 0 .6rem; }
                            figure { overflow-x: auto; } figure img { max-width: none; width: 48rem; } }
.wide { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
th { vertical-align: bottom; } td { white-space: nowrap; }
th, td { text-align: right; padding: .35rem .6rem; border-bottom: 1px solid #dfe3e8; }
th:first-child, td:first-child, td.text, th.text { text-align: left; }
td { vertical-align: top; } td.text { white-space: normal; min-width: 8.5rem; }
td:first-child { white-space: normal; min-width: 7rem; }
thead th { border-bottom: 2px solid #59636e; font-weight: 600; } tr.best td { background: #f3f8f1; }
img { max-width: 100%; height: auto; } img.formula { max-width: none; vertical-align: middle; }
figure { margin: 0 0 1.4rem; } figcaption { color: #59636e; font-size: .87rem; }
pre.paste { white-space: pre-wrap; background: #f6f8fa; padding: .8rem 1rem; font: inherit;
            user-select: all; }
details table { font-size: .82rem; } details th, details td { padding: .2rem .45rem; }
details { margin: .6rem 0; } summary { cursor: pointer; font-weight: 600; } code { overflow-wrap: anywhere; }
h3 small { font-weight: 400; margin-left: .4rem; }
small, .quiet { color: #59636e; } .bad { color: #a33c00; }
"""


def make_html_page(title: str, parts: Iterable[str]) -> str:
    """Return a self-contained HTML page.

    Args:
        title: title in plain text.
        parts: HTML of the body; figures are embedded as data.
    """
    return "\n".join([
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<style>{_STYLE}</style></head><body>", f"<h1>{escape(title)}</h1>", *parts, "</body></html>"]) + "\n"


def make_html_table(labels: Sequence[str], rows: Sequence[Sequence[str | None]], *, text: Collection[int] = (),
                    best: bool = False, narrow: bool = False) -> str:
    """Return an HTML table that scrolls horizontally on a narrow page.

    Args:
        labels: HTML of the column headings.
        rows: HTML of the cells of each row; None: the cell above extends over this row.
        text: indices of columns with text, which may wrap; the first column is always left-aligned.
        best: whether to highlight the first row.
        narrow: whether the table is only as wide as its content.
    """
    sort = [' class="text"' if i in text else "" for i in range(len(labels))]
    lines = []
    for i, row in enumerate(rows):
        cells = []
        for j, cell in enumerate(row):
            if cell is None:
                continue
            reach = next((k for k, later in enumerate(rows[i + 1:], 1) if later[j] is not None), len(rows) - i)
            span = f' rowspan="{reach}"' if reach > 1 else ""
            cells.append(f"<td{sort[j]}{span}>{cell}</td>")
        lines.append(f"<tr{' class=best' if best and i == 0 else ''}>{''.join(cells)}</tr>")
    head = "".join(f"<th{sort[j]}>{label}</th>" for j, label in enumerate(labels))
    return (f'<div class="wide"><table{" class=narrow" if narrow else ""}><thead><tr>{head}</tr></thead>'
            f'<tbody>{"".join(lines)}</tbody></table></div>')


def make_html_list(sentences: Iterable[str]) -> str:
    """Return a bulleted HTML list of these sentences (HTML)."""
    return f"<ul>{''.join(f'<li>{sentence}</li>' for sentence in sentences)}</ul>"


def format_law_title(law_name: str) -> str:
    """Return the title of a law as HTML; ``N = 2`` stays on one line."""
    return escape(find_law(law_name).title).replace("N = ", "N\u00a0=\u00a0")


def are_laws_ranked_by_prediction(fits: Iterable[Fit]) -> bool:
    """Return whether the laws are ranked by prediction error instead of the BIC."""
    return any(fit.left_out is not None for fit in fits)


def format_significant_digits_or_dash(value: float | None, digits: int) -> str:
    """Return a number as text with this many significant digits; ``-`` for None."""
    return "-" if value is None else f"{value:.{digits}g}"


def use_minus_signs(text: str) -> str:
    """Replace the hyphen before each number by a minus sign."""
    return re.sub(r"(?<![\w.-])-(?=\d)", "−", text)


def format_parameter_estimate(fit: Fit, name: str, units: ReportUnits) -> str:
    """Return the estimate of a parameter with its standard error, such as ``0.988 ± 0.023 kPa``.

    Without a standard error the text states the reason, or all values such as ``8 or -8`` if several optima fit equally
    well.
    """
    unit, error = units.choose_display_unit_of_si_unit(fit.units[name]), fit.standard_errors[name]
    known = "fixed" if error == 0 else "on its bound" if name in fit.on_bound else ""
    if error is None and fit.alternatives and not known:
        values = dict.fromkeys(f"{each[name] / unit.size:.4g}" for each in (
            fit.parameters, *(one.parameters for one in fit.alternatives)))
        return f"{' or '.join(values)} {unit.name}".strip()
    return format_value_and_error(fit.parameters[name] / unit.size, error and error / unit.size, unit.name, known=known)


def format_parameter_interval_without_unit(fit: Fit, name: str, units: ReportUnits) -> str:
    """Return the 95 % interval of a parameter in its display unit, without the unit, such as ``0.937 to 1.040``.

    The text is empty if the interval or the standard error is unknown.
    """
    unit = units.choose_display_unit_of_si_unit(fit.units[name])
    error, interval = fit.standard_errors[name], fit.intervals95[name]
    if interval is None or not error:
        return ""
    low, high = (end / unit.size for end in interval)
    return format_interval(low, high, error / unit.size, fit.parameters[name] / unit.size)


def compute_shear_modulus_error_or_none(fit: Fit) -> float | None:
    """Return the standard error of the initial shear modulus, Pa, by linear propagation of the covariance.

    For specimens that differ the covariance of the mean material is used.

    Returns:
        The standard error; None if a parameter of the law has no error or differs between tests.
    """
    law, material = find_law(fit.law), get_shared_and_population_mean_material(fit)
    values = {name: material.parameters[name] for name in law.parameters if name in material.parameters}
    if any(material.errors.get(name) is None for name in law.parameters):
        return None

    def differentiate_modulus_by_one_parameter(name: str) -> float:
        """Return the derivative of the initial shear modulus with respect to one parameter (central difference)."""
        step = _STEP * (abs(values[name]) or 1.0)
        ends = (law.mu0({**values, name: values[name] + side * step}) for side in (1, -1))
        return (next(ends) - next(ends)) / (2 * step)

    rates = [differentiate_modulus_by_one_parameter(name) for name in law.parameters]
    order = list(material.parameters)
    indices = [order.index(name) for name in law.parameters]
    variance = sum(rates[a] * rates[b] * float(material.covariance[i, j])
                   for a, i in enumerate(indices) for b, j in enumerate(indices))
    return math.sqrt(variance) if variance > 0 else None


def format_young_and_shear_modulus_values(fit: Fit, units: ReportUnits) -> tuple[str, str]:
    """Return Young's modulus and the shear modulus as text, in the pressure unit of the report but without its name.

    Both are rounded to the precision of their standard errors, which are not written.
    """
    size, error = units.pressure.size, compute_shear_modulus_error_or_none(fit)
    ratio = fit.E0 / fit.mu0 if fit.mu0 else 3.0
    return (format_value_rounded_by_error(fit.E0 / size, error and abs(ratio) * error / size),
            format_value_rounded_by_error(fit.mu0 / size, error and error / size))


def format_young_modulus(fit: Fit, units: ReportUnits) -> str:
    """Return Young's modulus with its standard error, such as ``5.93 ± 0.14 kPa``."""
    size, error = units.pressure.size, compute_shear_modulus_error_or_none(fit)
    return format_value_and_error(fit.E0 / size, error and abs(fit.E0 / fit.mu0) * error / size, units.pressure.name)


def format_parameter_symbol(fit: Fit, name: str) -> str:
    """Return the symbol of a parameter as HTML; a tooltip gives the name in the model if the name differs."""
    symbol = format_html_symbol(fit.symbols[name])
    return symbol if fit.symbols[name] == name else f'<span title="{escape(name)}">{symbol}</span>'


def format_stable_stretches(fit: Fit) -> str:
    """Return the range of stretches with Drucker stability in all three modes, such as ``0.3 to 3``."""
    nowhere = fit.mu0 <= 0 or fit.stable_from >= fit.stable_to
    return "nowhere" if nowhere else f"{fit.stable_from:.3g} to {fit.stable_to:.3g}"


def iterate_fit_groups_with_remarks(fits: Sequence[Fit],
                                    of: Callable[[Fit], Sequence[str]]) -> Iterator[tuple[tuple[Fit, ...], str]]:
    """Yield (fits, their common remarks joined by ``;``) for each group of fits, the largest group first.

    A remark that several laws share appears once.

    Args:
        fits: fits of all laws.
        of: returns the remarks of a fit.
    """
    laws: dict[str, tuple[Fit, ...]] = {}
    for fit in fits:
        for remark in of(fit):
            laws[remark] = (*laws.get(remark, ()), fit)
    remarks: dict[tuple[str, ...], list[str]] = {}
    for remark, having in laws.items():
        remarks.setdefault(tuple(fit.law for fit in having), []).append(remark)
    by_name = {fit.law: fit for fit in fits}
    for names in sorted(remarks, key=lambda names: -len(names)):
        yield tuple(by_name[name] for name in names), "; ".join(remarks[names])


def make_remark_list(fits: Sequence[Fit]) -> str:
    """Return the HTML list of stability statements and messages; common ones appear once."""
    lines = []
    for having, words in iterate_fit_groups_with_remarks(fits, lambda fit: [*fit.message.split("; "),
                                                                            f"Drucker: {fit.stability}"]):
        laws = "All laws" if 1 < len(having) == len(fits) else ", ".join(format_law_title(fit.law) for fit in having)
        warn = "" if any(fit.status == "converged" for fit in having) else ' class="bad"'
        lines.append(f"<li{warn}>{laws}: {escape(words)}</li>")
    return f"<ul>{''.join(lines)}</ul>"


def make_parameter_tables(fits: Sequence[Fit], units: ReportUnits, figures: bool) -> list[str]:
    """Return HTML parts: for each law a heading with its formula, and the table of its estimates and intervals."""
    parts = []
    for fit in fits:
        png = render_law_formula_png_or_none(fit.law) if figures else None
        formula = escape(fit.formula) if png is None else \
            f'<img class="formula" width="{get_formula_width_in_css_pixels(png)}" src="{make_png_data_uri(png)}" ' \
            f'alt="{escape(fit.formula)}">'
        rows = []
        for name in fit.parameters:
            doubtful = ' <span class="bad">not determined</span>' if name in fit.not_identifiable else ""
            rows.append([f"{format_parameter_symbol(fit, name)}{doubtful}",
                         use_minus_signs(format_parameter_estimate(fit, name, units)),
                         use_minus_signs(format_parameter_interval_without_unit(fit, name, units)) or "-",
                         escape(fit.interval_notes.get(name, "").replace(f"{name} ", ""))])
        columns = slice(None, None if any(row[3] for row in rows) else 3)
        labels = ["Parameter", "Value ± standard error", "95 % interval", "Limit of the interval"]
        parts += [f"<h3>{format_law_title(fit.law)} <small>{formula}</small></h3>",
                  make_html_table(labels[columns], [row[columns] for row in rows], text=(3,), narrow=True)]
    return parts


def make_correlation_tables(fits: Sequence[Fit]) -> list[str]:
    """Return HTML parts: heading and table of correlations for each law with several free parameters; or no part."""
    parts = []
    for fit in fits:
        free = list_parameters_with_standard_errors(fit)
        if len(free) < 2:
            continue
        indices, symbols = [fit.covariance.order.index(name) for name in free], [format_parameter_symbol(fit, name)
                                                                                 for name in free]
        rows = [[symbol, *(use_minus_signs(f"{fit.correlation[i][j]:.3f}") for j in indices)]
                for symbol, i in zip(symbols, indices, strict=True)]
        parts += [f"<h3>{format_law_title(fit.law)}</h3>", make_html_table(["", *symbols], rows, narrow=True)]
    return ["<h2>Correlation of the parameters</h2>", *parts] if parts else []


def list_parameters_with_standard_errors(fit: Fit) -> list[str]:
    """Return the names of the parameters with a standard error: neither fixed nor at a bound, in covariance order."""
    return [name for name in fit.covariance.order if fit.standard_errors[name] not in (None, 0.0)]


def make_recording_offset_table(fit: Fit, travel: DisplayUnit, load: DisplayUnit) -> str:
    """Return the HTML table of contact offset and force zero of each recording, in these units."""

    def format_nuisance_in_column_unit(value: float, error: float | None, size: float) -> str:
        """Return a value with its standard error as text without unit, in the unit with this size."""
        return use_minus_signs(format_value_and_error(value / size, error and error / size))

    rows = [[escape(n.replicate),
             format_nuisance_in_column_unit(n.contact_offset_mm, n.contact_offset_error_mm, travel.size * 1e3),
             format_nuisance_in_column_unit(n.zero_offset_N, n.zero_offset_error_N, load.size),
             f'<span class="bad">{escape(", ".join(n.on_bound))}</span>'] for n in fit.nuisances]
    bound = slice(None, None if any(n.on_bound for n in fit.nuisances) else 3)
    labels = ["Recording", travel.format_axis_label("Contact offset"), load.format_axis_label("Zero"), "On its bound"]
    return make_html_table(labels[bound], [row[bound] for row in rows], text=(3,), narrow=True)


def make_recording_list(recordings: Iterable[MeasuredCurve]) -> str:
    """Return the HTML list of the recordings with file name, SHA-256 and number of points."""
    return make_html_list(f"{escape(curve.file.name)} <small>SHA-256 <code>{escape(curve.sha256)}</code>, "
                          f"{curve.force.size} points</small>" for curve in recordings)
