"""Whether a hand and a tissue shake each other: the loop without a clock, and what counts as shaking."""

from __future__ import annotations

import numpy as np

from haptics.devices.contracts import HapticDevice
from haptics.safety.rendering import ForceRendering
from tissue_sim.tool_force import Tissue

#: Of the newest motion, s; it is held against as long a time before.
WINDOW = 0.5
#: Smaller than this, m from the lowest to the highest, is no shaking; and one that falls by a tenth a window dies out.
SMALL, LASTS = 0.05e-3, 0.9
#: The hand has been thrown so far, m: no need to go on.
_THROWN = 0.05


def depths_in_time(tissue: Tissue, device: HapticDevice, rendering: ForceRendering, seconds: float,
                   tick: float = 1e-3) -> np.ndarray:
    """Depth of a device at each tick of a loop that never is late, m, shape (n,).

    It ends early where the device has gone further than 50 mm from where it began. A pose that is not known counts as
    the one before.

    Args:
        tissue, device, rendering: as of `haptics.loop.loop.Loop`; the device is started here.
        seconds: how long.
        tick: period, s.
    """
    device.start()
    depths: list[float] = []
    for number in range(round(seconds / tick)):
        pose = device.pose(number * tick)
        rendered = rendering.render(tissue.step(rendering.pose_for(pose, tick), tick), tick)
        device.render(rendered.wrench)
        depth = pose.depth if pose is not None else depths[-1] if depths else 0.0
        depths.append(depth)
        if abs(depth - depths[0]) > _THROWN:
            break
    device.stop()
    return np.array(depths)


def shaking(depths: np.ndarray, tick: float = 1e-3) -> float:
    """How far the depth goes up and down in the last half second, m; 0 where that is small or dies out.

    Shaking is a motion of more than 0.05 mm that has not fallen by a tenth from the half second before: one that grows,
    or a limit cycle. Of a hand that holds still, otherwise its own motion counts.

    Args:
        depths: as of `depths_in_time`, at least twice a window, or until the hand was thrown out.
        tick: period, s.
    """
    window = round(WINDOW / tick)
    if np.ptp(depths) > _THROWN:
        return float(np.ptp(depths[-window:]))
    now, before = float(np.ptp(depths[-window:])), float(np.ptp(depths[-2 * window:-window]))
    return now if now > SMALL and now > LASTS * before else 0.0
