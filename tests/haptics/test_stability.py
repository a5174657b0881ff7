"""Stable and oscillating hands at a tissue: theory, and points of benchmarks/realtime/stability.py."""

import numpy as np
import pytest
from delayed_hand import DelayedHand
from loop_oscillation import measure_sustained_peak_to_peak, simulate_device_depths

import tissue_sim as ts
from haptics.devices.contracts import AxialMotion
from haptics.devices.virtual.hand import VirtualHand
from haptics.safety.coupling import VirtualCoupling
from haptics.safety.limits import ForceLimiter
from haptics.safety.rendering import ForceRendering
from tissue_sim.errors import InputError
from tissue_sim.pose import Pose
from tissue_sim.tool_force import ForceStatus, ToolForce


class Spring:
    def __init__(self, stiffness):
        self.stiffness = stiffness

    def step(self, pose, dt):
        depth = pose.depth
        return (ToolForce.from_axial_force(self.stiffness * depth, self.stiffness, ForceStatus.CONVERGED) if depth > 0
                else ToolForce.from_axial_force(0.0, 0.0, ForceStatus.CONVERGED))


class Step(AxialMotion):
    """Motion from 0.5 mm to 1 mm at once."""

    def depth(self, time):
        return 0.5e-3 if time <= 0 else 1e-3


def shakes(stiffness, mass, damping, grip, delay, *, coupling=None, controller=None, jitter=0.0, loss=0.0):
    """Return the oscillation of a hand that rests at a depth of 1 mm."""
    hand = VirtualHand(Step(), mass, damping, grip, push=stiffness * 1e-3)
    rendering = ForceRendering(ForceLimiter(50.0, 5.0), coupling, controller_damping=controller)
    depths = simulate_device_depths(Spring(stiffness), DelayedHand(hand, delay, jitter, loss), rendering, 2.0)
    return measure_sustained_peak_to_peak(depths)


@pytest.mark.parametrize("mass", [0.05, 0.2, 1.0])
def test_a_late_spring_takes_away_damping_by_its_stiffness_times_its_age(mass):
    """A force held over T and late by D is (T/2 + D) old: damping b bears a spring of b/(T/2 + D), and not much more
    (Colgate and Schenkel's bound without delay; for slow hands, whose phase is small, with it)."""
    for delay in (0.0, 1e-3, 3e-3):
        bearable = 4.0 / (0.5e-3 + delay)
        assert shakes(0.8 * bearable, mass, 4.0, 0.0, delay) == 0.0
        assert shakes(1.25 * bearable, mass, 4.0, 0.0, delay) > 0.1e-3


def test_the_stiffest_tissue_of_the_documentation():
    """EF50_0T under the needle, 3270 N/m: with 5 N s/m a millisecond is borne by light hands, two are not."""
    for mass, grip in ((0.02, 0.0), (0.1, 400.0), (0.2, 2000.0)):
        for controller in (None, 2.0):
            assert shakes(3270.0, mass, 5.0, grip, 0.0, controller=controller) == 0.0
            assert shakes(3270.0, mass, 5.0, grip, 3e-3, controller=controller) > 0.1e-3, "also with the controller"


def test_the_controller_calms_a_hand_that_shakes_by_the_hold():
    """1 N s/m is less than K T/2 = 1.6 N s/m: without control it shakes; 2 N s/m more are enough."""
    assert shakes(3270.0, 0.1, 1.0, 400.0, 0.0) > 1e-3
    assert shakes(3270.0, 0.1, 1.0, 400.0, 0.0, controller=2.0) == 0.0


def test_a_coupling_bears_what_the_tissue_alone_does_not():
    """1000 N/m in series with the tissue: no more than that reaches the hand."""
    for delay in (2e-3, 3e-3):
        assert shakes(3270.0, 0.1, 5.0, 400.0, delay) > 0.1e-3
        assert shakes(3270.0, 0.1, 5.0, 400.0, delay, coupling=VirtualCoupling(1000.0, 1.0), controller=2.0) == 0.0


@pytest.fixture(scope="module")
def pressed():
    """The study's silicone under the needle, bonded, pressed slowly to 5.73 mm; a function that makes a simulator."""
    material = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4),
                           density=1040.0)
    simulator = ts.Simulator(ts.Model(ts.Experiment(ts.Specimen(0.040, 0.070), ts.Protocol.ramp(0.01),
                                                    tool=ts.Tool("flat", 0.008)), material), looks_ahead=True)
    simulator.warm_up()
    for depth in np.linspace(0.0, 5.733e-3, 61)[1:]:
        simulator.step(float(depth), 0.1)
    saved = simulator.save()

    def again():
        simulator.restore(saved)
        return simulator

    return again


