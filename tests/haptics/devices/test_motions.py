"""Motions without a device: reproducible by seed and time, within their bounds of depth, speed and frequency."""

import math
from itertools import pairwise

import numpy as np
import pytest
from device_contracts import MotionContract
from hypothesis import example, given, settings
from hypothesis import strategies as st

import tissue_sim as ts
from haptics.devices.back_ends import MOTIONS, make_motion
from haptics.devices.contracts import Motion
from haptics.devices.motions import ProtocolMotion, RandomWalk, SineMotion, SpatialWalk, TargetFollowingMotion
from haptics.devices.virtual.hand import VirtualHand
from tissue_sim.errors import InputError
from tissue_sim.pose import Pose, compute_rigid_motion


@pytest.mark.parametrize("name", ["random:seed=3", "random:sideways_mm=4,turn_deg=5", "sine",
                                  "protocol:ramp 4mm @2mm/s; unload", "hand:depth_mm=2"])
class TestMotions(MotionContract):
    @pytest.fixture
    def device(self, name):
        return make_motion(name)


def test_every_built_in_motion_is_made_by_its_name():
    assert list(MOTIONS) == ["random", "sine", "protocol", "hand"]
    walk = make_motion("random:seed=7,depth_mm=6,lift=0.5,top_speed_mm_s=100")
    np.testing.assert_array_equal(depths(walk, range(9)), depths(RandomWalk(7, 6e-3, -3e-3, 0.1), range(9)))
    in_space = make_motion("random:seed=7,depth_mm=6,lift=0,top_speed_mm_s=100,sideways_mm=3,turn_deg=9,turn_deg_s=90")
    twin = SpatialWalk(7, 6e-3, -0.0, 3e-3, math.radians(9.0), 0.1, math.radians(90.0))
    assert [in_space.pose(time) for time in range(9)] == [twin.pose(time) for time in range(9)]
    np.testing.assert_allclose(depths(make_motion("sine:depth_mm=5,frequency_hz=2"), [0.0, 0.25]), [-1e-3, 5e-3])
    repeated = make_motion("protocol:ramp 4mm @2mm/s; unload")
    assert repeated.depth(6.0) == pytest.approx(4e-3), "it repeats where it closes"
    hand = make_motion("hand:depth_mm=2,speed_mm_s=10")
    assert (hand.depth(0.0), hand.depth(0.1)) == (0.0, pytest.approx(1e-3)) and hand.depth(9.0) == pytest.approx(2e-3)
    with pytest.raises(InputError, match=r"unknown motion 'sin'; did you mean 'sine'\?"):
        make_motion("sin:depth_mm=5")


def test_a_pose_is_upright_and_on_the_axis():
    assert SineMotion(5e-3).pose(0.25) == Pose((0.0, 0.0, -SineMotion(5e-3).depth(0.25)))


def depths(motion, times):
    return np.array([motion.depth(time) for time in times])


def test_a_protocol_motion_interpolates_and_is_constant_beyond_its_ends():
    protocol = ts.Protocol([10.0, 12.0, 13.0], [0.0, 4e-3, 1e-3])
    motion = ProtocolMotion(protocol)
    times = np.linspace(-1, 5, 61)
    np.testing.assert_allclose(depths(motion, times), np.interp(times, [0, 2, 3], [0, 4e-3, 1e-3]), atol=1e-15)
    assert motion.duration == 3.0


def test_a_closed_protocol_repeats():
    motion = ProtocolMotion(ts.Protocol.parse("ramp 4mm @2mm/s; hold 1s; unload"), repeat=True)
    assert motion.duration == pytest.approx(5.0)
    times = np.linspace(0, 4.999, 100)
    np.testing.assert_allclose(depths(motion, times + 5 * motion.duration), depths(motion, times), atol=1e-9)
    assert motion.depth(2.5) == pytest.approx(4e-3)
    for protocol in (ts.Protocol.ramp(4e-3), ts.Protocol([0.0], [1e-3])):
        with pytest.raises(InputError, match="unload") as caught:
            ProtocolMotion(protocol, repeat=True)
        assert caught.value.field == "protocol"


