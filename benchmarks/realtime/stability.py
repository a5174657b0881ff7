"""Largest delay at which virtual hands hold the needle without oscillation, with and without passivity control.

The tissues are the stiffest of the documentation (EF50_0T, docs/measured_silicones.md) and the study's silicone, under
the needle of radius 8 mm. A polynomial through the simulator's forces, without the mass of the tissue, replaces
them in the wide sweep; fewer hands are tried with the simulator itself, mass included. A hand presses with a constant
force to the depth where the tissue balances it, after a step of its place by 0.5 mm. What counts as shaking is in
`loop_oscillation`.
"""

import argparse
import json
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import date
from itertools import product
from pathlib import Path

import numpy as np
from delayed_hand import DelayedHand
from loop_oscillation import measure_sustained_peak_to_peak, simulate_device_depths

import tissue_sim as ts
from haptics.devices.contracts import AxialMotion
from haptics.devices.virtual.hand import VirtualHand
from haptics.safety.coupling import VirtualCoupling
from haptics.safety.limits import ForceLimiter
from haptics.safety.rendering import ForceRendering
from tissue_sim.pose import Pose
from tissue_sim.tool_force import ForceStatus, ToolForce

MASSES = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
GRIPS = (0.0, 100.0, 400.0, 1000.0, 2000.0)
DELAYS = tuple(0.5e-3 * number for number in range(11))
SOME_DELAYS = (0.0, 0.5e-3, 1e-3, 1.5e-3, 2e-3, 3e-3, 5e-3)
DAMPINGS = (1.0, 5.0)
#: Jitter, s, and share that is lost, of forces and of poses.
LINES = {"even": (0.0, 0.0), "jitter 1 ms, 2 % lost": (1e-3, 0.02)}
CONTROLS = ("none", "controller", "coupling + controller")
#: Law, parameters, deepest of the fit (m), and the hand's push (N).
TISSUES = {"EF50_0T": ("reduced_polynomial_3", {"C10": 25820.0, "C20": -3140.0, "C30": 400.0}, 4e-3, 3.0),
           "study's silicone": ("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, 10e-3, 1.2)}
#: Duration of a run, s.
SECONDS = 3.0
#: Step of the target of the hand, m.
STEP = 0.5e-3
#: Length of a tick, s.
TICK = 1e-3


class Stays(AxialMotion):
    """Motion of a hand that starts above the tissue and then aims at a depth, m."""

    def __init__(self, depth: float):
        self._depth = depth

    def depth(self, time: float) -> float:
        return self._depth - STEP if time <= 0 else self._depth


class Polynomial:
    """Tissue with the force k1 d + k2 d^2 + k3 d^3 at depth d, N."""

    def __init__(self, factors: np.ndarray):
        self._k1, self._k2, self._k3 = map(float, factors)

    def force(self, depth: float) -> float:
        return ((self._k3 * depth + self._k2) * depth + self._k1) * depth

    def stiffness(self, depth: float) -> float:
        return (3 * self._k3 * depth + 2 * self._k2) * depth + self._k1

    def step(self, pose: Pose, dt: float) -> ToolForce:
        depth = pose.depth
        if depth <= 0:
            return ToolForce.from_axial_force(0.0, 0.0, ForceStatus.CONVERGED)
        return ToolForce.from_axial_force(self.force(depth), self.stiffness(depth), ForceStatus.CONVERGED)


@dataclass(frozen=True)
class Trial:
    """Hand, delay line and tissue of one trial."""

    tissue: str
    control: str
    line: str
    damping: float
    mass: float
    grip: float
    delay: float


def model_of(name: str) -> ts.Model:
    law, parameters, deepest, _ = TISSUES[name]
    material = ts.Material(law, parameters, ts.Bulk("bulk_ratio", 1e4), density=1040.0)
    experiment = ts.Experiment(ts.Specimen(0.040, 0.070), ts.Protocol.ramp(deepest), tool=ts.Tool("flat", 0.008))
    return ts.Model(experiment, material)


def stand_in(name: str) -> tuple[Polynomial, float, float]:
    """Return the polynomial, its largest error, N, and the depth at which it balances the push, m."""
    _, _, deepest, push = TISSUES[name]
    simulator = ts.Simulator(model_of(name), resolution="realtime", inertia="off")
    simulator.warm_up()
    depths = np.linspace(0.0, deepest, 41)
    forces = np.array([simulator.step(float(depth), 1.0).force for depth in depths])
    powers = depths[:, None] ** np.arange(1, 4)
    factors = np.linalg.lstsq(powers, forces, rcond=None)[0]
    return (Polynomial(factors), float(np.abs(powers @ factors - forces).max()),
            float(np.interp(push, forces, depths)))


def rendering_of(control: str) -> ForceRendering:
    coupling = VirtualCoupling(1000.0, 1.0) if control.startswith("coupling") else None
    return ForceRendering(ForceLimiter(10.0, 1.0), coupling, controller_damping=None if control == "none" else 2.0)


def run(trial: Trial, tissue, rest: float) -> float:
    """Return the amplitude of the oscillation, m; 0: none."""
    push = TISSUES[trial.tissue][3]
    hand = VirtualHand(Stays(rest), trial.mass, trial.damping, trial.grip, push)
    jitter, loss = LINES[trial.line]
    line = DelayedHand(hand, trial.delay, jitter, loss, seed=1)
    depths = simulate_device_depths(tissue, line, rendering_of(trial.control), SECONDS, TICK)
    return measure_sustained_peak_to_peak(depths, TICK)


def boundary(stable: list[bool], delays: tuple[float, ...]) -> float | None:
    """Return the longest delay up to which all trials are stable, s; None: no stable delay."""
    ends = None
    for delay, each in zip(delays, stable, strict=True):
        if not each:
            break
        ends = delay
    return ends


def sweep(tissues: dict, quick: bool, say: Callable[[str], None]) -> list[dict]:
    masses, grips, delays = (MASSES[::2], GRIPS[::2], DELAYS[::2]) if quick else (MASSES, GRIPS, DELAYS)
    rows = []
    for name, control, line, damping in product(tissues, CONTROLS, LINES, DAMPINGS):
        tissue, _, rest = tissues[name]
        for mass, grip in product(masses, grips):
            amplitudes = [run(Trial(name, control, line, damping, mass, grip, delay), tissue, rest) for delay in delays]
            edge = boundary([amplitude == 0.0 for amplitude in amplitudes], delays)
            rows.append({"tissue": name, "control": control, "line": line, "damping_N_s_m": damping, "mass_kg": mass,
                         "grip_N_m": grip, "stable_to_ms": None if edge is None else edge * 1e3,
                         "amplitude_mm": [round(amplitude * 1e3, 3) for amplitude in amplitudes]})
        say(f"{name}, {control}, {line}, {damping:g} N s/m")
    return rows


def tried(trial: Trial, tissues: dict, inertia: str) -> float:
    """Run a trial with the simulator instead of its polynomial."""
    simulator = ts.Simulator(model_of(trial.tissue), resolution="realtime", inertia=inertia, looks_ahead=True)
    simulator.warm_up()
    rest = tissues[trial.tissue][2]
    # At 1 mm/s to where the hand begins: a tool that is there at once would set the tissue ringing.
    for depth in np.linspace(0.0, rest - STEP, 61)[1:]:
        simulator.step(float(depth), (rest - STEP) / 60 / 1e-3)
    return run(trial, simulator, rest)


def checks(tissues: dict, quick: bool) -> list[dict]:
    """Run trials on both sides of a boundary with the simulator, without tissue mass."""
    answers = []
    for name, control, mass, delay in product(tissues, CONTROLS[:2], (0.05, 0.5), (0.0, 1e-3) if quick else
                                              (0.0, 1e-3, 2e-3, 3e-3)):
        trial = Trial(name, control, "even", 5.0, mass, 400.0, delay)
        real, rough = tried(trial, tissues, "off"), run(trial, tissues[name][0], tissues[name][2])
        answers.append({**trial.__dict__, "simulator_mm": real * 1e3, "polynomial_mm": rough * 1e3,
                        "agree": (real == 0) == (rough == 0)})
    return answers


def with_mass(tissues: dict, quick: bool, say: Callable[[str], None]) -> list[dict]:
    """Return the boundary of the simulator with tissue mass, up to the first trial that oscillates."""
    rows = []
    for name, control, damping, mass in product(tissues, CONTROLS, DAMPINGS, (0.2,) if quick else (0.05, 0.5)):
        edge, amplitude = None, 0.0
        for delay in SOME_DELAYS:
            amplitude = tried(Trial(name, control, "even", damping, mass, 400.0, delay), tissues, "auto")
            if amplitude:
                break
            edge = delay
        rows.append({"tissue": name, "control": control, "line": "even", "damping_N_s_m": damping, "mass_kg": mass,
                     "grip_N_m": 400.0, "stable_to_ms": None if edge is None else edge * 1e3,
                     "next_amplitude_mm": amplitude * 1e3})
        say(f"with mass: {rows[-1]}")
    return rows


def table(rows: list[dict], name: str, control: str, line: str, damping: float) -> list[str]:
    chosen = [row for row in rows if (row["tissue"], row["control"], row["line"], row["damping_N_s_m"])
              == (name, control, line, damping)]
    grips = sorted({row["grip_N_m"] for row in chosen})
    lines = [f"{name}, control: {control}, line: {line}, damping {damping:g} N s/m: stable to a delay of [ms]",
             "mass [kg] | grip " + " | ".join(f"{grip:g}" for grip in grips) + " N/m"]
    for mass in sorted({row["mass_kg"] for row in chosen}):
        cells = {row["grip_N_m"]: row["stable_to_ms"] for row in chosen if row["mass_kg"] == mass}
        lines.append(f"{mass:g} | " + " | ".join("never" if cells[grip] is None else f"{cells[grip]:g}"
                                                 for grip in grips))
    return lines


def picture(rows: list[dict], real: list[dict], path: Path) -> None:
    """Draw the longest stable delay over the mass of the hand, by tissue, damping and control.

    Args:
        rows, real: of `sweep` and of `with_mass`.
    """
    import matplotlib.pyplot as plt

    panels = list(product(TISSUES, DAMPINGS))
    figure, axes = plt.subplots(1, len(panels), figsize=(3.1 * len(panels), 3.2), sharey=True, layout="constrained")
    colours = dict(zip(CONTROLS, ("#0072B2", "#D55E00", "#009E73"), strict=True))
    for axis, (name, damping) in zip(axes, panels, strict=True):
        for control, (line, dash) in product(CONTROLS, zip(LINES, ("-", "--"), strict=True)):
            chosen = [row for row in rows if (row["tissue"], row["control"], row["line"], row["damping_N_s_m"])
                      == (name, control, line, damping)]
            masses = sorted({row["mass_kg"] for row in chosen})
            worst = [min(-0.25 if row["stable_to_ms"] is None else row["stable_to_ms"] for row in chosen
                         if row["mass_kg"] == mass) for mass in masses]
            axis.semilogx(masses, worst, dash, color=colours[control], marker=".",
                          label=f"{control}, {line}" if axis is axes[0] else None)
        for control in CONTROLS:
            chosen = [row for row in real if (row["tissue"], row["control"], row["damping_N_s_m"])
                      == (name, control, damping)]
            axis.semilogx([row["mass_kg"] for row in chosen],
                          [-0.25 if row["stable_to_ms"] is None else row["stable_to_ms"] for row in chosen], "s",
                          color=colours[control], markerfacecolor="none", markersize=8,
                          label=f"{control}, with the tissue's mass" if axis is axes[0] else None)
        axis.set(title=f"{name}, {damping:g} N s/m", xlabel="mass of hand and handle [kg]", ylim=(-0.4, 5.2))
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("stable to a delay of [ms],\nworst of all grips (below 0: never)")
    figure.legend(loc="outside lower center", ncols=3, fontsize=7, frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--quick", action="store_true", help="every second mass, grip and delay")
    parser.add_argument("--figure", type=Path, metavar="FILE", help="draw the boundaries")
    arguments = parser.parse_args()
    began = time.process_time()
    tissues = {name: stand_in(name) for name in TISSUES}
    say: Callable[[str], None] = (lambda _: None) if arguments.json else lambda text: print("#", text)
    rows = sweep(tissues, arguments.quick, say)
    checked = checks(tissues, arguments.quick)
    real = with_mass(tissues, arguments.quick, say)
    if arguments.figure:
        picture(rows, real, arguments.figure)
    result = {"date": date.today().isoformat(), "machine": platform.machine(), "python": platform.python_version(),
              "cpu_s": time.process_time() - began, "delays_ms": [delay * 1e3 for delay in DELAYS],
              "tissues": {name: {"miss_N": miss, "rest_mm": rest * 1e3, "stiffness_N_m": tissue.stiffness(rest)}
                          for name, (tissue, miss, rest) in tissues.items()}, "rows": rows,
              "checks": checked, "with_mass": real}
    if arguments.json:
        print(json.dumps(result))
        return 0
    for name, about in result["tissues"].items():
        print(f"{name}: {about['stiffness_N_m']:.0f} N/m at {about['rest_mm']:.2f} mm; the polynomial misses the "
              f"simulator by {about['miss_N'] * 1e3:.1f} mN at most")
    for key in product(TISSUES, CONTROLS, LINES, DAMPINGS):
        print("\n".join(["", *table(rows, *key)]))
    agree = sum(each["agree"] for each in checked)
    print("\nwith the simulator, mass of the tissue included, grip 400 N/m: stable to a delay of [ms]")
    for row in real:
        edge = "never" if row["stable_to_ms"] is None else f"{row['stable_to_ms']:g}"
        print(f"{row['tissue']}, {row['control']}, {row['damping_N_s_m']:g} N s/m, {row['mass_kg']:g} kg: {edge}")
    print(f"\n{agree} of {len(checked)} points are the same with the simulator, without mass, as with the polynomial")
    for each in checked:
        if not each["agree"]:
            print("  not:", each)
    print(f"{result['cpu_s']:.0f} CPU s")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
