"""`VirtualCoupling`: passivity condition, stability and equilibrium."""

import cmath
import math
from dataclasses import replace
from itertools import pairwise, product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from haptics.safety.coupling import COUPLING, VirtualCoupling, is_tool_force_stiffness_stale
from tissue_sim import InputError
from tissue_sim.pose import Pose
from tissue_sim.tool_force import (
    ForceStatus,
    PredictedForceOfNextStep,
    ToolForce,
    make_axial_stiffness_matrix,
    make_axial_wrench,
)

TICK = 1e-3
RIGID = 1e12


class Load:
    """Spring, damper and mass under the proxy, by backward differences of first or second order as in the simulator.

    With `predicts_next`, a load with mass also gives the force of its next step (`ToolForce.ahead`).
    """

    def __init__(self, stiffness, mass=0.0, damping=0.0, order=1, predicts_next=True):
        self.stiffness, self.mass, self.damping, self.predicts_next = stiffness, mass, damping, predicts_next
        self.weights = {1: (1.0, -1.0, 0.0), 2: (1.5, -2.0, 0.5)}[order]
        self.depths, self.speeds = (0.0, 0.0), (0.0, 0.0)

    def _difference(self, value, before, dt):
        return (self.weights[0] * value + self.weights[1] * before[0] + self.weights[2] * before[1]) / dt

    def _force(self, depth, dt):
        speed = self._difference(depth, self.depths, dt)
        lost, inert = self.damping * speed, self.mass * self._difference(speed, self.speeds, dt)
        return self.stiffness * depth + lost + inert, speed

    def step(self, depth, dt):
        force, speed = self._force(depth, dt)
        self.depths, self.speeds = (depth, self.depths[0]), (speed, self.speeds[0])
        rate = self.weights[0] / dt
        stiffness = self.stiffness + self.damping * rate + self.mass * rate**2
        ahead = PredictedForceOfNextStep(make_axial_wrench(self._force(depth, dt)[0]),
                                         make_axial_stiffness_matrix(stiffness))
        answer = ToolForce.from_axial_force(force, stiffness, ForceStatus.CONVERGED, inertial=self.mass > 0)
        return replace(answer, ahead=ahead) if self.mass > 0 and self.predicts_next else answer


def step(coupling, depth, answer):
    """Step the coupling along z, and return the depth of the proxy, m."""
    proxy = coupling.step(Pose((0.0, 0.0, -depth)), answer, TICK)
    assert proxy is coupling.pose and proxy.position[:2] == coupling.force[:2] == (0.0, 0.0)
    return proxy.depth


def free_flight(coupling, load, mass, damping, speed, ticks):
    """Simulate a free device with an initial speed: mass and damper, force held between samples, exact solution.

    Returns:
        Kinetic energy at the samples, J.
    """
    depth, velocity, answer, energy = 0.0, speed, None, []
    decay = math.exp(-damping * TICK / mass)
    for _ in range(ticks):
        energy.append(mass * velocity**2 / 2)
        answer = load.step(step(coupling, depth, answer), TICK)
        end = -coupling.force[2] / damping
        depth += end * TICK + (velocity - end) * (1 - decay) * mass / damping
        velocity = end + (velocity - end) * decay
    return np.array(energy)


stiffnesses = st.floats(50.0, 5000.0)
dampings = st.floats(0.0, 5.0)


@settings(deadline=None)
@given(stiffnesses, dampings, st.floats(0.02, 1.0), st.floats(1.0, 3.0), st.sampled_from([RIGID, 2e4, 1500.0, 100.0]))
def test_the_energy_does_not_grow_if_the_condition_holds(stiffness, damping, mass, margin, tissue):
    """The hand receives at most the energy that it put in, for any mass of the device and any tissue."""
    coupling = VirtualCoupling(stiffness, damping)
    needed = margin * coupling.required_device_damping(TICK)
    assert coupling.is_passive(needed * 1.0001, TICK)
    energy = free_flight(coupling, Load(tissue), mass, needed * 1.0001, 0.1, 400)
    assert energy.max() <= energy[0] * (1 + 1e-9)


@pytest.mark.parametrize("stiffness", [500.0, 2000.0, 5000.0])
def test_the_energy_grows_with_half_the_required_damping(stiffness):
    """For a wall without damping, K T/2 is also the stability limit of a device much heavier than K T^2."""
    for part, grows in ((0.5, True), (2.0, False)):
        coupling = VirtualCoupling(stiffness)
        damping = part * coupling.required_device_damping(TICK)
        assert coupling.is_passive(damping, TICK) is not grows
        energy = free_flight(coupling, Load(RIGID), 0.2, damping, 0.1, 3000)
        late, early = energy[2000:].max(), energy[:1000].max()
        assert late > 2 * early if grows else late < early / 2


