"""The session of a solid in space: the tool goes aside and along its own axis, and what is shown is what is felt."""

import math
from dataclasses import replace

import numpy as np
import pytest
from coarse_solid import make_coarse_solid

import tissue_sim as ts
from haptics.loop.loop import LoopSettings
from scenes.viewer.frame import Phase
from scenes.viewer.scene import limit_lateral_position_to_top
from scenes.viewer.session import Session
from tissue_sim.fem.solver import SOLVERS
from tissue_sim.pose import Pose
from tissue_sim.snapshot import Snapshot

pytestmark = pytest.mark.slow

ANGLE = math.radians(15.0)
#: Offset of the tool, m.
OFFSET = 10e-3
#: Steps of the way down.
STAGES = 12
LOOP = LoopSettings(period=20e-3, snapshot_rate=30.0, real_time=False, patience=1e4)


@pytest.fixture(scope="module")
def scene(needle):
    experiment = replace(needle.experiment, tool=ts.Tool("round", radius=8e-3), friction=0.3,
                         approach=ts.Approach(OFFSET, ANGLE))
    return replace(needle, experiment=experiment, solver="coarse_solid")


@pytest.fixture(scope="module")
def session(scene, until):
    SOLVERS.register(make_coarse_solid, "coarse_solid")
    with pytest.MonkeyPatch.context() as patch:
        # Each tick finds its equilibrium, however slow the computer is.
        patch.setattr("scenes.viewer.live_simulation.BUDGET", None)
        session = Session(scene, settings=LOOP, curve_resolution="realtime")
    try:
        until(session.update_and_make_frame, lambda frame: frame.readouts is not None and frame.snapshot is not None)
        yield session
    finally:
        session.close()
        SOLVERS.unregister("coarse_solid")


def asked(session, command, **values):
    told = []
    session.post(command, reply=told.append, **values)
    frame = session.update_and_make_frame()
    assert told == [None]
    return frame


def at(place):
    def there(frame):
        return np.abs(np.array(frame.snapshot.pose.position) - place).max() < 1e-7
    return there


def test_the_tool_goes_along_its_axis_and_aside_and_back(session, scene, until):
    first = session.update_and_make_frame()
    assert first.phase is Phase.RUNNING
    assert first.snapshot.is_three_dimensional and first.snapshot.drawable_fields is first.snapshot.fields
    assert first.snapshot.skin is None and first.surface is None
    assert first.across == (OFFSET, 0.0)
    np.testing.assert_allclose(first.snapshot.pose.position, (OFFSET, 0.0, 0.0), atol=1e-9)
    depth, approach = 0.6e-3, scene.experiment.approach
    # In stages: friction depends on the path, and on a busy computer one tick may contain a whole motion.
    for stage in np.linspace(0.0, depth, STAGES + 1)[1:]:
        asked(session, "aim", depth=stage)
        frame = until(session.update_and_make_frame, at(approach.pose(stage).position))
    assert frame.snapshot.pose.orientation == approach.pose(depth).orientation
    frame = until(session.update_and_make_frame, lambda frame: frame.readouts.status == "in equilibrium")
    assert frame.readouts.depth == pytest.approx(depth, abs=1e-6), "along the axis, as displacements are"
    # The same way in a simulation: the force of the whole test at that displacement.
    model = ts.Model(replace(scene.experiment, protocol=ts.Protocol.ramp(depth, STAGES + 1)), scene.material)
    expected = ts.simulate(model, solver="solid", mesh=make_coarse_solid(model).mesh)
    assert frame.readouts.force == pytest.approx(expected.force[-1], rel=0.02)
    assert frame.readouts.across[0] == pytest.approx(float(expected.channel("Fx")[-1]), abs=0.02 * expected.force[-1])
    fields = frame.snapshot.fields
    assert fields.at_nodes("displacement").max() > 0.5 * depth
    moved = np.array(frame.snapshot.pose.position)
    for fraction in np.linspace(0.0, 1.0, STAGES + 1)[1:]:
        asked(session, "aim", across=(OFFSET - fraction * 0.4e-3, fraction * 0.5e-3))
        frame = until(session.update_and_make_frame, at(moved + fraction * np.array([-0.4e-3, 0.5e-3, 0.0])))
    assert frame.across == pytest.approx((OFFSET - 0.4e-3, 0.5e-3)) and frame.target == depth, "as deep as it was"
    frame = until(session.update_and_make_frame, lambda frame: frame.readouts.status == "in equilibrium")
    assert frame.readouts.across[1] < 0.0, "the tissue holds back what is dragged towards +y"
    asked(session, "reset")
    frame = until(session.update_and_make_frame, at((OFFSET, 0.0, 0.0)))
    assert frame.across == (OFFSET, 0.0) and frame.target == 0.0


def test_a_protocol_is_played_along_the_axis_of_the_tool(session, scene, until):
    asked(session, "play", text="ramp 0.2mm @2mm/s; hold 600s; unload")
    until(session.update_and_make_frame, at(scene.experiment.approach.pose(0.2e-3).position))
    asked(session, "reset")


def test_no_part_of_the_tool_leaves_the_top(session, scene, until):
    snapshot = session.update_and_make_frame().snapshot
    frame = asked(session, "aim", depth=-2e-3, across=(1.0, 1.0))
    x, y = frame.across
    assert x == pytest.approx(y)
    # The top of the coarse mesh is a polygon within the circle.
    assert 0.85 * 32e-3 < math.hypot(x, y) < 32e-3 + 1e-9
    assert limit_lateral_position_to_top(scene.experiment, snapshot, (1e-3, -2e-3)) == pytest.approx((1e-3, -2e-3))
    without = Snapshot(Pose.at_depth(0.0), 0.0, None)
    assert math.hypot(*limit_lateral_position_to_top(scene.experiment, without, (0.0, 1.0))) \
        == pytest.approx(32e-3, rel=1e-2)
