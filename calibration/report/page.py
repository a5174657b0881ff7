"""What the reports of all calibrations share: the page, its tables, and numbers as people write them."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from html import escape

from calibration.campaign.measured import MeasuredCurve
from calibration.fit.fit import Fit
from calibration.report.drawing import as_data_uri, draw_formula, natural_width
from tissue_sim.laws import find_law

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
th, td { text-align: right; padding: .35rem .6rem; border-bottom: 1px solid #dfe3e8;
         vertical-align: top; white-space: nowrap; }
th:first-child, td:first-child, td.text, th.text { text-align: left; }
td.text { white-space: normal; min-width: 8.5rem; }
thead th { border-bottom: 2px solid #59636e; font-weight: 600; } tr.best td { background: #f3f8f1; }
img { max-width: 100%; height: auto; } img.formula { max-width: none; vertical-align: middle; }
figure { margin: 0 0 1.4rem; } figcaption { color: #59636e; font-size: .87rem; }
details { margin: .6rem 0; } summary { cursor: pointer; font-weight: 600; } code { overflow-wrap: anywhere; }
h3 small { font-weight: 400; margin-left: .4rem; }
small, .quiet { color: #59636e; } .bad { color: #a33c00; }
"""


def html_page(title: str, parts: Iterable[str]) -> str:
    """A page that stands alone: style and, as data, pictures are inside. Title in plain text, `parts` of the body in
    HTML."""
    return "\n".join([
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<style>{_STYLE}</style></head><body>", f"<h1>{escape(title)}</h1>", *parts, "</body></html>"]) + "\n"


def html_table(labels: Sequence[str], rows: Sequence[Sequence[str | None]], *, text: Collection[int] = (),
               best: bool = False, narrow: bool = False) -> str:
    """A table that scrolls where the page is narrow. Labels and cells are HTML.

    Args:
        rows: of cells; None: the cell above reaches down here.
        text: columns of words, which may wrap; the first stands left anyway.
        best: mark the first row. narrow: only as wide as its content.
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


def html_list(sentences: Iterable[str]) -> str:
    """A bulleted list of HTML."""
    return f"<ul>{''.join(f'<li>{sentence}</li>' for sentence in sentences)}</ul>"


def html_figure(png: bytes, alt: str, caption: str = "") -> str:
    """A picture inside the page, with words (plain) instead of it and a caption (HTML) below."""
    below = f"<figcaption>{caption}</figcaption>" if caption else ""
    return f'<figure><img src="{as_data_uri(png)}" alt="{escape(alt)}">{below}</figure>'


def title_of(law_name: str) -> str:
    """Title of a law, as HTML."""
    return escape(find_law(law_name).title)


def number(value: float | None, digits: int) -> str:
    """The number to so many digits, ``-`` for None."""
    return "-" if value is None else f"{value:.{digits}g}"


def plus_minus(error: float | None) -> str:
    """`` ± 0.012``, nothing for None."""
    return "" if error is None else f" ± {error:.2g}"


def symbol_of(fit: Fit, name: str) -> str:
    """A parameter's symbol, with its name in the model where that is another."""
    symbol = escape(fit.symbols[name])
    return symbol if fit.symbols[name] == name else f'<span title="{escape(name)}">{symbol}</span>'


def stable_stretches(fit: Fit) -> str:
    """Drucker-stable stretches in all three modes, such as ``0.3 to 3``."""
    nowhere = fit.mu0 <= 0 or fit.stable_from >= fit.stable_to
    return "nowhere" if nowhere else f"{fit.stable_from:.3g} to {fit.stable_to:.3g}"


def remark_list(fits: Sequence[Fit]) -> str:
    """Drucker stability and the message of each fit, a line each."""
    lines = []
    for fit in fits:
        warn = "" if fit.status == "converged" else ' class="bad"'
        lines.append(f"<li{warn}>{title_of(fit.law)}: {escape(fit.message)}; Drucker: {escape(fit.stability)}</li>")
    return f"<ul>{''.join(lines)}</ul>"


def parameter_table(fits: Sequence[Fit], figures: bool) -> str:
    """Every parameter of every law: estimate, standard error, interval and, where some are known, what cut it."""
    noted = any(fit.interval_notes for fit in fits)
    rows = []
    for fit in fits:
        law = find_law(fit.law)
        png = draw_formula(fit.law) if figures else None
        formula = escape(fit.formula) if png is None else \
            f'<img class="formula" width="{natural_width(png)}" src="{as_data_uri(png)}" alt="{escape(fit.formula)}">'
        lead: str | None = f"{escape(law.title)}<br>{formula}"
        for name, value in fit.parameters.items():
            error, interval = fit.standard_errors[name], fit.intervals95[name]
            unit = fit.unit(name)
            unit = f" {unit}" if unit else ""
            doubtful = ' <span class="bad">not determined</span>' if name in fit.not_identifiable else ""
            held = "on its bound" if name in fit.on_bound else "-"
            spread = held if error is None else "fixed" if error == 0 else f"{error:.3g}{unit}"
            bounds = "-" if interval is None or error == 0 else f"{interval[0]:.5g} to {interval[1]:.5g}"
            rows.append([lead, f"{symbol_of(fit, name)}{doubtful}", f"{value:.6g}{unit}", spread, bounds,
                         escape(fit.interval_notes.get(name, ""))][:6 if noted else 5])
            lead = None
    labels = ["Law", "Parameter", "Value", "Standard error", "95 % interval", "What cuts it"]
    return html_table(labels[:6 if noted else 5], rows, text=(1, 5))


def correlation_tables(fits: Sequence[Fit]) -> list[str]:
    """How the estimates depend on each other, for every law with more than one free parameter."""
    parts = []
    for fit in fits:
        free = free_parameters(fit)
        if len(free) < 2:
            continue
        place = [fit.covariance.order.index(name) for name in free]
        rows = [[escape(fit.covariance.order[i]), *(f"{fit.correlation[i][j]:.3f}" for j in place)] for i in place]
        parts += [f"<h3>{title_of(fit.law)}</h3>", html_table(["", *map(escape, free)], rows, narrow=True)]
    return ["<h2>Correlation of the parameters</h2>", *parts] if parts else []


def free_parameters(fit: Fit) -> list[str]:
    """Names of those with a standard error: neither fixed nor on a bound, in the order of the covariance."""
    return [name for name in fit.covariance.order if fit.standard_errors[name] not in (None, 0.0)]


def nuisance_table(fit: Fit) -> str:
    """Contact offset and zero of each recording."""
    rows = [[escape(n.replicate), f"{n.contact_offset_mm:.4f}{plus_minus(n.contact_offset_error_mm)}",
             f"{n.zero_offset_N:.4f}{plus_minus(n.zero_offset_error_N)}",
             f'<span class="bad">{escape(", ".join(n.on_bound))}</span>'] for n in fit.nuisances]
    return html_table(["Recording", "Contact offset [mm]", "Zero [N]", "On its bound"], rows, text=(3,))


def recording_list(recordings: Iterable[MeasuredCurve]) -> str:
    """Files, SHA-256 and numbers of points."""
    return html_list(f"{escape(curve.file.name)} <small>SHA-256 <code>{escape(curve.sha256)}</code>, "
                     f"{curve.force.size} points</small>" for curve in recordings)
