"""Figures and tables of the runs of random models."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Sequence

from benchmarks.hidden_effects.scoring import wilson
from benchmarks.measure import table
from benchmarks.random_models.equilibrium_check import CHECKS
from benchmarks.random_models.identities import IDENTITIES
from benchmarks.random_models.runs import ENDS

#: Difference with shorter steps that is worth a warning, over the largest force.
APART = 0.03
#: Difference with shorter steps that is not worth a warning, over the largest force.
TOGETHER = 0.01
#: A warning is right where the error that it states is wrong by no more than this factor.
RIGHT = 2.0


def figures(entries: Sequence[dict]) -> dict:
    """Return the figures of the runs of `random_models`."""
    strata = sorted({entry["stratum"] for entry in entries}, key=lambda name: ("plates" not in name, name))
    rows = {name: _row([entry for entry in entries if entry["stratum"] == name]) for name in strata}
    cpu = [entry["cpu_s"] for entry in entries] or [0.0]
    failures = [{name: entry[name] for name in ("seed", "stratum", "status", "message")}
                for entry in entries if entry["status"] != "end"]
    checks = {name: {"seeds": [entry["seed"] for entry in entries
                               if any(fault["check"] == name for fault in entry["faults"])],
                     "worst": max((entry["worst"][name] for entry in entries if name in entry["worst"]), default=0.0)}
              for name in CHECKS}
    found = {"strata": rows, "in_all": _row(entries), "failures": failures, "checks": checks,
             "early": [entry["seed"] for entry in entries if entry["early"] > 1.0],
             "newton_iterations": sum(entry["newton_iterations"] for entry in entries),
             "cuts": sum(entry["cuts"] for entry in entries), "cpu_s": sum(cpu),
             "cpu_median_s": statistics.median(cpu), "cpu_largest_s": max(cpu)}
    quarters = [(entry, entry["quarter"]["difference"]) for entry in entries
                if "difference" in entry.get("quarter", {})]
    if any("quarter" in entry for entry in entries):
        found["quarter"] = {
            "compared": len(quarters),
            "finer_failed": [entry["seed"] for entry in entries
                             if entry["status"] == "end" and entry["quarter"]["status"] != "end"],
            "apart_unwarned": [entry["seed"] for entry, apart in quarters if apart > APART and not entry["warnings"]],
            "apart_warned": [entry["seed"] for entry, apart in quarters if apart > APART and entry["warnings"]
                             and _is_known(entry) and apart / RIGHT <= entry["force_error"] <= apart * RIGHT],
            "apart_misjudged": [entry["seed"] for entry, apart in quarters if apart > APART and entry["warnings"]
                                and _is_known(entry) and not apart / RIGHT <= entry["force_error"] <= apart * RIGHT],
            "unknown": [entry["seed"] for entry, _ in quarters if not _is_known(entry)],
            "together": sum(apart <= TOGETHER for _, apart in quarters),
            "together_warned": [entry["seed"] for entry, apart in quarters if apart <= TOGETHER and entry["warnings"]],
            "largest": max((apart for _, apart in quarters), default=0.0)}
    return found


def _is_known(entry: dict) -> bool:
    """Whether the error of the force was estimated up to the last sample."""
    return entry["force_error"] is not None


def _row(entries: Sequence[dict]) -> dict:
    ends = Counter(entry["status"] for entry in entries)
    return {"models": len(entries), **{end: ends[end] for end in ENDS}, "interval": wilson(ends["end"], len(entries)),
            "not_in_equilibrium": sum(bool(entry["faults"]) for entry in entries),
            "warned": sum(bool(entry["warnings"]) for entry in entries),
            "newton_iterations": sum(entry["newton_iterations"] for entry in entries),
            "cpu_s": sum(entry["cpu_s"] for entry in entries)}


def draw_runs(result: dict, console) -> None:
    """Print the tables of `figures`."""
    found = result["figures"]

    def cells(name: str, row: dict) -> list[str]:
        low, high = row["interval"]
        share = f"{100 * row['end'] / max(row['models'], 1):.1f} ({100 * low:.1f} to {100 * high:.1f})"
        counts = [str(row[key]) for key in ("models", *ENDS)]
        return [name, *counts, share, *(str(row[key]) for key in ("not_in_equilibrium", "warned",
                                                                  "newton_iterations")), f"{row['cpu_s']:.1f}"]

    table(console, f"Random models, {result['resolution']}; how their tests end (95 % interval, Wilson)",
          ["tool, face", "models", *ENDS, "reach the end, %", "no equilibrium", "warned", "solves", "CPU, s"],
          [*(cells(*item) for item in found["strata"].items()), cells("all", found["in_all"])])
    console.print(f"CPU: {found['cpu_s']:.1f} s in all, median {found['cpu_median_s']:.2f} s, at most "
                  f"{found['cpu_largest_s']:.1f} s; linear solves: {found['newton_iterations']}; steps cut: "
                  f"{found['cuts']}")
    table(console, "Equilibria, by other means than the solver's", ["check", "models that fail", "worst", "seeds"],
          [[name, str(len(one["seeds"])), f"{one['worst']:.2g}", _numbers(one["seeds"])]
           for name, one in found["checks"].items()])
    for name, said in CHECKS.items():
        console.print(f"{name}: {said}", highlight=False)
    console.print(f"The iteration ended before the rounding that is seen asks for it: {_numbers(found['early'])}")
    if "quarter" in found:
        quarter = found["quarter"]
        console.print(
            f"Steps a quarter as long: {quarter['compared']} models reach the end both ways, and differ by at most "
            f"{quarter['largest']:.1%} of the largest force.\n"
            f"By more than {APART:.0%} without a warning: {_numbers(quarter['apart_unwarned'])}; with a "
            f"right one: {_numbers(quarter['apart_warned'])}; with one that is wrong by more than {RIGHT:g} times: "
            f"{_numbers(quarter['apart_misjudged'])}.\nError unknown: {_numbers(quarter['unknown'])}.\n"
            f"Within {TOGETHER:.0%}: {quarter['together']}, of which warned: "
            f"{_numbers(quarter['together_warned'])}.\nOnly the longer steps reach the end: "
            f"{_numbers(quarter['finer_failed'])}.")
    for failure in found["failures"]:
        console.print(f"{failure['seed']} ({failure['stratum']}) {failure['status']}: {failure['message']}",
                      markup=False, highlight=False)


def _numbers(seeds: Sequence[int]) -> str:
    return " ".join(map(str, seeds)) or "none"


def identity_figures(entries: Sequence[dict]) -> dict:
    """Return for each identity the numbers tested and passed, the failed seeds, and the largest other difference."""
    found = {}
    for name in IDENTITIES:
        asked = [(entry["seed"], entry["identities"][name]) for entry in entries if name in entry["identities"]]
        found[name] = {"asked": len(asked), "passed": sum(one["passed"] for _, one in asked),
                       "failed": {seed: one["message"] or one["value"] for seed, one in asked if not one["passed"]},
                       "largest": max((one["value"] for _, one in asked if one["passed"]), default=0.0)}
    return found


def draw_identities(result: dict, console) -> None:
    """Print the table of `identity_figures`."""
    table(console, f"What must hold of any solver: elastic random models, ideal rig, {result['resolution']}",
          ["identity", "passes / total", "largest difference of those", "seeds that fail"],
          [[name, f"{one['passed']} / {one['asked']}", f"{one['largest']:.1e}", _numbers(list(one["failed"]))]
           for name, one in result["figures"].items()])
    for name, one in result["figures"].items():
        for seed, said in one["failed"].items():
            console.print(f"{seed}, {name}: {said}", markup=False, highlight=False)
