"""Work-precision diagram of a tick in real time."""

from itertools import groupby
from pathlib import Path

from benchmarks.realtime.ticks import BONDED, BONDED_TARGETS, CLOSE_TARGETS, ERROR, P50, P99, P999, largest

#: Of the families of growths: colours that the colour-blind can tell, and markers.
_STYLES = (("#0072B2", "o"), ("#D55E00", "s"), ("#009E73", "^"), ("#000000", "D"))


def plot(result: dict, path: Path) -> None:
    """Draw the largest force error against CPU time per tick, with the targets."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(7.2, 5.4), layout="constrained")
    families = groupby(result["work_precision"], lambda point: point["grading"].partition(",")[0])
    for (name, points), (colour, marker) in zip(families, _STYLES, strict=False):
        points = sorted(points, key=lambda point: point[P50])
        axes.plot([point[P50] for point in points], [point["largest_error_percent"] for point in points], "-",
                  color=colour, marker=marker, lw=1.0, ms=6, label=name)
        for point in points:
            axes.annotate(str(point["elements"]), (point[P50], point["largest_error_percent"]), xytext=(5, 4),
                          textcoords="offset points", fontsize=8, color=colour)
    for targets, label in ((BONDED_TARGETS, "target: 1 %"), (CLOSE_TARGETS, "target: 0.3 %")):
        error, time = targets[ERROR], targets[P50]
        axes.fill_between([1e-3, time], 1e-3, error, color="0.85", alpha=0.5, zorder=0)
        axes.plot([1e-3, time, time], [error, error, 1e-3], color="0.4", lw=1.0, ls="--")
        axes.annotate(f"{label} in {time:g} ms", (time, error), xytext=(4, 4), textcoords="offset points", fontsize=8,
                      color="0.3")
    stars = [row for row in result["rows"] if row["case"] == f"{BONDED}, loading"]
    for row in stars:
        at = row[P50], largest(row, ERROR)
        axes.plot([at[0], row[P999]], [at[1], at[1]], color="#CC79A7", lw=1.2, zorder=4)
        axes.plot(row[P99], at[1], "|", color="#CC79A7", ms=12, mew=2, zorder=4)
        axes.plot(*at, "*", color="#CC79A7", mec="black", ms=15, zorder=5)
        axes.annotate(f"{row['elements']}, {row['grading']}", (row[P999], at[1]), xytext=(5, -3),
                      textcoords="offset points", fontsize=8)
    times = [point[P50] for point in result["work_precision"]] + [row[P999] for row in stars]
    axes.set(xscale="log", yscale="log", xlim=(0.6 * min(times), 4.0 * max(times)), ylim=(0.06, 3.0),
             xlabel="CPU time per tick of 0.05 mm [ms]", ylabel="largest force error at 2, 5 and 10 mm [%]",
             title="Needle with bonded face and frictionless shaft, converged to 1e-6")
    axes.grid(which="major", color="0.85", lw=0.5)
    axes.set_xticks([tick for tick in (0.1, 0.2, 0.3, 0.5, 0.75, 1.0, 2.0, 5.0, 10.0) if tick < 4.0 * max(times)])
    axes.set_yticks([0.1, 0.3, 1.0, 3.0])
    axes.minorticks_off()
    axes.xaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.legend(fontsize=9, title="medians; numbers: elements\nstar: with its p99 and p99.9", title_fontsize=8)
    figure.savefig(path, dpi=130)
