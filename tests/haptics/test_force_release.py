"""`ForceFader`: force and stiffness without equilibrium, after its return, and at the first step."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tissue_sim.errors import InputError
from tissue_sim.pose import Pose
from tissue_sim.realtime.force_fading import RELEASE, ForceFader
from tissue_sim.tool_force import (
    ForceStatus,
    PredictedForceOfNextStep,
    ToolForce,
    make_axial_stiffness_matrix,
    make_axial_wrench,
)

TICK = 1e-3
STATUSES = [ForceStatus.CONVERGED, ForceStatus.LATE, ForceStatus.STOPPED, ForceStatus.REFUSED]


def answer(status=ForceStatus.CONVERGED, force=5.0, age=None):
    """An answer; without an equilibrium it extrapolates that of the last tick."""
    if age is None:
        age = 0.0 if status is ForceStatus.CONVERGED else TICK
    return ToolForce(make_axial_wrench(force), make_axial_stiffness_matrix(800.0), status, 3, 1e-7, inertial=True,
                     age=age,
                     pose=Pose.at_depth(0.006), ahead=PredictedForceOfNextStep(make_axial_wrench(4.0),
                                                                               make_axial_stiffness_matrix(3000.0)),
                     step_stiffness_matrix=make_axial_stiffness_matrix(3100.0))


@pytest.fixture
def release():
    """Force release after a first step with zero force."""
    release = ForceFader()
    release.step(answer(force=0.0), 0.0)
    return release


def test_converged_answers_are_unchanged(release):
    found = answer()
    for k in range(1, 500):
        assert release.step(found, k * TICK) is found


def test_an_equilibrium_with_unresolved_waves_is_not_faded(release):
    found = answer(ForceStatus.LATE, age=0.0)
    assert all(release.step(found, k * TICK) is found for k in range(1, 500))


@pytest.mark.parametrize("status", [ForceStatus.LATE, ForceStatus.STOPPED])
def test_force_and_stiffness_fade_together_after_the_patience(release, status):
    lost = answer(status)
    release.step(answer(), 0.0)
    results = [release.step(lost, k * TICK) for k in range(1, 200)]
    patient = round(RELEASE.patience / TICK) - 1
    assert all(one is lost for one in results[:patient])
    fading = results[patient:]
    assert {one.status for one in fading} == {ForceStatus.FADING}
    gains = [one.force / 5.0 for one in fading]
    assert gains == sorted(gains, reverse=True) and gains[round(RELEASE.ramp / TICK)] == 0.0
    assert max(a - b for a, b in zip([1.0, *gains], gains, strict=False)) <= 1.5 * TICK / RELEASE.ramp + 1e-12
    for one, gain in zip(fading, gains, strict=True):
        assert one.stiffness == pytest.approx(800.0 * gain)
        assert one.step_stiffness == pytest.approx(3100.0 * gain)
        assert one.ahead.wrench[2] == pytest.approx(4.0 * gain)
        assert one.ahead.stiffness_matrix[2][2] == pytest.approx(3000.0 * gain)
        assert (one.iterations, one.inertial, one.depth) == (3, True, lost.depth)


def test_force_returns_along_a_ramp_with_the_status_returning(release):
    for k in range(1, 200):
        release.step(answer(ForceStatus.STOPPED), k * TICK)
    back = [release.step(answer(), (200 + k) * TICK) for k in range(100)]
    ramp = [one for one in back if one.status is ForceStatus.RETURNING]
    assert len(ramp) == round(RELEASE.ramp / TICK) - 1 and ramp == back[:len(ramp)]
    assert [one.force for one in ramp] == sorted(one.force for one in ramp) and ramp[0].force < 0.01
    assert all(one == answer() for one in back[len(ramp):])


def test_the_duration_of_a_step_counts_as_time_without_equilibrium(release):
    """A step of 1 s without equilibrium exceeds patience and ramp, so its force is zero."""
    assert release.step(answer(ForceStatus.LATE), 1.0).force == 0.0


def test_a_hand_that_begins_inside_begins_without_a_force():
    release = ForceFader()
    results = [release.step(answer(), k * TICK) for k in range(100)]
    assert (results[0].force, results[0].stiffness, results[0].status) == (0.0, 0.0, ForceStatus.RETURNING)
    assert results[-1] == answer()
    release.reset()
    assert release.step(answer(), 1.0).force == 0.0
    release.reset()
    touch = answer(force=RELEASE.largest_first_force)
    assert release.step(touch, 1.0) is touch


def test_refused_answers_keep_their_status_and_fade(release):
    results = [release.step(answer(ForceStatus.REFUSED), k * TICK) for k in range(1, 200)]
    assert {one.status for one in results} == {ForceStatus.REFUSED}
    assert results[0].force == 5.0 and results[-1].force == 0.0


def test_infinite_patience_never_fades():
    release = ForceFader(patience=math.inf)
    late = answer(ForceStatus.LATE, force=0.0)
    assert all(release.step(late, 10.0 * k) is late for k in range(100))


@pytest.mark.parametrize("options", [{"patience": 0.0}, {"patience": math.nan}, {"ramp": -1.0}, {"ramp": math.inf}])
def test_invalid_times_are_refused(options):
    with pytest.raises(InputError, match="must be positive"):
        ForceFader(**options)


@given(st.lists(st.tuples(st.sampled_from(STATUSES), st.floats(0.0, 0.2)), max_size=60))
def test_force_is_at_most_that_of_the_tissue_and_zero_after_patience_and_ramp(events):
    release, now, last_equilibrium = ForceFader(), 0.0, 0.0
    for status, passed in events:
        now += passed
        result = release.step(answer(status), now)
        if status is ForceStatus.CONVERGED:
            last_equilibrium = now
        assert result.force <= 5.0 and result.stiffness <= 800.0
        assert result.force / 5.0 == pytest.approx(result.stiffness / 800.0)
        assert release.gain == pytest.approx(result.force / 5.0)
        if now - last_equilibrium > RELEASE.patience + RELEASE.ramp + 1e-9:
            assert result.force == 0.0
