"""Correct answers of a session of `soak`, from a replay of its motion without a time limit."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np

import tissue_sim as ts
from benchmarks.soak.page import PageSession
from benchmarks.soak.scenes import model_of
from benchmarks.soak.session import Session
from haptics.server.wire import Status

#: Allowed difference of a CONVERGED force from the replay, relative.
SHARE = 0.01
#: Allowed difference of a CONVERGED force from the replay, N.
NEWTONS = 0.02
#: For so long after a fault a step does not count as one without faults, s.
AFTER = 0.2
#: Longer than any tick that finds an equilibrium, s; without an equilibrium the search takes seconds.
PATIENCE = 0.05
#: For so long tissue remembers that it was not followed in time, s: four relaxation times of `soak_scenes.MATERIAL`.
REMEMBERS = 2.0


def score(session: Session, largest: float) -> dict:
    """Return counts and extremes of one session with a server, as plain values.

    Args:
        session: that was played.
        largest: force that no reply may exceed, N.
    """
    spent = [answered - asked for *_, asked, answered in (e for e in session.events if e[0] == "step")]
    return {"kind": "server", "flags": session.flags,
            **replay(model_of(session.flags), session.resolution, session.events, largest),
            "lost": session.lost, "round_trip_ms": _quantiles(spent),
            "ended_by": session.ended_by, "exit_code": session.exit_code,
            "words": [line for line in session.words.splitlines() if "Traceback" in line or "step failed" in line][:3]}


def score_page(session: PageSession, largest: float) -> dict:
    """Return counts and extremes of one session with the viewer; `loops` has those of each loop."""
    loops = []
    for (_, model, resolution), *events in (loop for loop in session.loops if loop):
        loops.append(replay(model, resolution, events, largest))
    return {"kind": "page", "flags": session.flags, "loops": loops, **_sums(loops),
            **{name: getattr(session, name) for name in ("frames", "asked", "refused", "unanswered", "taken", "killed",
                                                         "noticed_ms", "stale")}}


def _sums(loops: list[dict]) -> dict:
    """Sum the counts over all loops of a page."""
    return {"statuses": dict(sum((Counter(one["statuses"]) for one in loops), Counter())),
            "quiet": dict(sum((Counter(one["quiet"]) for one in loops), Counter())),
            **{name: sum(one[name] for one in loops) for name in ("compared", "wrong", "wrong_in_time", "beyond")},
            "largest_difference_N": max((one["largest_difference_N"] for one in loops), default=0.0),
            "recoveries_ms": [each for one in loops for each in one["recoveries_ms"]]}


def replay(model: ts.Model, resolution: str, events: list[tuple], largest: float) -> dict:
    """Step the same motion again without a budget, and compare the forces.

    Args:
        model, resolution: of the tissue that was played with.
        events: as in `soak_session.Session`, from undeformed tissue on.
        largest: force that no answer may exceed, N.
    """
    simulator = ts.Simulator(model, resolution=resolution, budget=PATIENCE)
    simulator.warm_up()
    began = simulator.model.material.parameters
    states: dict[str, tuple] = {}
    parameters: dict[str, float] = {}
    statuses, wrong, differences, quiet = Counter(), [], [], Counter()
    fault, waiting, recoveries, beyond, now = -math.inf, None, [], 0, 0.0
    # When the tissue was last not followed, by the clock of the session; of saved states too.
    behind, behind_of, wrong_in_time = -math.inf, {}, 0
    for event in events:
        match event:
            case ("reset",):
                simulator.reset()
                behind = -math.inf
            case ("parameters", values):
                parameters = {**parameters, **values}
                simulator.set_parameters(**values)
            case ("save", name):
                states[name] = simulator.save(), dict(parameters)
                behind_of[name] = now - behind
            case ("restore", name):
                state, kept = states[name]
                if kept != parameters:
                    first = {key: began[key] for key in parameters}
                    simulator.set_parameters(**{**first, **kept})
                    parameters = dict(kept)
                simulator.restore(state)
                behind = now - behind_of[name]
            case ("fault", what, when):
                fault = when
                waiting = (what, when)
            case ("step", time, depth, status, force, dt, limited, asked, _):
                now, name = asked, Status(status).name.lower()
                statuses[name] += 1
                beyond += not abs(force) <= largest * (1.0 + 1e-12)
                if status in (Status.REFUSED, Status.FAILED) or status >= Status.BUSY:
                    continue
                expected = simulator.step(depth, dt)
                if asked - fault > AFTER:
                    quiet[name] += 1
                if status not in (Status.CONVERGED, Status.RETURNING):
                    behind = asked
                if status != Status.CONVERGED:
                    continue
                if waiting is not None:
                    recoveries.append((asked - waiting[1], waiting[0]))
                    waiting = None
                if expected.status is ts.ForceStatus.CONVERGED and not limited:
                    difference = abs(force - expected.force)
                    differences.append(difference)
                    if difference > SHARE * abs(expected.force) + NEWTONS:
                        wrong.append({"time": time, "depth": depth, "force": force, "expected": expected.force})
                        wrong_in_time += asked - behind > REMEMBERS
    return {"resolution": resolution, "statuses": dict(statuses), "quiet": dict(quiet), "compared": len(differences),
            "wrong": len(wrong), "wrong_in_time": wrong_in_time, "first_wrong": wrong[:3], "beyond": beyond,
            "largest_difference_N": max(differences, default=0.0),
            "recoveries_ms": [round(1e3 * one, 1) for one, _ in recoveries],
            "slowest_recovery": max(recoveries, default=(0.0, ""))}


def _quantiles(seconds: list[float]) -> list[float]:
    return [round(1e3 * float(one), 3) for one in np.quantile(seconds or [0.0], [0.5, 0.99, 0.999, 1.0])]
