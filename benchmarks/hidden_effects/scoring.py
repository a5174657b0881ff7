"""Scores of the hidden-effect study with their intervals.

A run is a plain dictionary, as `hidden_effects_run.run_one` returns it and as its line in the results file says it.
"""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence

import numpy as np

Run = dict
#: A set of more names says too little; stated twins of the truth are not counted.
LARGEST_SET = 3
#: Probability shared by all answers that a verdict leaves out.
LEFT = 0.05
#: Probability of a form that is not confirmed.
UNCONFIRMED = 0.25
#: Levels of the diagram of words.
LEVELS = (0.0, 0.5, 0.75, 0.9, 0.95, 0.99, 1.0)
ANSWERS = ("NONE", "UNKNOWN")


def wilson(hits: int, of: int, deviations: float = 1.959964) -> tuple[float, float]:
    """Return the 95 % interval of a fraction (Wilson 1927)."""
    if not of:
        return 0.0, 1.0
    share, z2 = hits / of, deviations**2
    middle = share + z2 / (2 * of)
    half = deviations * math.sqrt(share * (1 - share) / of + z2 / (4 * of * of))
    scale = 1 + z2 / of
    return max(0.0, (middle - half) / scale), min(1.0, (middle + half) / scale)


def base(name: str) -> str:
    """Return the name of an effect without the test in which it acts."""
    return name.partition("@")[0]


def reported(run: Run) -> list[str]:
    """Return the effects that a verdict considers possible, each once."""
    names = [*run["named"], *run["indistinguishable"]] if run["verdict"] in ("NAMED", "SET", "LOOKS_LIKE") else []
    return list(dict.fromkeys(map(base, names)))


def size_of_set(run: Run) -> int:
    """Return the number of names in a set, without effects that are stated to be equivalent to the truth."""
    return sum(name in run["effects"] or name not in run["twins"] for name in reported(run))


def outcome(run: Run) -> str:
    """``right``, ``set`` (truth in it, three names or fewer), ``long set`` (truth among more), ``wrong`` (a unique
    name, or one of two, that is not there), ``wrong set``, ``looks right``, ``looks wrong``, ``unknown``
    or ``none``."""
    truth, names, verdict = set(run["effects"]), reported(run), run["verdict"]
    if verdict in ANSWERS:
        return verdict.lower()
    if verdict == "SET" and len(names) > 1:
        if not truth <= set(names):
            return "wrong set"
        return "set" if size_of_set(run) <= LARGEST_SET else "long set"
    if verdict == "LOOKS_LIKE":
        return "looks right" if set(names) <= truth and names else "looks wrong"
    # Candidates of one effect in several tests are one name.
    return "right" if set(names) == truth else "wrong"


def in_reported(run: Run) -> bool:
    return set(run["effects"]) <= set(reported(run)) and outcome(run) != "long set"


def share(runs: Sequence[Run], is_hit: Callable[[Run], bool]) -> dict:
    """Return a fraction with its 95 % interval and the number of runs."""
    hits = sum(map(is_hit, runs))
    low, high = wilson(hits, len(runs))
    return {"hits": hits, "of": len(runs), "share": hits / len(runs) if runs else None, "low": low, "high": high}


def probabilities(run: Run) -> dict[str, float]:
    """Return the probability that a verdict assigns to each answer.

    The reported answers share 1 - `LEFT`, those of a set in proportion to their evidence; all answers share `LEFT`.
    """
    verdict, names = run["verdict"], reported(run)
    bets: dict[str, float] = defaultdict(float)
    if verdict in ANSWERS:
        bets[verdict] = 1.0
    elif verdict == "SET":
        for name in names:
            bets[name] = max(run["weights"].get(name, 0.0), 1e-3)
    else:
        for name in names:
            bets[name] = (1.0 - UNCONFIRMED if verdict == "LOOKS_LIKE" else 1.0) / len(names)
        if verdict == "LOOKS_LIKE":
            bets["UNKNOWN"] = UNCONFIRMED
    total, answers = sum(bets.values()), [*run["catalogue"], *ANSWERS]
    return {answer: (1.0 - LEFT) * bets.get(answer, 0.0) / total + LEFT / len(answers) for answer in answers}