@pytest.mark.slow
def test_a_tissue_with_mass_does_not_throw_a_proxy_that_is_put_into_it(pressed):
    """The spring is not tense where the tissue pushes with 1.1 N: that throws the proxy by half a millimetre in a tick,
    which the simulator steps in parts. Nothing grows, and the hand feels the tissue."""
    tissue, coupling, answer, depths = pressed(), VirtualCoupling(1000.0, 1.0), None, []
    for _ in range(600):
        answer = tissue.step(coupling.step(Pose.at_depth(5.733e-3), answer, 1e-3), 1e-3)
        # An equilibrium in every tick; the throw starts waves, while which the answers are LATE.
        assert answer.age == 0.0 and answer.status in (ForceStatus.CONVERGED, ForceStatus.LATE)
        depths.append(answer.depth)
    # What swings on is the tissue, which loses nothing.
    assert min(depths) > 4.5e-3 and np.ptp(depths[-200:]) < 0.15e-3
    assert coupling.force[2] == pytest.approx(answer.force, abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("damping", [1.0, 5.0])
def test_a_heavy_hand_behind_a_coupling_does_not_shake_a_tissue_with_mass(pressed, damping):
    """0.5 kg, in time: the force oscillated from tick to tick when the proxy extrapolated the inertial force."""
    class Deeper(AxialMotion):
        def depth(self, time):
            return 5.733e-3 if time <= 0 else 6.233e-3

    hand = DelayedHand(VirtualHand(Deeper(), 0.5, damping, 400.0, push=1.2), 0.0)
    rendering = ForceRendering(ForceLimiter(10.0, 1.0), VirtualCoupling(1000.0, 1.0), controller_damping=2.0)
    assert measure_sustained_peak_to_peak(simulate_device_depths(pressed(), hand, rendering, 2.0)) == 0.0


def test_jitter_counts_as_delay_and_lost_messages_as_age():
    calm = {"stiffness": 1000.0, "mass": 0.1, "damping": 5.0, "grip": 400.0, "delay": 2e-3}
    assert shakes(**calm) == 0.0 and shakes(**calm, jitter=1e-3, loss=0.02) == 0.0
    assert shakes(**calm, jitter=8e-3) > 0.1e-3 and shakes(**calm, loss=0.7) > 0.1e-3


def test_what_counts_as_shaking():
    time = np.arange(0.0, 2.0, 1e-3)
    swings = np.sin(2 * np.pi * 10 * time)
    assert measure_sustained_peak_to_peak(1e-3 * swings) == pytest.approx(2e-3, rel=1e-3)
    assert measure_sustained_peak_to_peak(0.02e-3 * swings) == 0.0, "small"
    assert measure_sustained_peak_to_peak(1e-3 * swings * np.exp(-time)) == 0.0, "it dies out"
    assert measure_sustained_peak_to_peak(0.1e-3 * swings * np.exp(time)) > 1e-3, "it grows"
    assert measure_sustained_peak_to_peak(np.full(1000, 2.0)) == 0.0
    assert measure_sustained_peak_to_peak(np.linspace(0.0, 0.06, 30)) > 0.05, "thrown out"


def test_a_hand_without_a_grip_falls_as_a_mass_in_oil():
    hand = VirtualHand(Step(), mass=0.2, damping=4.0, grip=0.0, push=1.0)
    times = np.linspace(0.0, 0.5, 37)
    depths = [hand.pose(time).depth for time in times]
    tau, speed = 0.2 / 4.0, 1.0 / 4.0
    np.testing.assert_allclose(depths, 0.5e-3 + speed * (times - tau * (1 - np.exp(-times / tau))), rtol=1e-9)
    assert hand.velocity[2] == pytest.approx(-speed * (1 - np.exp(-0.5 / tau)))
    free = VirtualHand(Step(), mass=0.2, damping=0.0, grip=0.0, push=1.0)
    assert [free.pose(time).depth for time in (0.0, 0.1, 0.3)] == pytest.approx(
        [0.5e-3 + 0.5 / 0.2 * time**2 for time in (0.0, 0.1, 0.3)])


def test_a_force_arrives_after_its_delay_also_between_two_ticks():
    """3 N from 2.5 ms after they were given, on a free mass."""
    line = DelayedHand(VirtualHand(Step(), mass=0.5, damping=0.0, grip=0.0), 2.5e-3)
    line.start()
    for tick in range(11):
        height = line.pose(tick * 1e-3).position[2]
        if tick == 0:
            line.render((0.0, 0.0, 3.0, 0.0, 0.0, 0.0))
    assert height == pytest.approx(-0.5e-3 + 0.5 * 3.0 / 0.5 * (10e-3 - 2.5e-3) ** 2)


def test_a_line_loses_what_it_is_told_to_and_is_the_same_again():
    def known(seed):
        line = DelayedHand(VirtualHand(Step()), 1e-3, 1e-3, 0.3, seed)
        poses = []
        for _ in range(2):
            line.start()
            poses.append([line.pose(tick * 1e-3) for tick in range(1000)])
        assert poses[0] == poses[1]
        return [pose is not None for pose in poses[0]]

    assert 0.6 < np.mean(known(1)) < 0.8 and known(1) != known(2)
    assert isinstance(DelayedHand(VirtualHand(Step()), 0.0).pose(0.0), Pose)


@pytest.mark.parametrize(("wrong", "field"), [({"delay": -1.0}, "delay"), ({"delay": 0.0, "jitter": np.inf}, "jitter"),
                                              ({"delay": 0.0, "loss": 1.5}, "loss")])
def test_lines_that_make_no_sense_are_refused(wrong, field):
    with pytest.raises(InputError) as caught:
        DelayedHand(VirtualHand(Step()), **wrong)
    assert caught.value.field == field