def test_the_condition_includes_the_damping_of_the_coupling():
    """A light device with strong sampled damping vibrates although its spring alone is passive."""
    coupling = VirtualCoupling(100.0, damping=40.0)
    damping = 2 * coupling.stiffness * TICK / 2
    assert not coupling.is_passive(damping, TICK)
    energy = free_flight(coupling, Load(RIGID), 0.015, damping, 0.1, 40)
    assert energy[-10:].max() > 10 * energy[0]


def required_damping(impedance, angle, delay=0):
    """Return the damping of Colgate and Schenkel (1997) for a sampled impedance H(z), z = exp(j angle), N s/m."""
    z = cmath.exp(1j * angle)
    return TICK / 2 / (1 - math.cos(angle)) * ((1 - 1 / z) * impedance * z**-delay).real


@given(stiffnesses, dampings, st.floats(-3.0, 3.0), st.floats(-4.0, 4.0), st.integers(0, 3))
def test_the_condition_covers_each_passive_load_at_each_frequency(stiffness, damping, resistance, reactance, delay):
    """Loads Z with Re Z >= 0 in series, by the general condition of Colgate and Schenkel."""
    coupling = VirtualCoupling(stiffness, damping)
    least = coupling.required_device_damping(TICK, delay)
    load = 10**resistance + 1j * math.sinh(3 * reactance)
    for angle in np.linspace(1e-3, math.pi, 200):
        rate = (1 - cmath.exp(-1j * angle)) / TICK
        spring = damping + stiffness / rate
        series = spring * load / (spring + load)
        assert required_damping(series * rate, angle, delay) <= least * (1 + 1e-9)


@pytest.mark.parametrize(("stiffness", "damping"), [(1000.0, 0.0), (1000.0, 2.0), (200.0, 0.3)])
def test_the_condition_is_exact_for_a_proxy_at_rest(stiffness, damping):
    """K T/2 + |B|, reached at the Nyquist frequency."""
    needed = [required_damping(stiffness + damping * (1 - cmath.exp(-1j * angle)) / TICK, angle)
              for angle in np.linspace(1e-3, math.pi, 500)]
    assert max(needed) == pytest.approx(stiffness * TICK / 2 + damping)
    assert VirtualCoupling(stiffness, damping).required_device_damping(TICK) == pytest.approx(max(needed))


@pytest.mark.parametrize(("damping", "covered"), [(0.2, True), (1.0, True), (0.0, False)])
def test_the_condition_with_a_mass_by_second_order_differences(damping, covered):
    """The condition covers any mass if the damping is K tick/5; without damping a resonant mass violates it."""
    coupling, angles, needed = VirtualCoupling(1000.0, damping), np.linspace(1e-3, math.pi, 400), []
    for mass, tissue in product(np.logspace(-5, 1, 25), (0.0, 200.0, 3000.0)):
        load = Load(tissue, mass, order=2)
        for angle in angles:
            z = cmath.exp(1j * angle)
            rate = sum(weight * z**-place for place, weight in enumerate(load.weights)) / TICK
            spring, tissues = 1000.0 + damping * (1 - 1 / z) / TICK, tissue + mass * rate**2
            needed.append(required_damping(spring * tissues / (spring + tissues), angle))
    assert bool(max(needed) <= coupling.required_device_damping(TICK) * (1 + 1e-9)) is covered