def test_a_prescribed_force_is_refused():
    for make in (ts.Protocol.parse, lambda text: make_motion(f"protocol:{text}")):
        with pytest.raises(InputError, match="must prescribe displacements for a motion of the haptic loop; got"):
            ProtocolMotion(make("ramp 1N @1N/s"))


def test_a_sine_begins_at_the_upper_depth_at_rest():
    motion = SineMotion(deepest=6e-3, highest=-2e-3, frequency=2.0)
    np.testing.assert_allclose(depths(motion, [0, 0.125, 0.25, 0.5]), [-2e-3, 2e-3, 6e-3, -2e-3], atol=1e-15)
    assert abs(motion.depth(1e-4) - motion.depth(0)) < 1e-8


@pytest.mark.parametrize("step", [1e-3, 0.02])
@pytest.mark.parametrize(("start", "target"), [(0.0, 5e-3), (5e-3, -2e-3)])
def test_a_hand_approaches_its_target_as_a_critically_damped_spring(start, target, step):
    """The solution of x'' + 2 w x' + w^2 (x - target) = 0 from rest, for every time step."""
    hand = TargetFollowingMotion(start, speed=10.0, response=30.0)
    hand.aim(target)
    times = np.arange(0.0, 0.5, step)
    away = (start - target) * (1 + 30.0 * times) * np.exp(-30.0 * times)
    np.testing.assert_allclose(depths(hand, times), target + away, atol=1e-12)


def test_a_hand_keeps_its_speed_limit():
    hand = TargetFollowingMotion(0.0, speed=0.05)
    hand.aim(0.02)
    way = depths(hand, np.arange(0.0, 1.0, 1e-3))
    assert np.diff(way).max() == pytest.approx(0.05e-3) and way[-1] == pytest.approx(0.02) and way.max() < 0.0201
    with pytest.raises(InputError, match="depth: the target depth must be a finite number; got nan"):
        hand.aim(math.nan)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32), deepest=st.floats(1e-3, 30e-3), lift=st.floats(0, 5e-3), speed=st.floats(0.01, 0.5))
def test_a_random_walk_keeps_its_bounds(seed, deepest, lift, speed):
    motion = RandomWalk(seed, deepest, -lift, speed)
    times = np.arange(0, 8, 2e-3)
    path = depths(motion, times)
    assert path.min() >= -lift - 1e-12 and path.max() <= deepest + 1e-12
    assert np.abs(np.diff(path)).max() <= speed * 2e-3 * (1 + 1e-9)
    assert path[0] == pytest.approx(-lift, abs=1e-15)
    assert abs(path[1] - path[0]) < 1e-6, "it begins at rest"


def test_a_random_walk_depends_on_seed_and_time_alone():
    times = np.linspace(0, 20, 333)
    path = depths(RandomWalk(7), times)
    backwards = RandomWalk(7)
    np.testing.assert_array_equal(depths(backwards, times[::-1])[::-1], path)
    assert np.abs(depths(RandomWalk(8), times) - path).max() > 1e-3
    assert RandomWalk(7).depth(-1.0) == RandomWalk(7).depth(0.0)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_random_walk_is_as_irregular_as_a_hand(seed):
    """In a minute: fast and slow phases, deep phases and lift-offs, and less than 1 % of the power above 10 Hz."""
    times = np.arange(0, 60, 1e-3)
    path = depths(RandomWalk(seed), times)
    speed = np.abs(np.diff(path)) / 1e-3
    power = np.abs(np.fft.rfft((path - path.mean()) * np.hanning(path.size)))**2
    assert power[np.fft.rfftfreq(path.size, 1e-3) > 10].sum() < 0.01 * power.sum()
    assert speed.max() > 0.1 and np.median(speed) < 0.05
    assert 0.05 < (path < 0).mean() < 0.4 and path.max() > 6e-3
    assert np.count_nonzero(np.diff((path > 0).astype(int)) == 1) > 20
    assert np.count_nonzero(np.diff(np.sign(np.diff(path)))) > 120, "reversals"


