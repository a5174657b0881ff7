"""Random model under irregular motion with lift-off and a far too deep jump, tick by tick through `Simulator`.

What must hold: forces are numbers; every tick is in equilibrium, and is so by other means than the solver's; and after
all that, and some time in the air, the tissue pushes as that of a new simulator does. Where the work of a tick is
bounded, some are late: what they are told, and what the next equilibrium answers, is compared with ticks without bound.
"""

from __future__ import annotations

import statistics
import time
import traceback
from collections import Counter
from collections.abc import Sequence

import numpy as np

import tissue_sim as ts
from benchmarks.measure import table
from benchmarks.random_models.equilibrium_check import EquilibriumCheck
from benchmarks.random_models.generator import Description, build
from benchmarks.random_models.runs import Clock, OutOfTimeError, stratum
from haptics.devices.motions import RandomWalk
from tissue_sim.realtime.simulator import TOLERANCE

#: Number of ticks.
TICKS = 2000
#: Length of a tick, s.
DT = 1e-3
#: Ticks between two checked equilibria.
CHECKED = 25
#: Top speed, m/s.
SPEED = 0.2
#: Height of the lift-off, in depths of the model.
LIFT = 0.2
#: Length of a jump, in depths of the model.
JUMP = 2.0
#: Largest depth, as a fraction of the height.
DEEPEST = 0.6
#: Depth of the press at the end, in depths of the model.
AGAIN = 0.6
#: Steps of this press.
STEPS = 100
#: Height above the touch before this press, in depths of the model.
AWAY = 2.0
#: Duration of the rest at this height, s.
REST = 1e4
#: Largest difference of its forces, over the largest one, by which the tissue is as new.
AS_NEW = 0.01
#: Linear solves of a tick that are many.
MANY = 12
#: Ticks in which a bounded simulator catches up after the jump, at most.
CATCH_UP = 500


def motion(one: Description, resolution: str, max_solves: int | None = None) -> dict:
    """Play a random motion with a model, and return its result as plain values.

    Returns:
        stratum, law, extra, status ("end", "time-out" or "exception"), message, ticks, elements, nan, statuses,
        longest_ms (longest time without an equilibrium), solves (median, p99, largest), many (ticks of more than `MANY`
        solves), tick_ms (median, p99, largest), faults, recovered (difference, see `AS_NEW`); with `max_solves` also
        apart: largest difference of the forces from those without the bound, over the largest force, of equilibria and
        of late ticks.
    """
    clock = Clock()
    known = {"stratum": stratum(one), "law": one.law, "extra": list(one.extra), "status": "end", "message": ""}
    try:
        with clock.on():
            known |= _walk(one, resolution, clock, max_solves)
    except OutOfTimeError:
        known |= {"status": "time-out", "message": "the ticks took too long"}
    except Exception as error:
        known |= {"status": "exception", "message": "".join(traceback.format_exception_only(error)).strip()}
    return known


def _walk(one: Description, resolution: str, clock: Clock, max_solves: int | None) -> dict:
    model = build(one)
    check = EquilibriumCheck(model, TOLERANCE)
    simulator = ts.Simulator(model, resolution=resolution, inertia="off", max_solves=max_solves)
    simulator.warm_up()
    free = None if max_solves is None else ts.Simulator(model, resolution=resolution, inertia="off")
    unbounded = []
    with clock.off():
        check.before_first_step(simulator._solver)
    source = RandomWalk(one.seed, one.depth, -LIFT * one.depth, SPEED)
    places = [source.depth(k * DT) for k in range(TICKS)]
    jump = min(JUMP * one.depth, DEEPEST * one.height)
    places += [0.2 * one.depth, jump, 0.5 * one.depth, 0.25 * one.depth]
    answers, spent = [], []
    for k, place in enumerate(places):
        began = time.perf_counter()
        answer = simulator.step(place, DT)
        spent.append(1e3 * (time.perf_counter() - began))
        answers.append(answer)
        if free is not None and k < TICKS:
            unbounded.append(free.step(place, DT).force)
        touches = answer.status is ts.ForceStatus.CONVERGED and simulator.has_touched
        if touches and (k % CHECKED == 0 or k > TICKS):
            with clock.off():
                # On the way to where it jumped, too.
                check.largest = simulator._solver.committed.largest_force
                check.after_sample(simulator._solver, 1.0)
    for _ in range(CATCH_UP):
        if answers[-1].status is ts.ForceStatus.LATE:
            answers.append(simulator.step(places[-1], DT))
    if free is not None:
        free.restore(simulator.save())
    waits = np.cumsum([answer.status is ts.ForceStatus.CONVERGED for answer in answers[:TICKS]])
    solves = np.array([answer.iterations for answer in answers[:TICKS]])
    statuses = Counter(answer.status.name.lower() for answer in answers[:TICKS])
    return {"ticks": TICKS, "elements": len(simulator.mesh.connectivity),
            "nan": sum(not (np.isfinite(answer.force) and np.isfinite(answer.stiffness)) for answer in answers),
            "statuses": dict(statuses), "longest_ms": max(Counter(waits.tolist()).values()) - 1,
            "after_the_jump": answers[-1].status.name.lower(),
            "solves": [float(np.median(solves)), float(np.percentile(solves, 99)), int(solves.max())],
            "many": int((solves > MANY).sum()),
            "tick_ms": [float(np.median(spent)), float(np.percentile(spent, 99)), float(max(spent))],
            "faults": [f"{fault.check} {fault.value:.1e}" for fault in check.found.faults.values()],
            # Friction keeps what weighs where it came to lie.
            "recovered": 0.0 if "weight" in one.extra and not isinstance(model.experiment.resolved_base_interface, str)
            else _differs_from_new(model, free or simulator, resolution, one.depth),
            "apart": None if free is None else _apart(answers[:TICKS], unbounded)}


