"""Targets of the real-time simulation, compared with the result of `realtime`."""

from collections.abc import Iterator

from benchmarks.measure import verdict
from benchmarks.realtime.motion import JUMP
from benchmarks.realtime.ticks import ERROR, P50, P99, P999, largest

#: Target: CPU time of an iteration of FElupe over ours, 1.
FELUPE = 70.0
#: Target: missed ticks, %.
MISSED = 0.1
#: Target: memory, MB.
MEMORY = 400.0
#: Target: round trip without the step, us.
ROUND_TRIP = 60.0
_UNITS = {ERROR: "% of force error", P50: "ms p50", P99: "ms p99", P999: "ms p99.9"}


def targets(result: dict) -> list[dict]:
    """Return ``quantity``, ``measured``, ``target`` and ``met`` of each row; ``met`` is None without target."""
    return [{"quantity": quantity, "measured": measured, "target": target, "met": met}
            for quantity, measured, target, met in _targets(result)]


def _targets(result: dict) -> Iterator[tuple[str, str, str, bool | None]]:
    points = result["work_precision"]
    elements = [point["elements"] for point in points]
    yield ("work-precision diagram", f"{len(points)} meshes, {min(elements)} to {max(elements)} elements",
           result["figure"] or "drawn with --figure", bool(result["figure"]))
    for row in result["rows"]:
        names = [name for name in row["targets"] if row[name] is not None]
        if names:
            yield (f"{row['case']} ({row['elements']} elements)",
                   ", ".join(f"{largest(row, name):.2f} {_UNITS[name]}" for name in names),
                   ", ".join(verdict(row["met"][name], f"{row['targets'][name]:g}") for name in names),
                   all(row["met"][name] for name in names))
    for row in result["iteration"]:
        yield (f"one iteration over dpbtrf: {row['mesh']}", f"{row['over_dpbtrf']:.2f} (n {row['freedoms']}, half band "
               f"{row['half_band']})", "reported", None)
    for row in result["felupe"]:
        yield (f"FElupe's over one iteration: {row['mesh']}", f"{row['ratio']:.1f}x", f"{FELUPE:g}x",
               bool(row["ratio"] >= FELUPE))
    for row in result["irregular_motion"]:
        wrong = row["ticks"] - row["statuses"]["converged"]
        # Within a budget a late step is what was asked for.
        late = row["statuses"]["late"] if row["budget_ms"] else 0
        yield (f"irregular motion: {row['case']}, {_budget(row)}",
               f"{row['nan']} NaN, {wrong - late} wrong statuses" + (f", {late} late" if row["budget_ms"] else "")
               + f", {row['jumps']} jumps above {JUMP:g} N", "none", row["nan"] + wrong - late + row["jumps"] == 0)
    for row in result["loop"]:
        asked = bool(row["real_time"])
        granted = any(each["name"] == "SCHED_FIFO" and each["obtained"] for each in row["real_time"])
        yield (f"loop of {row['seconds']:.0f} s: missed ticks {row['case']}",
               f"{row['missed_percent']:.3f} %" + (", not granted" if asked and not granted else ""),
               f"{MISSED:g} %" if asked else "reported", row["missed_percent"] <= MISSED if asked else None)
    memory = max(row["peak_memory_MB"] or 0.0 for row in result["loop"] + result["throughput"])
    yield "memory of one simulator process", f"{memory:.0f} MB", f"{MEMORY:g} MB", 0.0 < memory <= MEMORY
    for row in result["throughput"]:
        yield (f"throughput: processes: {row['processes']}", f"{row['steps_per_s']:.0f} steps/s, "
               f"{row['steps_per_s_per_core']:.0f} per core, {row['over_one']:.2f} of one process", "reported", None)
    for row in result["round_trip"]:
        yield (f"round trip beyond the step: client in {row['client']}, {row['pace']}",
               f"{row['beyond_us_p50']:.0f} us p50, {row['beyond_us_p99']:.0f} us p99", f"{ROUND_TRIP:g} us p50",
               row["beyond_us_p50"] < ROUND_TRIP)


def _budget(row: dict) -> str:
    return f"budget {row['budget_ms']:g} ms" if row["budget_ms"] else "no budget"
