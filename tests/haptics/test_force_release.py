"""What is given of a tissue's force where no equilibrium is found, where one is found again, and at the beginning."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from haptics.safety.force_release import LARGEST_FIRST_FORCE, PATIENCE, RAMP, ForceRelease
from tissue_sim.errors import InputError
from tissue_sim.pose import Pose
from tissue_sim.tool_force import ForceStatus, NextForce, ToolForce, axial_stiffness, axial_wrench

TICK = 1e-3
STATUSES = [ForceStatus.CONVERGED, ForceStatus.LATE, ForceStatus.STOPPED, ForceStatus.REFUSED]


def answer(status=ForceStatus.CONVERGED, force=5.0):
    return ToolForce(axial_wrench(force), axial_stiffness(800.0), status, 3, 1e-7, inertial=True,
                     pose=Pose.at_depth(0.006), ahead=NextForce(axial_wrench(4.0), axial_stiffness(3000.0)),
                     step_stiffness_matrix=axial_stiffness(3100.0))


@pytest.fixture
def release():
    """One that has let a hand into the air already."""
    release = ForceRelease()
    release.step(answer(force=0.0), 0.0)
    return release


def test_an_equilibrium_goes_through_untouched(release):
    found = answer()
    for k in range(1, 500):
        assert release.step(found, k * TICK) is found


@pytest.mark.parametrize("status", [ForceStatus.LATE, ForceStatus.STOPPED])
def test_force_and_stiffness_fade_together_after_the_patience(release, status):
    lost = answer(status)
    release.step(answer(), 0.0)
    given = [release.step(lost, k * TICK) for k in range(1, 200)]
    patient = round(PATIENCE / TICK) - 1
    assert all(one is lost for one in given[:patient])
    fading = given[patient:]
    assert {one.status for one in fading} == {ForceStatus.FADING}
    shares = [one.force / 5.0 for one in fading]
    assert shares == sorted(shares, reverse=True) and shares[round(RAMP / TICK)] == 0.0
    assert max(a - b for a, b in zip([1.0, *shares], shares, strict=False)) <= 1.5 * TICK / RAMP + 1e-12
    for one, share in zip(fading, shares, strict=True):
        assert one.stiffness == pytest.approx(800.0 * share)
        assert one.step_stiffness == pytest.approx(3100.0 * share)
        assert one.ahead.wrench[2] == pytest.approx(4.0 * share)
        assert one.ahead.stiffness_matrix[2][2] == pytest.approx(3000.0 * share)
        assert (one.iterations, one.inertial, one.depth) == (3, True, lost.depth)


def test_it_comes_back_along_a_ramp_and_says_so(release):
    for k in range(1, 200):
        release.step(answer(ForceStatus.STOPPED), k * TICK)
    back = [release.step(answer(), (200 + k) * TICK) for k in range(100)]
    ramp = [one for one in back if one.status is ForceStatus.RETURNING]
    assert len(ramp) == round(RAMP / TICK) - 1 and ramp == back[:len(ramp)]
    assert [one.force for one in ramp] == sorted(one.force for one in ramp) and ramp[0].force < 0.01
    assert all(one == answer() for one in back[len(ramp):])


def test_a_step_that_took_long_counts_as_long(release):
    """A tissue that hangs for a second and then has nothing has been without equilibrium for a second."""
    assert release.step(answer(ForceStatus.LATE), 1.0).force == 0.0


def test_a_hand_that_begins_inside_begins_without_a_force():
    release = ForceRelease()
    given = [release.step(answer(), k * TICK) for k in range(100)]
    assert (given[0].force, given[0].stiffness, given[0].status) == (0.0, 0.0, ForceStatus.RETURNING)
    assert given[-1] == answer()
    release.reset()
    assert release.step(answer(), 1.0).force == 0.0
    release.reset()
    touch = answer(force=LARGEST_FIRST_FORCE)
    assert release.step(touch, 1.0) is touch


def test_a_refused_pose_stays_refused_and_fades(release):
    given = [release.step(answer(ForceStatus.REFUSED), k * TICK) for k in range(1, 200)]
    assert {one.status for one in given} == {ForceStatus.REFUSED}
    assert given[0].force == 5.0 and given[-1].force == 0.0


def test_local_models_are_given_for_as_long_as_they_like():
    release = ForceRelease(patience=math.inf)
    late = answer(ForceStatus.LATE, force=0.0)
    assert all(release.step(late, 10.0 * k) is late for k in range(100))


@pytest.mark.parametrize("options", [{"patience": 0.0}, {"patience": math.nan}, {"ramp": -1.0}, {"ramp": math.inf}])
def test_times_that_are_none_are_refused(options):
    with pytest.raises(InputError, match="must be positive"):
        ForceRelease(**options)


@given(st.lists(st.tuples(st.sampled_from(STATUSES), st.floats(0.0, 0.2)), max_size=60))
def test_never_more_than_the_tissue_says_and_never_long_without_an_equilibrium(events):
    release, now, found = ForceRelease(), 0.0, 0.0
    for status, passed in events:
        now += passed
        given = release.step(answer(status), now)
        if status is ForceStatus.CONVERGED:
            found = now
        assert given.force <= 5.0 and given.stiffness <= 800.0
        assert given.force / 5.0 == pytest.approx(given.stiffness / 800.0)
        assert release.gain == pytest.approx(given.force / 5.0)
        if now - found > PATIENCE + RAMP + 1e-9:
            assert given.force == 0.0