def turned_by(pose):
    """Return the angle of a pose's orientation, rad."""
    return 2.0 * math.acos(min(1.0, abs(pose.orientation[0])))


@settings(max_examples=10, deadline=None)
@example(seed=0, deepest=0.015625, lift=0.0, aside=5e-324, turn=2.2e-309, speed=0.5, turn_speed=1.0)
@given(seed=st.integers(0, 2**32), deepest=st.floats(1e-3, 20e-3), lift=st.floats(0, 5e-3), aside=st.floats(0, 20e-3),
       turn=st.floats(0, 1.0), speed=st.floats(0.01, 0.5), turn_speed=st.floats(0.1, 3.0))
def test_a_spatial_walk_keeps_its_bounds(seed, deepest, lift, aside, turn, speed, turn_speed):
    walk = SpatialWalk(seed, deepest, -lift, aside, turn, speed, turn_speed)
    poses = [walk.pose(time) for time in np.arange(0, 4, 4e-3)]
    path = np.array([pose.position for pose in poses])
    assert -path[:, 2].min() <= deepest + 1e-12 and path[:, 2].max() <= lift + 1e-12
    assert np.abs(path[:, :2]).max() <= aside + 1e-12
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() <= speed * 4e-3 * (1 + 1e-9)
    assert max(turned_by(pose) for pose in poses) <= turn + 1e-7
    # Between two orientations whose rotation vectors differ by d the angle is at most d.
    assert all(math.hypot(*compute_rigid_motion(one, other)[3:]) <= turn_speed * 4e-3 * (1 + 1e-6) + 1e-9
               for one, other in pairwise(poses))
    assert poses[0].position == pytest.approx((0.0, 0.0, lift), abs=1e-15) and turned_by(poses[0]) == 0.0, "upright"
    assert np.abs(path[1] - path[0]).max() < 1e-6, "and at rest"


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_spatial_walk_covers_its_range(seed):
    """In a minute: most of the box and the cone, lift-offs, and drags in contact; the coordinates are uncorrelated."""
    walk = SpatialWalk(seed, 4e-3, -0.8e-3, 3e-3, 0.1, speed=0.05)
    poses = [walk.pose(time) for time in np.arange(0, 60, 4e-3)]
    path = np.array([pose.position for pose in poses])
    assert (np.ptp(path, axis=0) > [4e-3, 4e-3, 3.5e-3]).all()
    assert max(turned_by(pose) for pose in poses) > 0.05
    pressed = path[:, 2] < 0
    assert 0.05 < (~pressed).mean() < 0.6 and np.count_nonzero(np.diff(pressed.astype(int)) == 1) > 10
    aside = np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1)[pressed[1:]] / 4e-3
    assert aside.max() > 0.02, "it is dragged"
    assert np.abs(np.corrcoef(path.T) - np.eye(3)).max() < 0.4


def test_a_spatial_walk_depends_on_seed_and_time_alone():
    times = np.linspace(0, 20, 111)
    walk, backwards = SpatialWalk(7, turn=0.1), SpatialWalk(7, turn=0.1)
    path = [walk.pose(time) for time in times]
    assert [backwards.pose(time) for time in times[::-1]] == path[::-1]
    assert SpatialWalk(8, turn=0.1).pose(5.0) != walk.pose(5.0)


@pytest.mark.parametrize("name", ["random:seed=3,sideways_mm=4", "random:seed=3", "sine", "hand:depth_mm=-1",
                                  "protocol:ramp 4mm @2mm/s; unload"])
def test_named_motions_follow_the_approach_of_the_tool(name):
    """With an oblique approach, motions follow its axis from first contact on; a motion keeps its first approach."""
    approach, plain, leaning = ts.Approach(12e-3, math.radians(20.0)), make_motion(name), make_motion(name)
    leaning.set_approach(approach)
    leaning.set_approach(ts.Approach(-12e-3))
    followed = VirtualHand(make_motion(name), grip=400.0)
    followed.set_approach(approach)
    assert followed.pose(0.0).position == pytest.approx(leaning.pose(0.0).position, abs=1e-15)
    for time in (0.0, 0.31, 0.8, 2.0):
        x, y, z = plain.pose(time).position
        pose = leaning.pose(time)
        assert pose.position == pytest.approx(np.add(approach.pose(-z).position, (x, y, 0.0)), abs=1e-12)
        assert pose.orientation == approach.pose(0.0).orientation


