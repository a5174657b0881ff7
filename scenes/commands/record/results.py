"""Printed output of `tissue-sim record`: the plan of a dry run, and the state of a run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from scenes.commands.shared.text_table import make_table_with_headings, print_sentence

if TYPE_CHECKING:
    from rich.console import Console

    from haptics.devices.contracts import Bench
    from haptics.recorder.plan import BenchTestPlan
    from haptics.recorder.run_folder import RunFolder
    from haptics.safety.motion_guard import MotionLimits


def print_recording_plans(plans: Sequence[BenchTestPlan], limits: MotionLimits, bench: Bench, devices: str,
                          seconds: float, console: Console) -> None:
    """Print the planned motion, its duration, the devices and the stop conditions.

    Args:
        plans: plans of the tests.
        limits: limits of the motion.
        bench: devices.
        devices: sentence on the devices.
        seconds: least duration of all recordings, s.
        console: console of the results.
    """
    table = make_table_with_headings("test", "motion", "recordings", "preconditioning", "duration", text=2)
    table.columns[1].no_wrap = False
    for plan in plans:
        table.add_row(plan.name, plan.motion_summary, f"{plan.replicates}", f"{plan.preconditioning}",
                      f"{plan.replicate_duration:.4g} s each")
    console.print(table)
    console.print()
    print_sentence(console, devices)
    print_sentence(console, f"Duration: at least {seconds:.0f} s, plus the time to find contact.")
    print_sentence(console, f"The run stops at a force above {limits.force:g} N, a position outside "
                   f"{limits.lowest * 1e3:g} to {limits.highest * 1e3:g} mm, a speed above "
                   f"{limits.speed * 1e3:g} mm/s, a duration above {limits.duration:g} s, a sensor that is "
                   f"saturated, faulty or silent for {limits.sensor_silence:g} s, or a fault of the stage. "
                   "After a stop the tool "
                   + ("retracts, unless the position of the stage is unreliable." if limits.retracts else
                      "stays where it is."))
    print_sentence(console, f"{_describe_motion_after_program_crash(bench.stage.runs_on)} "
                   + ("The encoder detects a stalled motor." if bench.stage.measures_position else
                      "A stalled motor is not detected, because the stage reports its commanded position."))


def _describe_motion_after_program_crash(seconds: float) -> str:
    """Describe the behaviour of the stage after a crash of the program; `seconds` is how long it can move on."""
    if seconds == 0.0:
        return "If this program crashes, the stage stops."
    return ("If this program crashes, the stage moves on to its target." if math.isinf(seconds) else
            f"If this program crashes, the stage moves on for at most {seconds:g} s.")


def print_run_state(folder: RunFolder, console: Console) -> None:
    """Print the recordings of a run, its stops and the next command."""
    state = folder.state
    print_sentence(console, f"{len(state['done'])} recordings in {folder.folder}: {', '.join(state['done']) or 'none'}")
    for name, left_out in state.get("left_out", {}).items():
        print_sentence(console, f"{name}: {left_out['samples']} samples are left out: {left_out['reason']}")
    for stop in state["stops"]:
        print_sentence(console, f"stopped ({stop['cause']}) in {stop['test']}, {stop['phase']}: {stop['message']}")
    if state["done"]:
        print_sentence(console, f"next: tissue-sim calibrate {folder.folder / 'campaign.toml'} -o OUT")
