"""Identities of the forces of elastic models on an ideal rig, which hold for any solver.

A force that is homogeneous of degree one in the law's moduli is the sum of each modulus times its derivative (K/mu
held); what is computed again comes out the same; forces grow with the square of lengths and with moduli; and a closed
way of the tool gives no work away.
"""

from __future__ import annotations

import numpy as np

import tissue_sim as ts
from benchmarks.random_models.generator import Description, build
from benchmarks.random_models.runs import Clock, OutOfTimeError

#: Accepted difference of Euler's identity, over the largest force.
EULER = 1e-6
#: Accepted difference between scaled models, over the largest force.
SCALED = 1e-9
#: Accepted difference of the work, over the work done by the tool.
WORK = 1e-6
#: Name -> factor of lengths, factor of stresses.
SCALES = {"lengths x 2, stresses x 4": (2.0, 4.0), "lengths x 3, stresses x 7": (3.0, 7.0)}
IDENTITIES = ("the test reaches the end", "sum of moduli times derivatives", "the same again, bit for bit",
              "reset is a new simulator, bit for bit", *SCALES, "no work from a closed way")


def applies(one: Description) -> bool:
    """Return whether a model is elastic, on an ideal rig."""
    return not {"prony", "rig"} & set(one.extra)


def identities(one: Description, resolution: str) -> dict[str, dict]:
    """Name -> {"passed", "value", "message"} of those of `IDENTITIES` that this model can be asked for; value is the
    difference as the constants above state it."""
    found: dict[str, dict] = {}

    def ask(name, value_of, limit) -> None:
        """Evaluate one identity; an exception or a time-out fails it."""
        try:
            with Clock().on():
                value, message = float(value_of()), ""
        except (ts.ConvergenceError, ts.InputError, OutOfTimeError) as error:
            value, message = np.inf, str(error) or "time-out"
        except Exception as error:
            value, message = np.inf, repr(error)
        found[name] = {"passed": bool(value <= limit), "value": value, "message": message}

    if not applies(one):
        return found
    model, force = build(one), np.zeros(0)

    def whole():
        nonlocal force
        force = ts.simulate(model, resolution=resolution, estimate_error=False).force
        return 0.0

    end, euler, again, reset, *_, work = IDENTITIES
    ask(end, whole, 0.0)
    if not found[end]["passed"]:
        return found
    largest = max(float(np.abs(force).max()), 1e-300)
    if "weight" not in one.extra:  # weight is a separate force
        ask(euler, lambda: _euler(model, resolution) / largest, EULER)
    ask(again, lambda: np.abs(
        ts.simulate(model, resolution=resolution, estimate_error=False).force - force).max() / largest, 0.0)
    ask(reset, lambda: _reset(model, resolution) / largest, 0.0)
    for name, (size, strength) in SCALES.items():
        def apart(size=size, strength=strength):
            larger = ts.simulate(build(one, 1, size, strength), resolution=resolution,
                                 estimate_error=False).force
            return np.abs(larger / (size**2 * strength) - force).max() / largest

        ask(name, apart, SCALED)
    way = model.experiment.protocol.displacement
    if way[-1] == way[0]:
        parts = 0.5 * (force[1:] + force[:-1]) * np.diff(way)
        put_in = max(float(parts[parts > 0].sum()), 1e-300)
        ask(work, lambda: -parts.sum() / put_in, WORK)
    return found


def _euler(model: ts.Model, resolution: str) -> float:
    """Return the largest difference between the force and the sum of moduli times derivatives, N (Euler's theorem)."""
    law, parameters = model.material.energy_law, model.material.parameters
    moduli = [name for name in law.parameters if law.units[name] == "Pa"]
    answer = ts.sensitivities(model, moduli, resolution=resolution)
    return float(np.abs(answer.values @ [parameters[name] for name in moduli] - answer.recording.force).max())


def _reset(model: ts.Model, resolution: str) -> float:
    """Return the difference between the forces after a reset and those of a new simulator, N.

    0 if all bits are equal; infinite if a status or another part of an answer differs."""
    protocol = model.experiment.protocol
    steps = list(zip(protocol.displacement.tolist(), np.diff(protocol.time, prepend=0.0).tolist(), strict=True))

    def answers(simulator: ts.Simulator) -> list:
        said = [simulator.step(place, dt) for place, dt in steps]
        return [(one.wrench, one.stiffness_matrix, one.status, one.iterations, one.residual) for one in said]

    used = ts.Simulator(model, resolution=resolution)
    answers(used)
    used.reset()
    after, new = answers(used), answers(ts.Simulator(model, resolution=resolution))
    if after == new:
        return 0.0
    return max(abs(a[0][2] - b[0][2]) for a, b in zip(after, new, strict=True)) or np.inf