@pytest.mark.parametrize("wrong", [
    lambda: SineMotion(0.0, 1e-3), lambda: SineMotion(1e-3, frequency=0.0), lambda: SineMotion(math.nan),
    lambda: RandomWalk(deepest=-3e-3), lambda: RandomWalk(speed=0.0), lambda: RandomWalk(speed=math.inf),
    lambda: RandomWalk(highest=-math.inf), lambda: RandomWalk(start=9e-3), lambda: SpatialWalk(sideways=-1e-3),
    lambda: SpatialWalk(turn=math.pi), lambda: SpatialWalk(turn_speed=0.0), lambda: SpatialWalk(speed=math.nan),
])
def test_invalid_motions_are_refused(wrong):
    with pytest.raises(InputError):
        wrong()


def test_a_hand_moves_along_the_axis_of_its_approach_and_sideways():
    """Targets on the axis of the approach and off it; the speed limit holds in every direction."""
    approach = ts.Approach(offset=12e-3, angle=math.radians(20.0))
    hand = TargetFollowingMotion(0.0, speed=0.05, approach=approach)
    assert hand.pose(0.0) == approach.pose(0.0)
    hand.aim(5e-3)
    path = [hand.pose(time) for time in np.arange(0.0, 1.0, 1e-3)]
    np.testing.assert_allclose(path[-1].position, approach.pose(5e-3).position, atol=1e-8)
    assert path[-1].orientation == approach.pose(0.0).orientation
    hand.aim(5e-3, (2e-3, -4e-3))
    way = np.array([hand.pose(time).position for time in np.arange(1.0, 2.0, 1e-3)])
    expected = np.array(approach.pose(5e-3).position) + np.array([2e-3 - 12e-3, -4e-3, 0.0])
    np.testing.assert_allclose(way[-1], expected, atol=1e-8)
    assert np.linalg.norm(np.diff(way, axis=0), axis=1).max() == pytest.approx(0.05e-3)
    hand.aim(3e-3)
    way = hand.pose(3.0).position
    np.testing.assert_allclose(way[1], -4e-3, atol=1e-8)
    with pytest.raises(InputError, match="across: the target across the axis must be two finite numbers"):
        hand.aim(1e-3, (math.nan, 0.0))


def test_a_hand_that_takes_over_keeps_position_and_orientation():
    pose = Pose((3e-3, -2e-3, -4e-3), (math.cos(0.1), 0.0, -math.sin(0.1), 0.0))
    hand = TargetFollowingMotion(None)
    hand.continue_from_pose(pose)
    np.testing.assert_allclose(hand.pose(1.0).position, pose.position, atol=1e-15)
    assert hand.pose(2.0).orientation == pose.orientation


def test_a_protocol_moves_along_the_axis_of_its_approach():
    approach = ts.Approach(offset=-5e-3, angle=math.radians(-30.0))
    motion = ProtocolMotion(ts.Protocol([0.0, 1.0], [0.0, 4e-3]), approach=approach)
    assert motion.pose(0.5) == approach.pose(2e-3)


def test_the_old_name_of_set_approach_still_works_with_a_warning():
    """A plug-in may define or call ``go_along``: `set_approach` calls its method, and the old call forwards."""
    with pytest.warns(DeprecationWarning, match=r"OldMotion\.go_along is deprecated; name the method set_approach"):
        class OldMotion(Motion):
            def go_along(self, approach):
                super().go_along(approach)
                self.notified = True

            def pose(self, time):
                return Pose.at_depth(0.0)

    old, new, approach = OldMotion(), SineMotion(5e-3), ts.Approach(12e-3)
    with pytest.warns(DeprecationWarning, match="use set_approach"):
        old.set_approach(approach)
    assert old.approach is approach and old.notified
    with pytest.warns(DeprecationWarning, match="use set_approach"):
        new.go_along(approach)
    assert new.approach is approach
