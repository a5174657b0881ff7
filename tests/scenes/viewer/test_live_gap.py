"""Difference between the live force and the model curve, and forces of late ticks."""

import numpy as np
import pytest

from haptics.loop.ring import TICK
from scenes.viewer.page.readouts import find_largest_live_model_difference, select_forces_of_late_ticks_on_grid
from scenes.viewer.trace import Trace
from tissue_sim.tool_force import ForceStatus

GRID = np.linspace(0.0, 10e-3, 101)
SPEED = 20e-3


def felt(late_from=np.inf, late_to=np.inf):
    """Trace of a ramp to 4 mm at `SPEED` and a hold: 200 N/m, with 0.1 N added from 2 mm to 3 mm."""
    time = np.arange(0.0, 0.5, 1e-3)
    records = np.zeros(len(time), TICK)
    records["time"], records["tool_depth"] = time, np.minimum(SPEED * time, 4e-3)
    depth = records["tool_depth"]
    records["tissue_force"] = 200.0 * depth + np.where((depth > 2e-3) & (depth < 3e-3), 0.1, 0.0)
    records["inertial"] = depth > 2e-3
    records["status"][(depth > late_from) & (depth < late_to)] = ForceStatus.LATE
    trace = Trace()
    trace.append_ticks_and_count_new_points(records)
    return trace


def test_the_largest_gap_has_depth_and_tool_speed():
    trace, model = felt(), (200.0 * GRID, 200.0 * GRID)
    gap = find_largest_live_model_difference(trace, GRID, trace.interpolate_newest_force_at_each_depth(GRID), model)
    assert gap.force == pytest.approx(0.1, rel=0.01) and 2e-3 < gap.depth < 3e-3
    assert gap.speed == pytest.approx(SPEED, rel=0.05) and gap.late_fraction == 0.0
    assert gap.inertia_fraction == pytest.approx(0.5, abs=0.1)
    assert find_largest_live_model_difference(trace, GRID, trace.interpolate_newest_force_at_each_depth(GRID),
                                              (np.full(101, np.nan),) * 2) is None


def test_forces_of_late_ticks_are_counted_and_returned_separately():
    trace = felt(1e-3, 2e-3)
    forces = select_forces_of_late_ticks_on_grid(trace, GRID)
    there = GRID[np.isfinite(forces)]
    assert len(there) > 3 and there.min() > 0.9e-3 and there.max() < 2.1e-3
    assert forces[np.isfinite(forces)] == pytest.approx(200.0 * there, abs=0.02)
    gap = find_largest_live_model_difference(trace, GRID, trace.interpolate_newest_force_at_each_depth(GRID),
                                             (GRID, GRID))
    assert gap.late_fraction == pytest.approx(0.15, abs=0.1)
    assert np.isnan(select_forces_of_late_ticks_on_grid(felt(), GRID)).all()