def truths(run: Run) -> list[str]:
    """Return the right answers of a run."""
    if run["room"] == "none":
        return ["NONE"]
    return run["effects"] or ["UNKNOWN"]


def log_score(run: Run) -> float:
    """Return the mean logarithm of the probability of the right answers; 0 is perfect."""
    bets = probabilities(run)
    return float(np.mean([math.log(bets.get(answer, LEFT / (len(bets) + 1))) for answer in truths(run)]))


def confidence(run: Run) -> float | None:
    """Return the fraction of the evidence of the best candidate; None: nothing is reported."""
    names = reported(run)
    weights = run["weights"]
    if not names or not weights:
        return None
    return max(weights.get(name, 0.0) for name in names) / sum(weights.values())


def words(runs: Iterable[Run]) -> list[dict]:
    """Return how often the best candidate was right, by levels of its fraction of the evidence."""
    rows = []
    said = [(confidence(run), run) for run in runs]
    for low, high in itertools.pairwise(LEVELS):
        inside = [run for level, run in said if level is not None and low <= level and (level < high or high == 1.0)]
        rows.append({"from": low, "to": high, **share(inside, lambda run: best_of(run) in run["effects"])})
    return rows


def best_of(run: Run) -> str:
    """Return the most likely reported effect."""
    return max(reported(run), key=lambda name: run["weights"].get(name, 0.0))


def said_at_20_to_1(runs: Iterable[Run]) -> dict:
    """Return the fraction of wrong verdicts among those that exclude all others by 20 : 1 or more (a unique name)."""
    return share([run for run in runs if outcome(run) in ("right", "wrong")], lambda run: outcome(run) == "wrong")


def error_against_coverage(runs: Sequence[Run], confidences: Sequence[float | None],
                           wrongs: Sequence[bool]) -> list[tuple[float, float]]:
    """Return the fraction of wrong unique names over the fraction of runs answered, in order of confidence."""
    ranked = sorted((level, wrong) for level, wrong in zip(confidences, wrongs, strict=True) if level is not None)
    answers, errors = [], 0
    for count, (_, wrong) in enumerate(reversed(ranked), start=1):
        errors += wrong
        answers.append((count / max(len(runs), 1), errors / count))
    return answers


def bias(runs: Iterable[Run], truth: dict[str, float]) -> dict:
    """Return the relative rms error of the moduli before and after, and the coverage of the 95 % intervals.

    Args:
        runs: runs that named the hidden effect. truth: name -> true modulus, Pa.
    """
    answer: dict = {}
    named = [run for run in runs if run["fit_after"] is not None]
    for name, value in truth.items():
        before = [run["fit_before"][name][0] / value - 1 for run in named]
        after = [run["fit_after"][name][0] / value - 1 for run in named]
        inside = [run for run in named if run["fit_after"][name][1]]
        sizes = [float(np.sqrt(np.mean(np.square(errors)))) if errors else None for errors in (before, after)]
        answer[name] = {
            "before": sizes[0], "after": sizes[1], "smaller": sizes[0] / sizes[1] if sizes[0] and sizes[1] else None,
            "covered": share(inside, lambda run, name=name, value=value: abs(run["fit_after"][name][0] - value)
                             <= 1.96 * run["fit_after"][name][1])}
    return answer


def held_out(runs: Iterable[Run], kind: str) -> dict:
    """For runs that named an effect: fractions whose held-out residual is not noise, and whose error fell."""
    rows = [row for run in runs for row in run["held_out"] if row["kind"] == kind and row["adequate_after"] is not None]
    return {"rejects": share(rows, lambda row: not row["adequate_after"]),
            "fell": share(rows, lambda row: row["after_N"] < row["before_N"])}


def by_class(runs: Sequence[Run]) -> dict[str, list[Run]]:
    """Group runs by class of size; ``testable`` holds the classes of 3 and more."""
    groups: dict[str, list[Run]] = defaultdict(list)
    for run in runs:
        groups[run["class"]].append(run)
        if run["testable"] and run["signal"] >= 3.0:
            groups["testable, 3 and more"].append(run)
    return dict(groups)


