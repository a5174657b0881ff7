"""`ForceRendering`: from the depth of the device to the force on the hand, tick by tick."""

import math
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from haptics.safety.coupling import VirtualCoupling
from haptics.safety.limits import ForceLimiter
from haptics.safety.passivity import ReturnedEnergyCutoff
from haptics.safety.rendering import ForceRendering, RenderFlag
from tissue_sim.pose import Pose
from tissue_sim.realtime.force_fading import Watchdog, WatchdogState
from tissue_sim.realtime.local_model import LocalModel, LocalModelBlend
from tissue_sim.tool_force import ForceStatus, ToolForce

DT = 1e-3
AWAY = (WatchdogState.FADING, WatchdogState.LOST, WatchdogState.RETURNING)


class Spring:
    """Elastic tissue that records the depths of its steps."""

    def __init__(self, stiffness=500.0, status=ForceStatus.CONVERGED):
        self.stiffness, self.status, self.depths = stiffness, status, []

    def step(self, pose, dt):
        self.depths.append(pose.depth)
        return ToolForce.from_axial_force(self.stiffness * pose.depth, self.stiffness, self.status)


def at(depth):
    """Return the pose of the device at a depth, m; None: no pose."""
    return None if depth is None else Pose((0.0, 0.0, -depth))


def run(rendering, tissue, depths):
    return [rendering.render(tissue.step(rendering.advance_proxy(at(depth), DT), DT), DT) for depth in depths]


def generous():
    return ForceLimiter(force=100.0, rate=100.0)


def test_without_a_coupling_the_tissue_gets_the_pose_of_the_device():
    tissue = Spring()
    rendered = run(ForceRendering(generous()), tissue, [0.0, 1e-3, 2e-3])
    assert tissue.depths == [0.0, 1e-3, 2e-3]
    assert [tick.force for tick in rendered] == pytest.approx([0.0, 0.5, 1.0])
    assert [tick.flags for tick in rendered] == [0, 0, 0]
    assert rendered[-1].proxy_depth == 2e-3
    assert rendered[-1].energy == pytest.approx(500 * 4e-6 / 2)
    assert rendered[-1].held_energy == pytest.approx(0.5 * 1e-3)


def test_with_a_coupling_the_springs_act_in_series():
    rendering = ForceRendering(generous(), VirtualCoupling(1500.0, 1.0))
    rendered = run(rendering, Spring(500.0), [0.0] + [4e-3] * 300)
    assert rendered[-1].force == pytest.approx(4e-3 * 375.0)
    assert rendered[-1].proxy_depth == pytest.approx(3e-3)


@pytest.mark.parametrize("status", [ForceStatus.LATE, ForceStatus.STOPPED])
def test_local_models_are_rendered(status):
    rendered = run(ForceRendering(generous()), Spring(status=status), [2e-3] * 200)
    assert rendered[-1].force == pytest.approx(1.0)
    assert not rendered[-1].is_faded_by_watchdog


@pytest.mark.parametrize("coupling", [None, VirtualCoupling(1500.0, 1.0)])
def test_a_missing_pose_fades_the_force(coupling):
    """None, NaN and a refusal have the same effect; the force is zero after timeout and ramp, within the rate limit."""
    for missing in (None, math.nan, "refused"):
        tissue, rate = Spring(), 0.05
        rendering = ForceRendering(ForceLimiter(10.0, rate), coupling, Watchdog(0.050, 0.100))
        forces, states = [], []
        for tick in range(1000):
            lost = 300 <= tick < 600
            tissue.status = ForceStatus.REFUSED if lost and missing == "refused" else ForceStatus.CONVERGED
            depth = missing if lost and missing != "refused" else 6e-3
            rendered, = run(rendering, tissue, [depth])
            forces.append(rendered.force)
            states.append(rendered.state)
            assert rendered.is_faded_by_watchdog == (rendered.state in AWAY)
        full = forces[299]
        assert full == pytest.approx(3.0 if coupling is None else 6e-3 * 375.0)
        assert forces[300:349] == pytest.approx([full] * 49)
        assert forces[349] < full
        assert forces[449:600] == [0.0] * 151
        assert forces[-1] == pytest.approx(full)
        assert max(abs(b - a) for a, b in pairwise(forces)) <= rate + 1e-12
        assert states[500] is WatchdogState.LOST and states[650] is WatchdogState.RETURNING
        assert states[-1] is WatchdogState.TRACKING