def _apart(answers: Sequence[ts.ToolForce], unbounded: Sequence[float]) -> list[float]:
    """Return the largest relative difference from forces without bound, of equilibria and of other answers."""
    expected = np.array(unbounded)
    apart = np.abs([answer.force for answer in answers] - expected) / max(float(np.abs(expected).max()), 1e-300)
    settled = np.array([answer.status is ts.ForceStatus.CONVERGED for answer in answers])
    return [float(apart[chosen].max(initial=0.0)) for chosen in (settled, ~settled)]


def _differs_from_new(model: ts.Model, used: ts.Simulator, resolution: str, depth: float) -> float:
    """Largest difference of forces from those of a new simulator over the largest, after a rest in the air; at the
    touch for a bonded tool."""
    new = ts.Simulator(model, resolution=resolution, inertia="off")
    away = 0.0 if model.experiment.friction == "bonded" else -AWAY * depth
    apart = largest = 0.0
    for place, dt in ((away, REST), (away, REST), *((depth * AGAIN * k / STEPS, 0.1) for k in range(1, STEPS + 1))):
        found, expected = (simulator.step(place, dt) for simulator in (used, new))
        if ts.ForceStatus.CONVERGED not in (found.status, expected.status):
            continue
        apart = max(apart, abs(found.force - expected.force))
        largest = max(largest, abs(expected.force))
        if found.status is not expected.status:
            return float("inf")
    return apart / max(largest, 1e-300)


def motion_figures(entries: Sequence[dict]) -> dict:
    """Return the figures of the results of `motion`."""
    ended = [entry for entry in entries if entry["status"] == "end"]

    def seeds(asked) -> list[int]:
        return [entry["seed"] for entry in ended if asked(entry)]

    counts = Counter()
    for entry in ended:
        counts.update(entry["statuses"])
    ticks = sum(counts.values())
    return {"models": len(entries), "ticks": ticks, "statuses": dict(counts),
            "did_not_end": {entry["seed"]: f"{entry['status']}: {entry['message']}"
                            for entry in entries if entry["status"] != "end"},
            "nan": seeds(lambda entry: entry["nan"]),
            "without_equilibrium": seeds(lambda entry: set(entry["statuses"]) != {"converged"}),
            "longest_ms": max((entry["longest_ms"] for entry in ended), default=0),
            "not_in_equilibrium": {entry["seed"]: entry["faults"] for entry in ended if entry["faults"]},
            "after_the_jump": seeds(lambda entry: entry["after_the_jump"] != "converged"),
            "not_as_new": {entry["seed"]: entry["recovered"] for entry in ended if not entry["recovered"] <= AS_NEW},
            "late": {entry["seed"]: [entry["statuses"]["late"], entry["longest_ms"], *entry["apart"]]
                     for entry in ended if "late" in entry["statuses"] and entry["apart"]},
            "not_as_unbounded": {entry["seed"]: entry["apart"][0] for entry in ended
                                 if entry["apart"] and entry["apart"][0] > AS_NEW},
            "many": sum(entry["many"] for entry in ended), "models_with_many": seeds(lambda entry: entry["many"]),
            "most_solves": max((entry["solves"][2] for entry in ended), default=0),
            "p50_ms": statistics.median([entry["tick_ms"][0] for entry in ended] or [0.0]),
            "largest_p50_ms": max((entry["tick_ms"][0] for entry in ended), default=0.0),
            "p99_ms": statistics.median([entry["tick_ms"][1] for entry in ended] or [0.0])}


def draw_motion(result: dict, console) -> None:
    """Print the tables of `motion_figures`."""
    found = result["figures"]

    def seeds(known) -> str:
        return " ".join(f"{seed} ({known[seed]})" if isinstance(known, dict) else str(seed) for seed in known) or "none"

    table(console, f"{found['models']} random models in irregular motion to {SPEED * 1e3:g} mm/s, "
          f"{result['resolution']}, {found['ticks']} ticks of {DT * 1e3:g} ms",
          ["", "models", "seeds"],
          [[name, str(len(known)), seeds(known)] for name, known in (
              ("did not come to the end", found["did_not_end"]), ("a force is not a number", found["nan"]),
              ("ticks without equilibrium", found["without_equilibrium"]),
              ("an equilibrium is none, by other means", found["not_in_equilibrium"]),
              (f"none after a jump to {JUMP:g} depths", found["after_the_jump"]),
              (f"differs by more than {AS_NEW:.0%} from a new one after it", found["not_as_new"]),
              (f"an equilibrium differs by more than {AS_NEW:.0%} from that without bound", found["not_as_unbounded"]),
              (f"ticks of more than {MANY} linear solves: {found['many']}", found["models_with_many"]))])
    if result["max_solves"] is not None:
        table(console, f"Late ticks with at most {result['max_solves']} linear solutions in each",
              ["seed", "late", "longest, ms", "equilibria apart, %", "late ones apart, %"],
              [[str(seed), str(count), str(longest), f"{100 * settled:.2g}", f"{100 * late:.2g}"]
               for seed, (count, longest, settled, late) in found["late"].items()])
    console.print(f"Ticks: {found['statuses']}; longest without equilibrium {found['longest_ms']} ms; at most "
                  f"{found['most_solves']} linear solves; a tick, median of models: {found['p50_ms']:.2f} ms "
                  f"(p99 {found['p99_ms']:.2f}), largest median {found['largest_p50_ms']:.2f} ms", highlight=False)
