"""Passivity observer, passivity controller and energy limit."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from haptics.safety.coupling import VirtualCoupling
from haptics.safety.passivity import PassivityController, PassivityObserver, ReturnedEnergyCutoff
from tissue_sim import InputError
from tissue_sim.pose import Pose
from tissue_sim.tool_force import ForceStatus, ToolForce

TICK = 1e-3


def along(force):
    """Return the wrench of a force along z, N."""
    return (0.0, 0.0, force, 0.0, 0.0, 0.0)


def observe(observer, force, depth):
    observer.observe(along(force), Pose((0.0, 0.0, -depth)))


def added(controller, depth):
    """Return the force along z that the controller adds, N."""
    x, y, z = controller.compute_damping_force(Pose((0.0, 0.0, -depth)), TICK)
    assert (x, y) == (0.0, 0.0)
    return z


def closed_motion(seed, ticks=2000):
    """Return a closed motion of a hand that ends at rest: below 13 Hz, up to 0.12 m/s."""
    generator = np.random.default_rng(seed)
    time = np.arange(ticks + 1) / ticks
    depth = 5e-3 * np.ones(ticks + 1)
    for cycles in range(1, 25):
        depth += 4e-3 / cycles * generator.normal() * np.sin(2 * math.pi * cycles * time)
    window = np.sin(math.pi * time) ** 2
    return depth * window


def stiffening(depth):
    """Return the force of a stiffening tissue without tension, N."""
    return 400.0 * depth + 6e6 * depth**3 if depth > 0 else 0.0


@pytest.mark.parametrize("seed", range(8))
def test_an_elastic_tissue_returns_at_most_0_1_percent_too_much(seed):
    """Energy of a closed motion by the trapezoidal rule: at most 0.1 % of the energy put in."""
    observer = PassivityObserver()
    for depth in closed_motion(seed):
        observe(observer, stiffening(depth), depth)
    assert observer.energy_in > 1e-3
    assert abs(observer.energy) <= 1e-3 * observer.energy_in
    assert not observer.is_port_active


@pytest.mark.parametrize("seed", range(8))
def test_an_elastic_tissue_behind_a_coupling_returns_at_most_0_1_percent_too_much(seed):
    """The same for the rendered force, without a damper in the coupling."""
    coupling, observer, answer = VirtualCoupling(3000.0), PassivityObserver(), None
    for depth in closed_motion(seed):
        proxy = coupling.step(Pose.at_depth(depth), answer, TICK).depth
        tangent = 400.0 + 18e6 * proxy**2 if proxy > 0 else 0.0
        answer = ToolForce.from_axial_force(stiffening(proxy), tangent, ForceStatus.CONVERGED)
        observe(observer, coupling.force[2], depth)
    assert -observer.energy <= 1e-3 * observer.energy_in
    assert not observer.is_port_active


def held_energy(coupling, tissue, path):
    """Return the energy that the hand puts into a coupling on a spring, J, with the force held."""
    observer, answer = PassivityObserver(held=True), None
    for depth in path:
        proxy = coupling.step(Pose.at_depth(depth), answer, TICK).depth
        answer = ToolForce.from_axial_force(tissue * proxy, tissue, ForceStatus.CONVERGED)
        observe(observer, coupling.force[2], depth)
    return observer.energy


@pytest.mark.slow
@settings(deadline=None, max_examples=30)
@given(st.integers(0, 10**6), st.floats(200.0, 4000.0), st.floats(0.3, 3.0))
def test_the_coupling_dissipates_the_energy_that_the_hold_returns(seed, stiffness, ratio):
    """Above B = K T (K + k)/(2 k) the damper dissipates the energy of the hold; without damper the hold is active."""
    path, tissue = closed_motion(seed), ratio * stiffness
    bare = VirtualCoupling(stiffness)
    leaked = -held_energy(bare, tissue, path)
    assert leaked > bare.dissipated == 0.0
    # A hold delays the force by half a tick and returns k_eff/2 step^2 too much in each step.
    effective = stiffness * tissue / (stiffness + tissue)
    assert leaked == pytest.approx(effective / 2 * np.sum(np.diff(path) ** 2), rel=0.01)
    damped = VirtualCoupling(stiffness, 1.2 * stiffness * TICK * (stiffness + tissue) / (2 * tissue))
    energy = held_energy(damped, tissue, path)
    assert -energy <= damped.dissipated
    assert leaked <= damped.dissipated
    assert energy >= 0.0


@given(st.floats(50.0, 3000.0), st.floats(0.1, 20.0))
def test_trapezoidal_work_of_a_spring_and_a_damper(stiffness, damping):
    """Indentation by 10 mm at 0.1 m/s: K d^2/2 and B v d."""
    observer = PassivityObserver()
    for depth in np.linspace(0.0, 0.010, 101):
        observe(observer, stiffness * depth + damping * 0.1, depth)
    assert observer.energy == pytest.approx(stiffness * 0.010**2 / 2 + damping * 0.1 * 0.010)
    assert observer.energy_out == 0.0


def test_the_held_force_of_a_spring_is_half_a_step_late():
    observer = PassivityObserver(held=True)
    for depth in (0.0, 1e-3, 2e-3, 1e-3, 0.0):
        observe(observer, 1000.0 * depth, depth)
    assert observer.energy_in == pytest.approx(1e-3)
    assert observer.energy_out == pytest.approx(3e-3)
    assert observer.energy == pytest.approx(-1000.0 / 2 * 4 * 1e-6)
    assert observer.is_port_active
    observer.reset()
    assert observer.energy == 0.0 and not observer.is_port_active


def test_samples_that_are_not_finite_are_ignored():
    observer = PassivityObserver()
    for force, depth in ((1.0, 0.0), (math.nan, 1e-3), (1.0, math.inf), (1.0, 2e-3)):
        observe(observer, force, depth)
    assert observer.energy == pytest.approx(2e-3)


def amplitude(controlled, ticks=4000):
    """Return the vibration amplitude, m, of a device of 50 g and 0.2 N s/m at a sampled wall of 2000 N/m."""
    observer = PassivityObserver(held=True)
    controller = PassivityController(observer, damping=2.0)
    mass, damping, stiffness = 0.05, 0.2, 2000.0
    decay, depth, velocity, depths = math.exp(-damping * TICK / mass), 0.0, 0.1, []
    for _ in range(ticks):
        force = stiffness * depth
        if controlled:
            force += added(controller, depth)
        observe(observer, force, depth)
        end = -force / damping
        depth += end * TICK + (velocity - end) * (1 - decay) * mass / damping
        velocity = end + (velocity - end) * decay
        depths.append(abs(depth))
        if depths[-1] > 1.0:
            break
    return max(depths[:200]), max(depths[-200:])


def test_the_controller_stops_a_growing_vibration():
    early, late = amplitude(controlled=False)
    assert late > 10 * early
    early, late = amplitude(controlled=True)
    assert late < early / 10


def test_the_controller_dissipates_the_returned_energy():
    """1 N held over 1 mm of unloading returns 1 mJ; at 1 m/s for 1 ms this needs 1 N s/m."""
    observer = PassivityObserver(held=True)
    controller = PassivityController(observer, damping=5.0)
    observe(observer, 1.0, 0.0)
    assert added(controller, -1e-3) == pytest.approx(-1.0)
    assert controller.added == pytest.approx(1.0)
    assert added(controller, 1e-3) == 0.0


@given(st.lists(st.tuples(st.floats(-10, 10), st.floats(-0.01, 0.01)), max_size=50), st.floats(0.1, 20.0))
def test_the_controller_only_dissipates_energy(samples, damping):
    observer = PassivityObserver(held=True)
    controller = PassivityController(observer, damping)
    last = None
    for force, depth in samples:
        more = added(controller, depth)
        assert 0.0 <= controller.added <= damping
        if last is None:
            assert more == 0.0
        else:
            assert more == pytest.approx(controller.added * (depth - last) / TICK)
        observe(observer, force + more, depth)
        last = depth


def turned(angle, position=(0.0, 0.0, 0.0)):
    """Return a pose that is rotated about an oblique axis, rad."""
    return Pose(position, (math.cos(angle / 2), 0.6 * math.sin(angle / 2), 0.0, 0.8 * math.sin(angle / 2)))


def test_torque_does_work_in_a_rotation():
    """A spring of 0.4 N m/rad turned by 0.5 rad, and a lateral force of 3 N over 2 mm."""
    observer = PassivityObserver()
    for share in np.linspace(0.0, 1.0, 51):
        torque = -0.4 * 0.5 * share
        observer.observe((-3.0, 0.0, 0.0, 0.6 * torque, 0.0, 0.8 * torque), turned(0.5 * share, (2e-3 * share, 0, 0)))
    assert observer.energy == pytest.approx(0.4 * 0.5**2 / 2 + 3.0 * 2e-3)
    assert observer.energy_out == 0.0


def test_the_controller_force_opposes_the_motion_in_any_direction():
    observer = PassivityObserver(held=True)
    controller = PassivityController(observer, damping=5.0)
    observer.observe((0.6, 0.0, 0.8, 0.0, 0.0, 0.0), Pose((0.0, 0.0, 0.0)))
    assert controller.compute_damping_force(Pose((0.6e-3, 0.0, 0.8e-3)), TICK) == pytest.approx((-0.6, 0.0, -0.8))
    assert controller.added == pytest.approx(1.0)


def test_a_pose_that_is_not_finite_is_ignored():
    observer = PassivityObserver()
    for wrench, pose in (((math.nan,) * 6, turned(0.0)), ((1.0,) * 6, turned(math.nan)),
                         ((1.0,) * 6, turned(0.0)), ((1.0,) * 6, turned(math.nan)), ((1.0,) * 6, turned(0.1))):
        observer.observe(wrench, pose)
    assert observer.energy == pytest.approx(-(0.6 + 0.8) * 0.1)


def test_the_old_name_way_warns():
    with pytest.warns(DeprecationWarning, match="renamed to displacement_to"):
        assert PassivityObserver().way(Pose.at_depth(1e-3)) == (0.0,) * 6


def test_invalid_settings_are_refused():
    with pytest.raises(InputError, match="tolerance"):
        PassivityObserver(tolerance=math.nan)
    with pytest.raises(InputError, match="held=True"):
        PassivityController(PassivityObserver(), 1.0)
    with pytest.raises(InputError, match="damping"):
        PassivityController(PassivityObserver(held=True), 0.0)


class TestEnergyLimit:
    def test_stored_energy_may_be_returned(self):
        limit = ReturnedEnergyCutoff(1.0)
        press = np.linspace(0.0, 0.9, 100)
        assert all(limit.step(energy, TICK) for energy in [*press, *press[::-1]] * 5)

    def test_more_than_the_limit_is_not_returned(self):
        limit = ReturnedEnergyCutoff(1.0)
        energies = np.linspace(0.0, -1.5, 151)
        given = [limit.step(energy, TICK) for energy in energies]
        assert given == [bool(energy > -1.0 - TICK) for energy in energies]
        assert not limit.step(5.0, TICK), "the force stays off until a reset"
        limit.reset()
        assert limit.step(0.0, TICK) and not limit.exceeded

    def test_a_small_rate_of_energy_is_forgiven(self):
        limit = ReturnedEnergyCutoff(1.0)
        assert all(limit.step(-0.9 * second / limit.FORGIVEN, 1.0) for second in range(3600))
        limit.reset()
        assert not all(limit.step(-1.1 * second / limit.FORGIVEN, 1.0) for second in range(3600))

    @pytest.mark.parametrize("energy", [0.0, -1.0, math.nan])
    def test_an_invalid_limit_is_refused(self, energy):
        with pytest.raises(InputError, match="energy: the largest returned energy must be positive"):
            ReturnedEnergyCutoff(energy)
        assert ReturnedEnergyCutoff(math.inf).step(-1e9, TICK)