@pytest.mark.parametrize("coupled", [False, True])
@pytest.mark.parametrize("bad", [ToolForce.from_axial_force(9.0, 500.0, ForceStatus.REFUSED),
                                 ToolForce.from_axial_force(math.nan, 500.0, ForceStatus.CONVERGED),
                                 ToolForce.from_axial_force(9.0, math.inf, ForceStatus.LATE)])
def test_an_invalid_answer_keeps_force_and_proxy(bad, coupled):
    """Force and proxy stay constant until the timeout of the watchdog."""
    rendering = ForceRendering(generous(), VirtualCoupling(1500.0, 1.0) if coupled else None)
    before = run(rendering, Spring(), [2e-3] * 300)[-1]
    rendering.advance_proxy(at(2e-3), DT)
    for _ in range(20):
        rendered = rendering.render(bad, DT)
        assert (rendered.force, rendered.flags) == (pytest.approx(before.force), 0)
        assert rendered.state is WatchdogState.MISSING
        if coupled:
            assert rendering.advance_proxy(at(3e-3), DT).depth == pytest.approx(before.proxy_depth)


depths = st.none() | st.floats(-0.02, 0.02) | st.sampled_from([math.nan, math.inf])
answers = st.tuples(st.floats(allow_nan=True, allow_infinity=True) | st.floats(-20, 20),
                    st.floats(allow_nan=True, allow_infinity=True) | st.floats(-1e4, 1e4), st.sampled_from(ForceStatus),
                    st.booleans())
ticks = st.sampled_from([DT, DT, DT, 5e-3, 0.0, -1.0, math.nan])


@settings(deadline=None)
@given(st.lists(st.tuples(depths, answers, ticks), max_size=60), st.booleans(), st.none() | st.floats(0.1, 5.0))
def test_force_and_rate_limits_hold_for_any_input(path, coupled, damping):
    """Any pose, answer and dt: no exception, no force above the limit, no change above the rate."""
    rendering = ForceRendering(ForceLimiter(5.0, 0.1), VirtualCoupling(2000.0, 1.0, 1e-3) if coupled else None,
                               controller_damping=damping)
    last = 0.0
    for depth, (force, stiffness, status, inertial), dt in path:
        rendering.advance_proxy(at(depth), dt)
        rendered = rendering.render(ToolForce.from_axial_force(force, stiffness, status, inertial=inertial), dt)
        assert abs(rendered.force) <= 5.0
        assert abs(rendered.force - last) <= 0.1 + 1e-12
        last = rendered.force


@pytest.mark.slow
@settings(deadline=None)
@given(st.lists(st.tuples(depths, answers, ticks), max_size=30), st.booleans())
def test_the_force_returns_after_any_input(path, coupled):
    rendering = ForceRendering(ForceLimiter(5.0, 0.1), VirtualCoupling(2000.0, 1.0) if coupled else None)
    for depth, (force, stiffness, status, inertial), dt in path:
        rendering.advance_proxy(at(depth), dt)
        rendering.render(ToolForce.from_axial_force(force, stiffness, status, inertial=inertial), dt)
    rendered = run(rendering, Spring(500.0), [2e-3] * 1500)
    assert rendered[-1].force == pytest.approx(1.0 if not coupled else 2e-3 * 400.0)
    assert not rendered[-1].is_faded_by_watchdog and not rendered[-1].limited


def test_flags_name_the_events_of_a_tick():
    rendering, tissue = ForceRendering(ForceLimiter(force=1.0, rate=0.6)), Spring()
    first, second = run(rendering, tissue, [4e-3] * 2)
    assert RenderFlag(first.flags) == RenderFlag.LIMITED | RenderFlag.RATE_LIMITED
    assert first.limited and first.rate_limited
    assert RenderFlag(second.flags) == RenderFlag.LIMITED
    rendering.advance_proxy(at(4e-3), DT)
    bad = rendering.render(tissue.step(at(4e-3), DT), math.nan)
    assert bad.has_invalid_force_or_time_step and bad.force == pytest.approx(0.4)


