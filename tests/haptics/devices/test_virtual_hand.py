"""The virtual hand: the contract, and the motion of a mass on a spring."""

import math

import numpy as np
import pytest
from delayed_hand import DelayedHand
from device_contracts import HapticDeviceContract

from haptics.devices.back_ends import HAPTIC_DEVICES, make_haptic_device
from haptics.devices.contracts import Motion
from haptics.devices.motions import TargetFollowingMotion
from haptics.devices.virtual.hand import VirtualHand
from haptics.safety.limits import ForceLimiter
from haptics.safety.rendering import ForceRendering
from tissue_sim.errors import InputError
from tissue_sim.pose import Pose
from tissue_sim.tool_force import ForceStatus, ToolForce

TURNED = (0.6, 0.0, 0.8, 0.0)


class Standing(Motion):
    """A motion with constant position and orientation."""

    def pose(self, time):
        return Pose((1e-3, -2e-3, -3e-3), TURNED)


class TestVirtualHand(HapticDeviceContract):
    @pytest.fixture
    def device(self):
        return VirtualHand(Standing())


class TestByName(HapticDeviceContract):
    @pytest.fixture
    def device(self):
        return make_haptic_device("virtual:sine:depth_mm=5,frequency_hz=2")


def pushed(hand, force, times):
    """Return the displacements of a hand under a constant force, m, shape (times, 3)."""
    places = []
    for time in times:
        places.append(hand.pose(time).position)
        hand.render((*force, 0.0, 0.0, 0.0))
    return np.array(places) - Standing().pose(0.0).position


@pytest.mark.parametrize("step", [1e-3, 0.013])
@pytest.mark.parametrize(("mass", "damping", "grip"), [(0.2, 3.0, 300.0), (0.05, 40.0, 300.0), (0.1, 20.0, 1000.0)],
                         ids=["swings", "creeps", "critical"])
def test_the_hand_moves_as_a_mass_on_a_damped_spring(mass, damping, grip, step):
    """The step response in closed form, for every length of a tick."""
    force, times = np.array((0.5, 0.0, 2.0)), np.arange(0.0, 0.6, step)
    ways = pushed(VirtualHand(Standing(), mass, damping, grip), force, times)
    rate = damping / (2 * mass)
    swing = complex(grip / mass - rate**2) ** 0.5
    fade = np.exp(-rate * times)
    if abs(swing) < 1e-6:
        response = 1.0 - fade * (1.0 + rate * times)
    else:
        response = 1.0 - (fade * (np.cos(swing * times) + rate / swing * np.sin(swing * times))).real
    np.testing.assert_allclose(ways, response[:, None] * force / grip, atol=2e-8)


def test_an_undamped_hand_conserves_energy():
    """Without damping, a step of force causes an oscillation to twice the static displacement, without decay."""
    ways = pushed(VirtualHand(Standing(), 0.1, 0.0, 400.0), (0.0, 0.0, 1.0), np.arange(0.0, 5.0, 1e-3))[:, 2]
    assert ways.max() == pytest.approx(2.0 / 400.0, rel=1e-4) and ways.min() == pytest.approx(0.0, abs=1e-9)
    assert ways[-1000:].max() == pytest.approx(2.0 / 400.0, rel=1e-4)


def test_the_hand_has_the_orientation_and_the_start_of_its_motion():
    hand = VirtualHand(Standing())
    assert hand.pose(0.0) == Standing().pose(0.0)
    hand.render((0.0, 0.0, 1.0, 5.0, 5.0, 5.0))
    assert hand.pose(0.1).orientation == TURNED
    assert hand.pose(0.0) == Standing().pose(0.0), "a motion that begins again"


def test_an_unknown_pose_is_returned_as_none():
    class Lost(Motion):
        def pose(self, time):
            return None

    assert VirtualHand(Lost()).pose(0.0) is None


def test_the_hand_rests_where_grip_and_tissue_balance():
    """Target 5 mm deep, grip 400 N/m, tissue 600 N/m: the hand rests 2 mm deep with 1.2 N."""
    hand, rendering = VirtualHand(TargetFollowingMotion(speed=1.0)), ForceRendering(ForceLimiter(10.0, 1.0))
    hand.aim(5e-3)
    for tick in range(3000):
        depth = rendering.advance_proxy(hand.pose(tick * 1e-3), 1e-3).depth
        stiffness = 600.0 if depth > 0 else 0.0
        rendered = rendering.render(ToolForce.from_axial_force(stiffness * depth, stiffness, ForceStatus.CONVERGED),
                                    1e-3)
        hand.render(rendered.wrench)
    assert depth == pytest.approx(2e-3, rel=1e-6) and rendered.force == pytest.approx(1.2, rel=1e-6)


@pytest.mark.parametrize(("wrong", "field"), [({"mass": 0.0}, "mass"), ({"grip": -1.0}, "grip"),
                                              ({"push": math.nan}, "push"),
                                              ({"damping": -1.0}, "damping")])
def test_invalid_hands_are_refused(wrong, field):
    with pytest.raises(InputError) as caught:
        VirtualHand(Standing(), **wrong)
    assert caught.value.field == field


def test_only_a_hand_with_a_steerable_motion_can_be_steered():
    make_haptic_device("virtual:").aim(1e-3)
    with pytest.raises(InputError, match="requires a steerable motion; got a SineMotion"):
        make_haptic_device("virtual:sine").aim(1e-3)
    assert "virtual" in HAPTIC_DEVICES


class TestDelayedHand(HapticDeviceContract):
    @pytest.fixture
    def device(self):
        return DelayedHand(VirtualHand(Standing()), 2e-3, 1e-3, 0.05)


class TestFreeHand(HapticDeviceContract):
    @pytest.fixture
    def device(self):
        return VirtualHand(Standing(), grip=0.0, push=0.5)
