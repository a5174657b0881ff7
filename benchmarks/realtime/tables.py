"""Tables of the result of `realtime`."""

from rich.console import Console

from benchmarks.measure import spread, table
from benchmarks.realtime.iteration import PARTS
from benchmarks.realtime.ticks import ERROR, P50, P99, P999


def draw(result: dict, console: Console) -> None:
    """Print all tables, that of the targets last."""
    _ticks(result["rows"], console)
    _work_precision(result["work_precision"], console)
    _iteration(result, console)
    _motion(result["irregular_motion"], console)
    _processes(result, console)
    table(console, "What it must show", ["quantity", "measured", "target", ""],
          [[row["quantity"], row["measured"], row["target"],
            {True: "met", False: "missed", None: ""}[row["met"]]] for row in result["targets"]])


def _percent(values: list[float] | None) -> str:
    return "" if values is None else ", ".join(f"{value:+.2f}" for value in values)


def _times(row: dict) -> list[str]:
    return [f"{row[name]:.3f}" for name in (P50, P99, P999, "cpu_ms_max")]


def _worst(row: dict) -> str:
    worst = row["worst_tick"]
    return f"{worst['cpu_ms']:.2f} at {worst['depth_mm']:.2f} mm ({worst['newton']})"


def _ticks(rows: list[dict], console: Console) -> None:
    table(console, "Ticks of 0.05 mm in 1 ms: force error at 2, 5, 10 mm against the converged solution, its distance "
          "to the reference; CPU ms; slowest tick by its median (linear solves)",
          ["case", "mesh", "elements", "n", "band", "error %", "distance %", "p50", "p99", "p99.9", "max", "Newton",
           "slowest"],
          [[row["case"], row["grading"], str(row["elements"]), str(row["freedoms"]), str(row["half_band"]),
            _percent(row[ERROR]), _percent(row["reference_distance_percent"]), *_times(row),
            f"{row['newton_mean']:.2f}", _worst(row)] for row in rows])
    solved = {row["case"]: row["converged"] for row in rows if "converged" in row}
    table(console, "Converged solutions", ["case", "elements", "N at 2, 5, 10 mm", "ticks without equilibrium"],
          [[name, str(each["elements"]), ", ".join(f"{force:.5f}" for force in each["force_N"]),
            str(sum(each["statuses"].values()) - each["statuses"]["converged"])] for name, each in solved.items()])


def _work_precision(points: list[dict], console: Console) -> None:
    table(console, "Work and precision during loading", ["mesh", "elements", "n", "band", "largest error %", "error %",
                                                        "p50", "p99", "p99.9", "max", "Newton"],
          [[point["grading"], str(point["elements"]), str(point["freedoms"]), str(point["half_band"]),
            f"{point['largest_error_percent']:.2f}", _percent(point[ERROR]), *_times(point),
            f"{point['newton_mean']:.2f}"] for point in points])


def _iteration(result: dict, console: Console) -> None:
    table(console, "One Newton iteration at 5 mm: CPU ms (share)",
          ["mesh", "n", "band", "iteration", *PARTS.values(), "dpbtrf", "iteration / dpbtrf"],
          [[row["mesh"], str(row["freedoms"]), str(row["half_band"]), f"{row['iteration_ms']:.3f}",
            *(f"{row[part]:.3f} ({row['share_percent'][part]:.0f} %)" for part in PARTS), f"{row['dpbtrf_ms']:.3f}",
            f"{row['over_dpbtrf']:.2f}"] for row in result["iteration"]])
    table(console, "The same of a bonded punch without wall contact: CPU ms (smallest to largest)",
          ["mesh", "FElupe", "ours", "ratio", "forces agree to"],
          [[row["mesh"], spread(row["felupe"]), spread(row["ours"], 3), f"{row['ratio']:.1f}x",
            f"{row['largest_difference']:.1g}"] for row in result["felupe"]])


def _motion(rows: list[dict], console: Console) -> None:
    table(console, "Irregular motion: CPU ms of a tick",
          ["case", "budget ms", "ticks", "NaN", "late", "stopped", "jumps", "largest N", "lift-offs", "p50", "p99",
           "p99.9", "max", "Newton", "slowest"],
          [[row["case"], f"{row['budget_ms']:g}" if row["budget_ms"] else "none", str(row["ticks"]), str(row["nan"]),
            str(row["statuses"]["late"]), str(row["statuses"]["stopped"]), str(row["jumps"]),
            f"{row['largest_jump_N']:.4f}", str(row["lift_offs"]), *_times(row), f"{row['newton_mean']:.2f}",
            _worst(row)] for row in rows])


def _processes(result: dict, console: Console) -> None:
    quantiles = ("p50", "p99", "p99.9", "max")
    table(console, "The loop: us, p50, p99, p99.9, max",
          ["case", "ticks", "missed %", "late", "lateness", "compute time", "answers", "memory MB", "not granted"],
          [[row["case"], str(row["ticks"]), f"{row['missed_percent']:.3f}", str(row["late"]),
            *(", ".join(f"{row[name][part]:.0f}" for part in quantiles) for name in ("lateness_us", "compute_us")),
            ", ".join(f"{count} {name}" for name, count in row["statuses"].items() if count),
            f"{row['peak_memory_MB'] or 0.0:.0f}",
            ", ".join(each["name"] for each in row["real_time"] if not each["obtained"])] for row in result["loop"]])
    table(console, "Simulators at once", ["processes", "cores", "steps/s", "per core", "steps per CPU s", "over one",
                                          "memory MB"],
          [[str(row["processes"]), str(row["cores"]), *(f"{row[name]:.0f}" for name in (
              "steps_per_s", "steps_per_s_per_core", "steps_per_cpu_s")), f"{row['over_one']:.2f}",
            f"{row['peak_memory_MB']:.0f}"] for row in result["throughput"]])
    table(console, "Round trip on loopback: us, p50, p99, max",
          ["client", "pace", "beyond the step", "step", "not converged"],
          [[row["client"], row["pace"], *(", ".join(f"{row[f'{name}_us_{part}']:.0f}" for part in ("p50", "p99", "max"))
                                          for name in ("beyond", "step")),
            str(row["steps"] - row["statuses"].get("0", 0))] for row in result["round_trip"]])