def identified(runs: Sequence[Run]) -> dict:
    """Return the figures of runs with one hidden effect in a form of the catalogue."""
    sets = [size_of_set(run) for run in runs if outcome(run) == "set"]
    return {
        "unique and right": share(runs, lambda run: outcome(run) == "right"),
        "truth in the reported set": share(runs, in_reported),
        "unique and wrong": share(runs, lambda run: outcome(run) == "wrong"),
        "looks like, right": share(runs, lambda run: outcome(run) == "looks right"),
        "wrong set or likeness": share(runs, lambda run: outcome(run) in ("wrong set", "looks wrong")),
        "long set": share(runs, lambda run: outcome(run) == "long set"),
        "unknown": share(runs, lambda run: outcome(run) == "unknown"),
        "says none": share(runs, lambda run: outcome(run) == "none"),
        "median names of a set": float(np.median(sets)) if sets else None}


def gains(runs: Sequence[Run]) -> dict:
    """Return the figures of `sensor_gain`, which no test separates from C10: right in a set, or not testable."""
    return share(runs, lambda run: outcome(run) == "set" or ("sensor_gain" in run["not_testable"]
                                                          and outcome(run) in ("none", "unknown")))


def score(runs: Sequence[Run], truth: dict[str, float]) -> dict:
    """Return all figures of the runs of one protocol.

    Args:
        runs: of one hash of the code. truth: the moduli.
    """
    rooms: dict[str, list[Run]] = defaultdict(list)
    for run in runs:
        rooms[run["room"]].append(run)
    one = [run for run in rooms["hidden"] if run["effects"] != ["sensor_gain"]]
    exact, other = [run for run in one if run["form"] == "exact"], [run for run in one if run["form"] != "exact"]
    right = [run for run in exact if outcome(run) == "right" and run["signal"] >= 3.0]
    named = [run for run in [*one, *rooms["pair"]] if outcome(run) == "right"]
    levels = [confidence(run) if outcome(run) in ("right", "wrong") else None for run in one]
    return {
        "exact": {name: identified(group) for name, group in by_class(exact).items()},
        "other form": {name: {
            "right kind": share(group, lambda run: outcome(run) in ("right", "looks right")),
            "wrong": share(group, lambda run: outcome(run) in ("wrong", "looks wrong", "wrong set")),
            "in the set": share(group, in_reported), "unknown": share(group, lambda run: outcome(run) == "unknown"),
            "says none": share(group, lambda run: outcome(run) == "none")} for name, group in by_class(other).items()},
        "nothing hidden": {name: share([run for run in rooms["none"] if run["scatter"]["coloured"] == coloured],
                                       lambda run: outcome(run) != "none")
                           for name, coloured in (("white", False), ("correlated", True))},
        "outside, unlike": {"abstains": share(rooms["outside"], lambda run: outcome(run) in ("unknown", "none")),
                            # It abstains, and says that nothing is missing: that is more than it knows.
                            "says none": share(rooms["outside"], lambda run: outcome(run) == "none"),
                            "unique name": share(rooms["outside"], lambda run: outcome(run) == "wrong")},
        "outside, look-alikes left in": {
            "abstains": share(rooms["look-alike"], lambda run: outcome(run) in ("unknown", "none")),
            "wrong unique name": share(rooms["look-alike"], lambda run: outcome(run) == "wrong")},
        "pairs": {"both in the set": share(rooms["pair"], in_reported),
                  "both named": share(rooms["pair"], lambda run: outcome(run) == "right"),
                  "unique and wrong": share(rooms["pair"], lambda run: outcome(run) == "wrong")},
        "sensor_gain": gains([run for run in rooms["hidden"] if run["effects"] == ["sensor_gain"]]),
        "held-out replicate": held_out(named, "replicate"), "held-out test": held_out(named, "test"),
        "bias": bias(right, truth), "words": words(one), "said at 20 : 1": said_at_20_to_1(runs),
        "log score": {room: float(np.mean(list(map(log_score, group)))) for room, group in rooms.items()
                      if group},
        "error against coverage": error_against_coverage(one, levels, [outcome(run) == "wrong" for run in one])}
