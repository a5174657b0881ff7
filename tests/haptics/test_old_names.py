"""Old names of public members of `haptics` give the new members and a `DeprecationWarning` for one release."""

import pytest

import haptics
from haptics.devices.contracts import HapticDevice, StageLimits, StageSample
from haptics.loop.process import LoopProcess
from haptics.safety.passivity import PassivityController, PassivityObserver
from haptics.safety.rendering import RenderedForce
from tissue_sim.pose import Pose
from tissue_sim.realtime.force_fading import Watchdog, WatchdogState
from tissue_sim.realtime.local_model import LocalModel

HELD = PassivityObserver(held=True)
NO_WRENCH = (0.0,) * 6
MODEL = LocalModel.from_axial_force(1.0, 100.0, 1e-3, 0.0)


@pytest.mark.parametrize(("owner", "old", "new"), [
    (LoopProcess, "ask", "execute_command"),
    (LoopProcess, "advance", "advance_paused_motion"),
    (LocalModel, "axial", "from_axial_force"),
    (MODEL, "evaluate", "evaluate_wrench"),
    (HapticDevice, "take_over", "continue_from_pose"),
    (StageLimits(0.0, 0.01, 0.01), "require", "require_within_limits"),
    (StageSample(0, 0.0, False, True, 0, 0, 2.0, 1.0), "earliest", "earliest_reading_time"),
    (HELD, "work", "compute_hand_work"),
    (HELD, "velocity", "compute_mean_velocity"),
    (PassivityController(HELD, 1.0), "force", "compute_damping_force"),
    (Watchdog(), "withdraw", "set_gain_to_zero"),
    (RenderedForce(NO_WRENCH, Pose.at_depth(0.0), 0, WatchdogState.TRACKING, 0.0, 0.0), "active", "is_port_active"),
    (RenderedForce(NO_WRENCH, Pose.at_depth(0.0), 0, WatchdogState.TRACKING, 0.0, 0.0), "invalid",
     "has_invalid_force_or_time_step"),
])
def test_an_old_name_gives_the_new_member_and_warns(owner, old, new):
    with pytest.warns(DeprecationWarning, match=rf"\.{old} is renamed to {new}$"):
        assert getattr(owner, old) == getattr(owner, new)


def test_a_device_that_defines_the_old_name_is_used_by_the_new_one():
    with pytest.warns(DeprecationWarning, match=r"^Knob\.take_over is renamed to continue_from_pose; define"):
        class Knob(haptics.Motion):
            def pose(self, time):
                return None

            def take_over(self, pose):
                self.seen = pose

    knob = Knob()
    knob.continue_from_pose(Pose.at_depth(1e-3))
    assert knob.seen.depth == 1e-3