def test_the_flag_active_refers_to_the_held_force():
    """An elastic tissue returns the energy put in; with its force held over a tick it returns more."""
    path = [2e-3 * (1 - math.cos(2 * math.pi * 4 * tick * DT)) for tick in range(251)]
    rendered = run(ForceRendering(generous()), Spring(1000.0), path)[-1]
    assert rendered.energy == pytest.approx(0.0, abs=1e-12)
    assert rendered.held_energy < 0 and rendered.is_port_active


def test_an_active_tissue_is_detected_and_can_be_damped():
    """A spring with a delay of two ticks and a hold of one returns 2.5 K step^2 too much in each tick."""
    stiffness, energies, active = 1000.0, [], []
    for damping in (None, 20.0):
        rendering, late, steps, last = ForceRendering(generous(), controller_damping=damping), [0.0, 0.0], 0.0, 0.0
        for tick in range(1001):
            depth = 2e-3 * (1 - math.cos(2 * math.pi * 4 * tick * DT))
            late.append(stiffness * rendering.advance_proxy(at(depth), DT).depth)
            rendered = rendering.render(ToolForce.from_axial_force(late.pop(0), stiffness, ForceStatus.LATE), DT)
            steps, last = steps + (depth - last) ** 2, depth
        energies.append(rendered.held_energy)
        active.append(rendered.is_port_active)
    assert energies[0] == pytest.approx(-2.5 * stiffness * steps, rel=0.01)
    assert active[0]
    assert abs(energies[1]) < 0.05 * abs(energies[0])


def test_the_force_is_zero_before_the_first_pose():
    tissue = Spring()
    rendered = run(ForceRendering(generous()), tissue, [None] * 3)
    assert tissue.depths == [0.0] * 3
    assert [tick.force for tick in rendered] == [0.0] * 3


def test_a_local_model_blend_can_be_rendered():
    blend = LocalModelBlend(jump=0.02)
    blend.publish(LocalModel.from_axial_force(1.0, 500.0, 2e-3, time=0.0))
    rendered = run(ForceRendering(generous()), blend, [2e-3] * 60)
    assert [tick.force for tick in rendered[:3]] == pytest.approx([0.02, 0.04, 0.06])
    assert rendered[-1].force == pytest.approx(1.0)


def test_reset_restores_the_initial_state_of_separate_instances():
    one, other = (ForceRendering(ForceLimiter(5.0, 0.1), VirtualCoupling(1000.0)) for _ in range(2))
    path = [0.0, 1e-3, 3e-3, None, 2e-3]
    first = run(one, Spring(), path)
    assert run(other, Spring(), path) == first
    assert run(one, Spring(), path) != first
    one.reset()
    assert run(one, Spring(), path) == first


@pytest.mark.parametrize("coupled", [False, True])
def test_torque_reaches_the_hand_and_the_tool_turns_with_the_device(coupled):
    rendering = ForceRendering(generous(), VirtualCoupling(1500.0, 1.0) if coupled else None)
    device = Pose((1e-3, 2e-3, -3e-3), (0.6, 0.0, 0.8, 0.0))
    tool = rendering.advance_proxy(device, DT)
    assert tool == device
    answer = ToolForce((0.1, 0.2, 0.3, 0.04, 0.05, 0.06), ((0.0,) * 6,) * 6, ForceStatus.CONVERGED)
    rendered = rendering.render(answer, DT)
    assert rendered.wrench[3:] == answer.wrench[3:]
    assert coupled or rendered.wrench == answer.wrench


def test_tissue_that_drives_a_hand_is_let_go_for_good():
    """Wrong sign: 500 N/m over 0.1 m would return 2.5 J; with a limit of 0.2 J little more than 0.2 J is returned."""
    for energy, most in ((math.inf, 2.0), (0.2, 0.3)):
        rendering = ForceRendering(ForceLimiter(100.0, 5.0), energy_limit=ReturnedEnergyCutoff(energy))
        rendered = run(rendering, Spring(-500.0), [1e-4 * k for k in range(1001)])
        assert rendered[-1].has_exceeded_energy_limit == (energy < math.inf)
        assert (rendered[-1].force == 0.0) == (energy < math.inf)
        assert most / 2 < -rendered[-1].held_energy < most * 1.5
    flagged = [tick.flags & RenderFlag.ENERGY for tick in rendered]
    assert flagged == sorted(flagged), "until a reset"
    rendering.reset()
    assert not run(rendering, Spring(), [0.0, 1e-3])[-1].has_exceeded_energy_limit
