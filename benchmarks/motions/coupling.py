"""A light tool on a servo, coupled explicitly to a simulator: pose in, force out, once a tick.

A tissue with mass makes this coupling unstable below some mass of the tool (added-mass instability: Causin, Gerbeau
and Nobile, Comput. Methods Appl. Mech. Eng. 194 (2005) 4506). The unstable solution alternates from tick to tick; the
slow free oscillation of a tissue on a servo does not. A force that alternates in a hold is silently wrong unless the
answers stated a larger `least_tool_mass`.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np

import tissue_sim as ts
from benchmarks.motions.judge import Judgement, Verdict
from benchmarks.motions.scenes import Scene, axisymmetric_scene, simulator

#: Ticks of the ramp to the depth, and of the hold.
RAMP_TICKS = 60
#: Ticks of the hold.
HOLD_TICKS = 300
#: Ticks at the end of the hold in which the tool must be at rest.
JUDGED_TICKS = 40
#: Largest alternation of the force there, peak to peak, over its mean.
LARGEST_SWING = 0.05
#: Height from which the tool starts, m.
START_HEIGHT = 1e-3


@dataclass(frozen=True)
class Coupling:
    """A tool on a servo above a scene.

    Attributes:
        scene: what is simulated; mass: of the tool, kg; servo: stiffness of the servo, N/m; dt: tick, s.
    """

    scene: Scene
    mass: float
    servo: float
    dt: float
    trap: str = "light tool"


def light_tool(chance: np.random.Generator) -> Coupling:
    """Draw a tool of 0.5 to 20 g on a critically damped servo of 200 to 2000 N/m."""
    scene = axisymmetric_scene(chance, elastic=True)
    while scene.shape == "plate":
        scene = axisymmetric_scene(chance, elastic=True)
    mass, servo = (float(np.exp(chance.uniform(math.log(low), math.log(high)))) for low, high in
                   ((0.5e-3, 20e-3), (200.0, 2000.0)))
    return Coupling(scene, mass, servo, float(chance.choice([0.5e-3, 1e-3])))


def coupled(coupling: Coupling) -> Judgement:
    """Run a coupling by the implicit Euler rule for servo and damper, explicit in the force of the tissue."""
    began, judgement = time.process_time(), Judgement()
    tissue = simulator(coupling.scene)
    mass, servo, dt = coupling.mass, coupling.servo, coupling.dt
    damping = 2.0 * math.sqrt(servo * mass)
    depth, speed, felt, stated, statuses = -START_HEIGHT, 0.0, [], 0.0, []
    for tick in range(RAMP_TICKS + HOLD_TICKS):
        aim = min(1.0, tick / RAMP_TICKS) * (coupling.scene.depth + START_HEIGHT) - START_HEIGHT
        answer = tissue.step(depth, dt)
        # mass (v - speed) / dt = servo (aim - depth - v dt) - damping v - force
        speed = (mass * speed / dt + servo * (aim - depth) - answer.force) / (mass / dt + servo * dt + damping)
        depth += speed * dt
        felt.append(answer.force)
        statuses.append(answer.status)
        stated = max(stated, answer.least_tool_mass)
    last = felt[-JUDGED_TICKS:]
    swing = 0.5 * float(np.abs(np.diff(last, 2)).max()) / max(abs(float(np.mean(last))), 1e-6)
    is_sure = all(status is ts.ForceStatus.CONVERGED for status in statuses[-JUDGED_TICKS:])
    text = (f"a tool of {1e3 * mass:.3g} g on {servo:.0f} N/m at {1e3 * dt:g} ms alternates by "
            f"{100 * swing:.0f} % of the force in a hold; stated least mass {1e3 * stated:.3g} g")
    if swing <= LARGEST_SWING:
        judgement.counts[Verdict.RIGHT] += 1
    elif stated > mass or not is_sure:
        judgement.counts[Verdict.REFUSED] += 1
    else:
        judgement.note(Verdict.WRONG, text)
    judgement.seconds = time.process_time() - began
    return judgement
