"""Tables and targets of the result of `viewer`."""

import statistics
from collections.abc import Iterator

from rich.console import Console

from benchmarks.measure import table, verdict

#: Target: CPU time of a frame, ms.
FRAME = 5.0
#: Target: missed ticks with the page over those without, 1.
RATIO = 2.0
#: Missed ticks, %, that are as good as none: 2 of 10,000.
NONE = 0.02
_PARTS = {"frame": "session", "fields": "field", "bands": "bands", "picture": "rest of the picture",
          "words": "words, plots", "sending": "other threads"}
#: Name of a case.
PAGE = "a page with a client"
#: Name of a case.
NO_SCREEN = "a session without a screen"
#: Name of a case.
ALONE = "the loop alone"


def median(rows: list[dict], *path: str) -> float:
    """Return the median of the number at a path of keys in each row."""
    found = []
    for row in rows:
        for key in path:
            row = row[key]
        found.append(row)
    return statistics.median(found)


def same(rows: list[dict]) -> dict[tuple, list[dict]]:
    """Group rows of the same case and mesh, in their order."""
    found: dict[tuple, list[dict]] = {}
    for row in rows:
        found.setdefault((row["case"], row.get("elements")), []).append(row)
    return found


def targets(result: dict) -> list[dict]:
    """Return ``quantity``, ``measured``, ``target`` and ``met`` of each row; ``met`` is None without target."""
    return [{"quantity": quantity, "measured": measured, "target": target, "met": met}
            for quantity, measured, target, met in _targets(result)]


def _targets(result: dict) -> Iterator[tuple[str, str, str, bool | None]]:
    for (case, elements), rows in same(result["cpu"]).items():
        if case == "moves":
            cpu, thread = median(rows, "process_ms"), median(rows, "frame_thread_ms", "mean")
            yield (f"CPU of a frame, {elements} elements, one client",
                   f"{cpu:.1f} ms ({thread:.1f} without other threads)", f"{FRAME:g} ms", cpu <= FRAME)
    ticks = {case: rows for (case, _), rows in same(result["ticks"]).items()}
    page = ticks[PAGE]
    for other in (NO_SCREEN, ALONE):
        for name in ("missed_percent", "late_percent"):
            with_page, without = median(page, name), median(ticks[other], name)
            ratio = f", {with_page / without:.1f} times" if without else ""
            good = with_page <= RATIO * max(without, NONE)
            yield (f"{name.partition('_')[0]} ticks with a page against {other}",
                   f"{with_page:.3f} % against {without:.3f} %{ratio}", f"{RATIO:g} times",
                   good if name == "missed_percent" else None)
    latencies = result["latencies"]
    for name, path in (("picture", ("pictures", "all")), ("read-outs", ("readouts",))):
        yield (f"from a tick to a client: {name}", f"{median(latencies, *path, 'p50'):.0f} ms p50, "
               f"{median(latencies, *path, 'p95'):.0f} ms p95", "reported", None)
    chromium = result["chromium"]
    if chromium:
        yield ("from a tick to the page in Chromium: read-outs", f"{chromium['readouts']['p50']:.0f} ms p50, "
               f"{chromium['readouts']['p95']:.0f} ms p95", "reported", None)
    yield "memory at most", _memory(result), "reported", None


def _memory(result: dict) -> str:
    rows = result["cpu"]
    return ", ".join(f"{name} {max(row['memory_MB'][name] or 0.0 for row in rows):.0f} MB"
                     for name in ("viewer", "loop", "curves"))


def draw(result: dict, console: Console) -> None:
    """Print all tables, that of the targets last."""
    chromium = [result["chromium"]] if result["chromium"] else []
    table(console, "CPU ms of a frame: the viewer's process, the thread that makes frames, and the parts",
          ["case", "elements", "frames/s", "process", "thread p50", "p99", *_PARTS.values()],
          [[case, str(elements), f"{median(rows, 'frames') / median(rows, 'seconds'):.1f}",
            f"{median(rows, 'process_ms'):.2f}", *(f"{median(rows, 'frame_thread_ms', name):.2f}"
                                                   for name in ("p50", "p99")),
            *(f"{median(rows, 'parts_ms', part):.2f}" for part in _PARTS)]
           for (case, elements), rows in same(result["cpu"] + chromium).items()])
    runs = result["ticks"] + [{"case": "Chromium on the same processor", **row["ticks"]} for row in chromium]
    table(console, "Ticks of the loop, medians of the runs (smallest to largest): % missed and late, us",
          ["case", "runs", "missed", "late", "lateness p50", "p99", "step p50", "p99"],
          [[case, str(len(rows)), *(_spread(rows, name) for name in ("missed_percent", "late_percent")),
            *(f"{median(rows, name):.0f}" for name in ("lateness_us_p50", "lateness_us_p99", "compute_us_p50",
                                                       "compute_us_p99"))]
           for (case, _), rows in same(runs).items()])
    _latency(result, console)
    table(console, "What it must show", ["quantity", "measured", "target"],
          [[row["quantity"], row["measured"],
            row["target"] if row["met"] is None else verdict(row["met"], row["target"])] for row in result["targets"]])


def _spread(rows: list[dict], name: str) -> str:
    found = [row[name] for row in rows]
    return f"{statistics.median(found):.3f} ({min(found):.3f} to {max(found):.3f})"


def _latency(result: dict, console: Console) -> None:
    rows = result["latencies"]
    ways = {"picture: tick to client": ("pictures", "all"), "  tick to frame": ("pictures", "until_the_frame"),
            "  frame to sending": ("pictures", "until_sent"), "  sending to client": ("pictures", "until_arrived"),
            "read-outs: tick to client": ("readouts",)}
    found = [[name, f"{median(rows, *path, 'count'):.0f}", f"{median(rows, *path, 'p50'):.1f}",
              f"{median(rows, *path, 'p95'):.1f}"] for name, path in ways.items()]
    if result["chromium"]:
        seen = result["chromium"]["readouts"]
        found.append(["read-outs: tick to page in Chromium", str(seen["count"]), f"{seen['p50']:.1f}",
                      f"{seen['p95']:.1f}"])
    traffic = f"{median(rows, 'messages_per_s'):.0f} messages and {median(rows, 'kB_per_s'):.0f} kB a second"
    table(console, f"Age, ms; {traffic}",
          ["way", "counted", "p50", "p95"], found)
