"""A plan and a run on the screen."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from scenes.commands.shared.text_table import print_sentence, text_table

if TYPE_CHECKING:
    from rich.console import Console

    from haptics.devices.contracts import Bench
    from haptics.recorder.plan import Plan
    from haptics.recorder.run_folder import RunFolder
    from haptics.safety.motion_guard import MotionLimits


def print_plans(plans: Sequence[Plan], limits: MotionLimits, bench: Bench, devices: str, seconds: float,
                console: Console) -> None:
    """What would be done, with which devices, and what would end it."""
    table = text_table("test", "motion", "recordings", "preconditioning", "takes", text=2)
    table.columns[1].no_wrap = False
    for plan in plans:
        table.add_row(plan.name, plan.title, f"{plan.replicates}", f"{plan.preconditioning}",
                      f"{plan.duration:.4g} s each")
    console.print(table)
    console.print()
    print_sentence(console, devices)
    print_sentence(console, f"It takes {seconds:.0f} s at least; finding contact comes on top.")
    print_sentence(console, f"It ends beyond {limits.force:g} N, outside of {limits.lowest * 1e3:g} to "
                            f"{limits.highest * 1e3:g} mm, faster than {limits.speed * 1e3:g} mm/s, after "
                            f"{limits.duration:g} s, when the sensor is silent for {limits.sensor_silence:g} s, "
                            "saturated or faulty, and when the stage reports a fault. The tool then "
                            + ("goes back, where the stage can be believed." if limits.retracts else
                               "stands where it is."))
    print_sentence(console, f"{_runs_on(bench.stage.runs_on)} "
                            + ("A stalled motor is seen by the encoder." if bench.stage.measures_position else
                               "A stalled motor is not detectable: the stage knows only where it was driven to."))


def _runs_on(seconds: float) -> str:
    if seconds == 0.0:
        return "If this program dies, the stage stands."
    return ("If this program dies, the stage moves on to where it was sent." if math.isinf(seconds) else
            f"If this program dies, the stage moves on for {seconds:g} s at most.")


def print_run(folder: RunFolder, console: Console) -> None:
    """What was recorded."""
    state = folder.state
    print_sentence(console, f"{len(state['done'])} recordings in {folder.folder}: {', '.join(state['done']) or 'none'}")
    for stop in state["stops"]:
        print_sentence(console, f"stopped ({stop['cause']}) in {stop['test']}, {stop['phase']}: {stop['message']}")
    if state["done"]:
        print_sentence(console, f"calibrate them with:  tissue-sim calibrate {folder.folder / 'campaign.toml'} -o OUT")
