"""Beyond the stretch at which compressed tissue loses its one equilibrium a simulator stops."""

import numpy as np
import pytest

import tissue_sim as ts

#: Radius and height of the specimen, m.
RADIUS = 0.030
HEIGHT = 0.035
#: Pa.
C10 = 5000.0
MATERIAL = ts.Material("neo_hooke", {"C10": C10}, ts.Bulk("bulk_ratio", 1e4))


def uniaxial(depth):
    """Force of an incompressible neo-Hookean cylinder between frictionless plates, N."""
    stretch = 1.0 - depth / HEIGHT
    return 2.0 * C10 * (stretch**-2 - stretch) * np.pi * RADIUS**2


def simulator(tool, friction):
    experiment = ts.Experiment(ts.Specimen(RADIUS, HEIGHT), ts.Protocol.ramp(2e-3, 2), tool=tool, friction=friction)
    made = ts.Simulator(ts.Model(experiment, MATERIAL), resolution="realtime_20", inertia="off")
    made.warm_up()
    return made


def test_every_converged_force_of_a_plate_is_that_of_the_closed_form():
    """Beyond 75 % the mesh found another equilibrium with a quarter of the force."""
    one = simulator(ts.Tool("plate"), "frictionless")
    answers = [one.step(fraction * HEIGHT, 1e-3) for fraction in np.arange(0.05, 1.3, 0.05)]
    converged = [answer for answer in answers if answer.status is ts.ForceStatus.CONVERGED]
    expected = [uniaxial(answer.depth) for answer in converged]
    assert [answer.force for answer in converged] == pytest.approx(expected, rel=0.01)
    assert converged[-1].depth > 0.5 * HEIGHT
    rest = answers[len(converged):]
    assert len(rest) > 5 and all(answer.status is ts.ForceStatus.STOPPED for answer in rest)
    assert all(answer.force < 1.3 * converged[-1].force for answer in rest)


@pytest.mark.parametrize(("tool", "friction"), [(ts.Tool("plate"), "frictionless"), (ts.Tool("flat", 6e-3), "bonded")],
                         ids=["plate", "needle"])
def test_a_tool_that_comes_back_finds_the_tissue_as_it_was(tool, friction):
    one = simulator(tool, friction)
    before = one.step(1e-3, 1e-3).force
    deep = one.step(2.5 * HEIGHT, 1e-3)
    assert deep.status is ts.ForceStatus.STOPPED and deep.depth < 0.6 * HEIGHT
    back = one.step(1e-3, 1e-3)
    assert back.status is ts.ForceStatus.CONVERGED and back.force == pytest.approx(before, rel=1e-4)