@pytest.mark.parametrize(("damping", "mass"), [(0.0, 0.0), (2.0, 0.0), (2.0, 0.005)])
@pytest.mark.parametrize("angle", [0.05, 0.5, 2.0])
def test_the_coupling_has_the_impedance_of_the_condition(damping, mass, angle):
    """Steady oscillation against a spring: coupling, proxy mass and tissue in series, without delay."""
    stiffness, tissue, ticks = 1000.0, 1500.0, 4000
    coupling, load, answer, force = VirtualCoupling(stiffness, damping, mass), Load(tissue), None, np.empty(ticks)
    for tick in range(ticks):
        answer = load.step(step(coupling, 1e-3 * math.cos(angle * tick), answer), TICK)
        force[tick] = coupling.force[2]
    rate = (1 - cmath.exp(-1j * angle)) / TICK
    spring, proxy = stiffness + damping * rate, tissue + mass * rate**2
    impedance = spring * proxy / (spring + proxy)
    late = np.arange(ticks // 2, ticks)
    assert force[late] == pytest.approx((1e-3 * impedance * np.exp(1j * angle * late)).real, abs=1e-6)


def test_at_rest_coupling_and_tissue_are_in_equilibrium():
    """A stiffening tissue after a sudden motion: p satisfies K (x - p) = F(p)."""
    coupling, answer = VirtualCoupling(1000.0, 1.0), None
    for _ in range(200):
        depth = step(coupling, 5e-3, answer) if answer else step(coupling, 0.0, None)
        answer = ToolForce.from_axial_force(400 * depth + 1e7 * depth**3, 400 + 3e7 * depth**2, ForceStatus.CONVERGED)
    assert 1000 * (5e-3 - coupling.pose.depth) == pytest.approx(answer.force, rel=1e-9)
    assert coupling.force[2] == pytest.approx(answer.force, rel=1e-9)


def peak(coupling, load, ticks=500):
    """Return the largest depth of the proxy after a sudden motion of the device by 1 mm, m."""
    answer, largest = load.step(step(coupling, 0.0, None), TICK), 0.0
    for _ in range(ticks):
        answer = load.step(step(coupling, 1e-3, answer), TICK)
        largest = max(largest, abs(coupling.pose.depth))
        if largest > 1.0:
            break
    return largest


@pytest.mark.slow
@settings(deadline=None)
@given(st.floats(100, 1e4), st.floats(0.0, 10.0), st.floats(1.0, 1e4), st.floats(1e-5, 1.0), st.floats(0.0, 10.0),
       st.sampled_from([1, 2]))
def test_the_proxy_is_stable_on_a_tissue_with_mass(stiffness, damping, tissue, mass, lost, order):
    assert peak(VirtualCoupling(stiffness, damping), Load(tissue, mass, lost, order)) < 4e-3


@pytest.mark.parametrize("mass", [1e-3, 1.0])
def test_proxy_and_heavy_tissue_are_one_implicit_system(mass):
    """The force of the coupling equals the force of the tissue in each tick."""
    coupling, load, rest = VirtualCoupling(1000.0, 1.0), Load(200.0, mass, order=2), 0.0
    answer = load.step(step(coupling, rest, None), TICK)
    for _ in range(1000):
        answer = load.step(step(coupling, 1e-3, answer), TICK)
        assert coupling.force[2] == pytest.approx(answer.force, abs=1e-9)
        assert abs(answer.force) < 2.5, "1 N of the spring's and 1 N of the damper's at first"


@pytest.mark.parametrize(("part", "stable"), [(0.97, True), (1.03, False)])
def test_the_stability_limit_without_prediction_of_the_next_force(part, stable):
    """The limit of the mass is 2 mass + B tick + (K + k) tick^2/2 for a load of first order."""
    coupling, tissue = VirtualCoupling(1000.0, 1.0, mass=0.5e-3), 1500.0
    limit = 2 * coupling.mass + coupling.damping * TICK + (coupling.stiffness + tissue) * TICK**2 / 2
    assert (peak(coupling, Load(tissue, part * limit, predicts_next=False), ticks=2000) < 4e-3) is stable


def test_the_proxy_stays_without_an_answer():
    coupling = VirtualCoupling(1000.0, 1.0)
    # The first step places the proxy at the device and ignores the answer to another pose.
    assert step(coupling, 2e-3, ToolForce.from_axial_force(1.0, 500.0, ForceStatus.CONVERGED)) == 2e-3
    assert step(coupling, 3e-3, None) == 2e-3
    assert coupling.force[2] == pytest.approx(1000 * 1e-3 + 1.0 * 1.0)
    step(coupling, 3e-3, None)
    assert coupling.force[2] == pytest.approx(1.0)


def test_the_damper_sums_the_dissipated_energy():
    """1 m/s of slip for 1 ms through 2 N s/m: 2 mJ."""
    coupling = VirtualCoupling(1000.0, 2.0)
    step(coupling, 0.0, None)
    step(coupling, 1e-3, None)
    assert coupling.dissipated == pytest.approx(2e-3)
    coupling.reset()
    assert coupling.dissipated == 0.0 and step(coupling, 7e-3, None) == 7e-3


def test_a_softening_tissue_does_not_make_the_proxy_jump():
    """A negative stiffness, as at the onset of puncture, smaller in magnitude than that of the coupling."""
    coupling, answer = VirtualCoupling(1000.0), ToolForce.from_axial_force(0.0, 0.0, ForceStatus.CONVERGED)
    step(coupling, 0.0, None)
    for _ in range(400):
        depth = step(coupling, 4e-3, answer)
        answer = ToolForce.from_axial_force(2.0 - 400 * depth, -400.0, ForceStatus.CONVERGED)
    assert depth == pytest.approx((4.0 - 2.0) / 600.0)


def test_a_sudden_loss_of_resistance_lets_the_tool_pass():
    """Puncture: the force falls from 2 N to zero in 0.5 mm, 4 times as steep as the coupling."""
    def tissue(depth):
        fallen = 2.0 - 4000 * max(depth - 2e-3, 0.0)
        return ToolForce.from_axial_force(max(min(1000 * depth, fallen), 0.0),
                                          1000.0 if depth < 2e-3 else -4000.0 * (fallen > 0),
                                          ForceStatus.CONVERGED)

    coupling, answer, path = VirtualCoupling(1000.0), None, []
    for tick in range(300):
        path.append(step(coupling, min(0.05e-3 * tick, 6e-3), answer))
        answer = tissue(path[-1])
    assert all(later >= before for before, later in pairwise(path))
    assert path[-1] == pytest.approx(6e-3)


# ---- Three directions ----

#: An oblique unit vector, and a rotated device.
OBLIQUE = np.array([0.48, -0.6, 0.64])
TURNED = (0.6, 0.0, 0.8, 0.0)


def tissue_at(proxy, stiffness, looks_ahead=False):
    """Return the answer of a linear tissue with equilibrium at the origin, with a torque.

    Args:
        proxy: pose of the proxy.
        stiffness: N/m, shape (3, 3).
        looks_ahead: whether the answer contains the next force; force and stiffness of this step then differ from it.
    """
    force = -stiffness @ np.array(proxy.position)
    matrix = np.zeros((6, 6))
    matrix[:3, :3] = stiffness
    wrench, rows = (*force.tolist(), 0.1, 0.2, -0.3), tuple(map(tuple, matrix.tolist()))
    if not looks_ahead:
        return ToolForce(wrench, rows, ForceStatus.CONVERGED)
    return ToolForce((9.0,) * 6, ((7.0,) * 6,) * 6, ForceStatus.CONVERGED, ahead=PredictedForceOfNextStep(wrench, rows))


def simulate(coupling, positions, stiffness, **options):
    """Return positions of the proxy, m, and forces on the device, N, for positions of the device, shape (n, 3)."""
    answer, proxies, forces = None, [], []
    for position in positions:
        proxy = coupling.step(Pose(tuple(position), TURNED), answer, TICK)
        answer = tissue_at(proxy, stiffness, **options)
        proxies.append(proxy.position)
        forces.append(coupling.force)
    return np.array(proxies), np.array(forces)


@pytest.mark.parametrize("looks_ahead", [False, True])
def test_the_coupling_is_isotropic(looks_ahead):
    """A motion along an oblique line gives the same result as along z."""
    depths = 3e-3 * np.sin(0.05 * np.arange(300))
    by_axis = []
    for axis in (np.array([0.0, 0.0, 1.0]), OBLIQUE):
        coupling = VirtualCoupling(1500.0, 2.0, 2e-3)
        stiffness = 900.0 * np.outer(axis, axis)
        proxies, forces = simulate(coupling, depths[:, None] * axis, stiffness, looks_ahead=looks_ahead)
        np.testing.assert_allclose(np.cross(proxies, axis), 0.0, atol=1e-15)
        by_axis.append((proxies @ axis, forces @ axis, coupling.dissipated))
    for along_z, oblique in zip(*by_axis, strict=True):
        np.testing.assert_allclose(oblique, along_z, rtol=1e-9, atol=1e-15)


@given(st.integers(0, 10**6), st.floats(1.0, 1e6), st.floats(100.0, 1e4), st.floats(0.0, 5.0))
@settings(deadline=None, max_examples=30)
def test_with_a_full_stiffness_matrix_the_proxy_reaches_equilibrium(seed, largest, stiffness, damping):
    """Any symmetric positive definite stiffness, from soft to almost rigid, with coupling of shear and normal force."""
    mixed = np.random.default_rng(seed).normal(size=(3, 3))
    tissue = mixed @ mixed.T
    tissue *= largest / np.linalg.norm(tissue, 2)
    device = 4e-3 * OBLIQUE
    # The slowest mode is the damper of the coupling against its spring.
    ticks = 200 + math.ceil(40 * damping / stiffness / TICK)
    places = np.vstack([np.zeros(3), np.tile(device, (ticks, 1))])
    proxies, forces = simulate(VirtualCoupling(stiffness, damping), places, tissue)
    rest = np.linalg.solve(tissue + stiffness * np.eye(3), stiffness * device)
    np.testing.assert_allclose(proxies[-1], rest, atol=1e-9)
    np.testing.assert_allclose(forces[-1], stiffness * (rest - device), atol=1e-5)
    assert np.abs(proxies).max() < 5e-3


def test_a_negative_oblique_stiffness_does_not_make_the_proxy_jump():
    """Stiffness of 800 N/m, except -400 N/m along an oblique line, smaller in magnitude than that of the coupling."""
    tissue = 800.0 * np.eye(3) - 1200.0 * np.outer(OBLIQUE, OBLIQUE)
    device = 1e-3 * OBLIQUE
    proxies, _ = simulate(VirtualCoupling(1000.0, 1.0), np.vstack([np.zeros(3), np.tile(device, (400, 1))]), tissue)
    np.testing.assert_allclose(proxies[-1], device * 1000.0 / 600.0, rtol=1e-6)
    depths = proxies @ OBLIQUE
    assert (np.diff(depths) > -1e-12).all()


def test_the_rotation_is_coupled_rigidly():
    proxy = VirtualCoupling(1000.0).step(Pose((0.0, 0.0, 0.0), TURNED), None, TICK)
    assert proxy.orientation == TURNED


@pytest.mark.parametrize("values", [(0.0,), (math.nan,), (100.0, -1.0), (100.0, 1.0, math.inf)])
def test_invalid_settings_are_refused(values):
    with pytest.raises(InputError, match="must be"):
        VirtualCoupling(*values)


def test_the_old_name_of_the_condition_warns():
    with pytest.warns(DeprecationWarning, match="renamed to required_device_damping"):
        assert VirtualCoupling(1000.0, 2.0).least_device_damping(1e-3) == 2.5


def test_the_condition_refuses_an_invalid_tick():
    with pytest.raises(InputError, match="tick"):
        VirtualCoupling(100.0).required_device_damping(0.0)
    assert VirtualCoupling(1000.0, 2.0).required_device_damping(1e-3, delay_ticks=1) == pytest.approx(10.0)


class OldStiffness(Load):
    """Spring whose stiffness is computed once at contact, and marked as old afterwards."""

    def __init__(self, stiffness, first):
        super().__init__(stiffness)
        self.first, self.ticks = first, 0

    def step(self, depth, dt):
        self.ticks += 1
        answer = super().step(depth, dt)
        return replace(answer, stiffness_matrix=make_axial_stiffness_matrix(self.first),
                       stiffness_age=1e-3 * self.ticks)


@pytest.mark.parametrize("first", [0.0, 50.0, 1e4])
@pytest.mark.parametrize("tissue", [200.0, 1500.0, 6000.0])
def test_a_stiffness_that_is_too_old_does_not_make_the_proxy_oscillate(first, tissue):
    """A tissue thirty times as stiff as the coupling: with the old stiffness the proxy would overshoot."""
    coupling, load, answer = VirtualCoupling(200.0), OldStiffness(tissue, first), None
    balance = 200.0 * 5e-3 / (200.0 + tissue)
    for _ in range(150):  # until the stiffness is too old, at rest at the surface
        answer = load.step(step(coupling, 0.0, answer), TICK)
    depths = []
    for _ in range(2000):
        answer = load.step(step(coupling, 5e-3, answer), TICK)
        depths.append(load.depths[0])
    assert depths[-1] == pytest.approx(balance, rel=1e-3)
    assert np.ptp(depths[-50:]) < 1e-6


def test_a_recent_stiffness_is_used():
    young, old = (VirtualCoupling(500.0) for _ in range(2))
    answer = ToolForce.from_axial_force(0.0, 1500.0, ForceStatus.CONVERGED)
    for coupling, age in ((young, COUPLING.longest_stiffness_age), (old, 1.01 * COUPLING.longest_stiffness_age)):
        step(coupling, 0.0, None)
        step(coupling, 1e-3, replace(answer, stiffness_age=age))
    assert young.pose.depth == pytest.approx(1e-3 * 500.0 / 2000.0)
    assert is_tool_force_stiffness_stale(replace(answer, stiffness_age=1.0))
    assert old.pose.depth == pytest.approx(1e-3)  # nothing is known of the stiffness yet


def test_the_old_name_of_the_age_limit_warns():
    with pytest.warns(DeprecationWarning, match="renamed to COUPLING.longest_stiffness_age"):
        from haptics.safety.coupling import LONGEST_STIFFNESS_AGE
    assert COUPLING.longest_stiffness_age == LONGEST_STIFFNESS_AGE
