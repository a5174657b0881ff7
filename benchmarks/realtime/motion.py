"""Irregular motion of a hand for a minute: faults, and time of a tick."""

import math
import time

import numpy as np

import tissue_sim as ts
from benchmarks.peers.friction import SPECIMEN
from benchmarks.peers.work_precision import MATERIAL, NEEDLE_RADIUS
from benchmarks.realtime.ticks import (
    BONDED,
    DEEPEST,
    DT,
    NEEDLE,
    TOLERANCE,
    count_statuses,
    no_garbage_collection,
    percentiles,
    say,
)
from haptics.devices.motions import RandomWalk
from tissue_sim.tool_force import ForceStatus

STICKING = ts.Model(ts.Experiment(SPECIMEN, ts.Protocol.ramp(DEEPEST, 21), tool=ts.Tool("flat", NEEDLE_RADIUS, 1e-3),
                                  friction="stick"), MATERIAL)
MODELS = {BONDED: NEEDLE, "stick, edge radius 1 mm": STICKING}
#: Wall time that a step may take, s.
BUDGETS = (None, 0.8e-3)
#: Largest change of force that the motion does not explain, N.
JUMP = 0.02
#: Seed of the motion of `tissue-sim loop`.
SEED = 0
#: Smallest depth of this motion, m.
HIGHEST = -0.2 * DEEPEST
#: Top speed of this motion, m/s.
TOP_SPEED = 0.2


def unexplained(force: np.ndarray, stiffness: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Return the change of force from tick to tick beyond that by the mean stiffness, N, shape (ticks - 1,)."""
    return np.abs(np.diff(force) - 0.5 * (stiffness[1:] + stiffness[:-1]) * np.diff(depth))


def walk(name: str, model: ts.Model, budget: float | None, count: int) -> dict:
    """Return the ticks of the random walk, without waiting between them."""
    say(f"{name}: {count} ticks of irregular motion, " + ("no budget" if budget is None else f"{budget * 1e3:g} ms"))
    simulator = ts.Simulator(model, inertia="off", budget=budget, tolerance=TOLERANCE)
    simulator.warm_up()
    source = RandomWalk(SEED, DEEPEST, HIGHEST, TOP_SPEED)
    ticks = []
    with no_garbage_collection():
        for k in range(count):
            depth = source.depth(k * DT)
            started = time.process_time()
            answer = simulator.step(depth, DT)
            ticks.append((depth, time.process_time() - started, answer.force, answer.stiffness, answer.iterations,
                          int(answer.status), answer.age))
    depth, cpu, force, stiffness, iterations, status, age = (np.array(column) for column in zip(*ticks, strict=True))
    number = np.isfinite(force) & np.isfinite(stiffness)
    jump = np.where(number[1:] & number[:-1], unexplained(force, stiffness, depth), math.inf)
    worst, slowest = int(jump.argmax()) + 1, int(cpu.argmax())
    settled = (status[1:] == ForceStatus.CONVERGED) & (status[:-1] == ForceStatus.CONVERGED)
    return {"case": name, "budget_ms": None if budget is None else budget * 1e3, "ticks": count,
            "elements": len(simulator.mesh.connectivity), "nan": int((~number).sum()),
            "statuses": count_statuses(status), "jumps": int((jump > JUMP).sum()),
            "jumps_between_converged": int((jump > JUMP)[settled].sum()), "largest_jump_N": float(jump.max()),
            "largest_jump_at": {"depth_mm": (depth[worst - 1: worst + 1] * 1e3).tolist(),
                                "force_N": force[worst - 1: worst + 1].tolist(),
                                "status": [ForceStatus(each).name.lower() for each in status[worst - 1: worst + 1]]},
            "lift_offs": int((np.diff((force > 0.0).astype(int)) < 0).sum()), "largest_age_ms": float(age.max() * 1e3),
            **percentiles(cpu), "newton_mean": float(iterations.mean()), "newton_max": int(iterations.max()),
            "worst_tick": {"depth_mm": float(depth[slowest] * 1e3), "cpu_ms": float(cpu[slowest] * 1e3),
                           "newton": int(iterations[slowest])}}


def irregular_motion(seconds: float) -> list[dict]:
    """Measure both needles, with and without a budget."""
    return [walk(name, model, budget, round(seconds / DT)) for name, model in MODELS.items() for budget in BUDGETS]
