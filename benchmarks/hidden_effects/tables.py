"""Tables of the hidden-effect study; the peer methods in the same tables."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from rich.console import Console

from benchmarks.hidden_effects.cases import hidden, outside
from benchmarks.hidden_effects.scoring import Run, error_against_coverage, outcome, score, share
from benchmarks.hidden_effects.sizes import frozen
from benchmarks.hidden_effects.truth import C10, C20
from benchmarks.measure import table

TRUTH = {"C10": C10, "C20": C20}


def peers(runs: Sequence[Run]) -> dict:
    """Return bias, wrong names, coverage and log score of the usual methods in runs with one hidden effect or none."""
    runs = [run for run in runs if "peers" in run and run["room"] in ("hidden", "none")]
    hidden, empty = [run for run in runs if run["effects"]], [run for run in runs if not run["effects"]]
    shown = [run for run in hidden if run["testable"] and run["signal"] >= 3.0]
    answer: dict = {}
    for name in ("least squares", "Gaussian process", "ours"):
        rows = [(run, _moduli(run, name)) for run in shown]
        answer[name] = {
            parameter: {"error": float(np.sqrt(np.mean([(found[parameter][0] / value - 1) ** 2
                                                        for _, found in rows]))) if rows else None,
                        "covered": share([found for _, found in rows if found[parameter][1]],
                                         lambda found, parameter=parameter, value=value:
                                         abs(found[parameter][0] - value) <= 1.96 * found[parameter][1])}
            for parameter, value in TRUTH.items()}
    answer["least squares"]["R2, median"] = float(np.median([run["peers"]["least squares"]["R2"] for run in shown])) \
        if shown else None
    said = [(run, run["peers"]["BIC"]["name"]) for run in shown]
    answer["BIC"] = {
        "unique and right": share(said, lambda pair: pair[1] in pair[0]["effects"]),
        "unique and wrong": share(said, lambda pair: pair[1] not in (*pair[0]["effects"], "NONE")),
        "false alarm": share(empty, lambda run: run["peers"]["BIC"]["name"] != "NONE"),
        "log score": float(np.mean([_bet(run) for run in runs])) if runs else None,
        "error against coverage": error_against_coverage(
            shown, [_sureness(run) for run, _ in said], [name not in run["effects"] for run, name in said])}
    answer["ours"] |= {
        "unique and right": share(shown, lambda run: outcome(run) == "right"),
        "unique and wrong": share(shown, lambda run: outcome(run) == "wrong"),
        "false alarm": share(empty, lambda run: outcome(run) != "none")}
    return answer


def _moduli(run: Run, name: str) -> dict[str, list]:
    if name == "ours":
        return run["fit_after"] or run["fit_before"]
    found = run["peers"][name]
    return {parameter: [found["moduli"][k], found["errors"][k]] for k, parameter in enumerate(TRUTH)}


def _shares(run: Run) -> dict[str, float]:
    """Return the probabilities by BIC over the catalogue and the answer without an effect."""
    gains = {"NONE": 0.0, **run["peers"]["BIC"]["gains"]}
    top = max(gains.values())
    weights = {name: math.exp(max(0.5 * (gain - top), -700.0)) for name, gain in gains.items()}
    return {name: weight / sum(weights.values()) for name, weight in weights.items()}


def _sureness(run: Run) -> float | None:
    name = run["peers"]["BIC"]["name"]
    return None if name == "NONE" else _shares(run)[name]


def _bet(run: Run) -> float:
    """Return the log score of the probabilities by BIC, with the same floor as for the diagnosis."""
    answers = len(run["catalogue"]) + 2
    right = run["effects"][0] if run["effects"] else "NONE"
    return math.log(0.95 * _shares(run).get(right, 0.0) + 0.05 / answers)


def figures(runs: Sequence[Run]) -> dict:
    """Return the figures of each protocol with those of the usual methods, and the runs without a verdict."""
    answer = {}
    for protocol in dict.fromkeys(run["protocol"] for run in runs):
        mine = [run for run in runs if run["protocol"] == protocol]
        good = [run for run in mine if "failure" not in run]
        answer[protocol] = {"runs": len(mine), "no verdict": [f"{run['name']}: {run['failure']}" for run in mine
                                                              if "failure" in run],
                            **score(good, TRUTH), "peers": peers(good),
                            "wall_s": float(np.median([run["wall_s"] for run in mine]))}
    return answer


def cases_in_words() -> str:
    """Return the hidden effects as a Markdown table: sizes, sources, and the largest ratio of signal to noise."""
    table_of = frozen()
    heads = ("effect, form", "smallest to largest", "source", "curves", "largest signal: ramps", "full",
             "twins: ramps", "full")
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for key, case in {**hidden(), **outside()}.items():
        rows = [table_of[name].get(key) for name in ("ramps", "full")]
        if case.effect == "population":
            rows = [table_of["animals"][key], None]
        signals = ["-" if row is None else f"{row['signal_at_most']:.3g}{'' if row['testable'] else ' (not testable)'}"
                   for row in rows]
        twins = [", ".join(row.get("twins", [])) if row else "" for row in rows]
        words = f"`{case.effect}`, {case.form}" if case.effect else f"{case.form} (in no catalogue)"
        lines.append(f"| {words} | {case.low:g} to {case.high:g} {case.unit} | {case.source} | {case.origin} | "
                     f"{' | '.join([*signals, *twins])} |")
    return "\n".join(lines)


def in_words(row: dict | float | None) -> str:
    """Format a fraction: ``12 % (3 to 25), 5 of 40``."""
    if isinstance(row, dict):
        if not row["of"]:
            return "-"
        return (f"{100 * row['share']:.1f} % ({100 * row['low']:.1f} to {100 * row['high']:.1f}), {row['hits']} of "
                f"{row['of']}")
    return "-" if row is None else f"{row:.3g}"


def draw(result: dict, console: Console) -> None:
    """Print all tables of a result."""
    console.print(f"hash {result['hash'][:12]}, {result['seeds']} seeds")
    for protocol, found in result["figures"].items():
        console.print(f"[bold]{protocol}[/]: {found['runs']} runs, {found['wall_s']:.0f} s each (median), "
                      f"{len(found['no verdict'])} without a verdict")
        for part in ("exact", "other form"):
            groups = found[part]
            if groups:
                rows = [[name, *(in_words(group[name]) for group in groups.values())]
                        for name in next(iter(groups.values()))]
                table(console, f"{protocol}: hidden, {part}, by projected signal over noise", ["", *groups], rows)
        rows = [[f"{part}: {name}", in_words(row)]
                for part in ("nothing hidden", "outside, unlike", "outside, look-alikes left in", "pairs",
                             "held-out replicate", "held-out test") for name, row in found[part].items()]
        rows += [["sensor_gain, right", in_words(found["sensor_gain"])],
                 ["said at 20 : 1, wrong", in_words(found["said at 20 : 1"])],
                 *([f"log score, {room}", f"{value:.2f}"] for room, value in found["log score"].items())]
        for name, row in found["bias"].items():
            rows.append([f"{name}, error before -> after naming (smaller by)",
                         f"{in_words(row['before'])} -> {in_words(row['after'])} ({in_words(row['smaller'])})"])
            rows.append([f"{name}, 95 % interval holds", in_words(row["covered"])])
        table(console, f"{protocol}: other figures", ["", "share (95 % interval)"], rows)
        table(console, f"{protocol}: of the best at this share of the evidence, right", ["share", "right"],
              [[f"{row['from']:g} to {row['to']:g}", in_words(row)] for row in found["words"]])
        draw_peers(found["peers"], protocol, console)


def draw_peers(found: dict, protocol: str, console: Console) -> None:
    """Print the usual methods compared with the diagnosis, for testable effects with a signal of at least 3."""
    rows = [[name, *(in_words(found[name][parameter][what]) for parameter in TRUTH for what in ("error", "covered"))]
            for name in ("least squares", "Gaussian process", "ours")]
    table(console, f"{protocol}: moduli with an effect hidden (root mean square error, relative; 95 % interval holds)",
          ["", *(f"{parameter}, {what}" for parameter in TRUTH for what in ("error", "covered"))], rows)
    table(console, f"{protocol}: names", ["", "unique and right", "unique and wrong", "false alarm"],
          [[name, *(in_words(found[name][what]) for what in ("unique and right", "unique and wrong", "false alarm"))]
           for name in ("BIC", "ours")])
