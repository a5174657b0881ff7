"""Effects that are stated and not solved for, in the solid in space: drainage and puncture."""

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.mesh.solid import create_cylinder_mesh_under_needle
from tissue_sim.mesh.solid_element import HEX8P0

#: Name of the law.
LAW = "reduced_polynomial_2"
#: Parameters of the reference study, Pa.
STUDY = {"C10": 1404.9, "C20": 699.4}
BULK = ts.Bulk("bulk_ratio", 1e4)
#: Radius, m.
RADIUS = 0.040
#: Height, m.
HEIGHT = 0.070
#: Plate.
PLATE = ts.Tool()
#: Flat needle.
NEEDLE = ts.Tool("flat", 8e-3)
CYLINDER = ts.Specimen(RADIUS, HEIGHT)
WET = ts.Poroelasticity(phi=0.3, diffusivity=1e-6)


def cylinder(centre=(0.0, 0.0)):
    return create_cylinder_mesh_under_needle(RADIUS, HEIGHT, 8e-3, HEX8P0, smallest=2.4e-3, growth=2.2, largest=20e-3,
                                             around=2,
                                             centre=centre)


def simulated(protocol, *, tool=NEEDLE, friction="bonded", specimen=CYLINDER, approach=None, mesh=None,
              solver="solid", resolution="realtime", **material) -> ts.Recording:
    experiment = ts.Experiment(specimen, protocol, tool=tool, friction=friction, friction_base="bonded",
                               approach=approach)
    return ts.simulate(ts.Model(experiment, ts.Material(LAW, STUDY, BULK, **material)), solver=solver, mesh=mesh,
                       **({} if solver == "axisymmetric" else {"resolution": resolution}))


@pytest.mark.slow
@pytest.mark.parametrize(("options", "radius"), [
    ({"mesh": cylinder()}, 8e-3), ({"mesh": cylinder((10e-3, 0.0)), "approach": ts.Approach(10e-3, 0.2)}, 8e-3),
    ({"tool": PLATE, "specimen": ts.Block(0.03, 0.05, 0.04)}, 0.015)], ids=["needle", "oblique needle", "block"])
def test_a_hold_drains_with_the_square_of_the_contact(options, radius):
    """After a sudden ramp the force falls by phi with tau = a^2 / D, as nothing moves; of a block, a is half its
    shorter side."""
    protocol = ts.Protocol.parse("ramp 4mm @1m/s; hold 3000s", points=5)
    recording = simulated(protocol, **options, poroelasticity=WET)
    hold = slice(4, None)
    force, since = recording.force[hold], recording.time[hold] - recording.time[4]
    expected = 1.0 - 0.3 * (1.0 - np.exp(-since / (radius**2 / WET.diffusivity)))
    np.testing.assert_allclose(force / force[0], expected, atol=2e-3)
    assert expected[-1] == pytest.approx(0.7, abs=1e-5) and np.abs(expected[1:-1] - 0.7).max() > 0.05
    dry = simulated(protocol, **options).force[4]
    assert force[0] == pytest.approx(dry, rel=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("tool", "friction", "drying"), [(NEEDLE, "bonded", 1e-6), (PLATE, "bonded", 2e-5),
                                                          (PLATE, "frictionless", 2e-5)])
def test_drainage_is_that_of_the_axisymmetric_solid(tool, friction, drying):
    """While the tool goes in, rests, goes back and rests again; over the force of each without drainage."""
    wet = ts.Poroelasticity(0.3, drying)
    protocol = ts.Protocol.parse("ramp 5mm @0.1mm/s; hold 60s; unload 2mm; hold 60s", points=6)
    shares = []
    for solver, mesh in (("axisymmetric", None), ("solid", cylinder())):
        forces = [simulated(protocol, tool=tool, friction=friction, solver=solver, mesh=mesh, **each).force[1:]
                  for each in ({"poroelasticity": wet}, {})]
        shares.append(forces[0] / forces[1])
    np.testing.assert_allclose(shares[1], shares[0], rtol=0.01)
    assert shares[0].min() < 0.8


@pytest.mark.slow
def test_a_puncture_takes_its_share_of_the_whole_force():
    protocol = ts.Protocol.parse("ramp 4mm; unload 1mm", points=5)
    options = {"mesh": cylinder((10e-3, 0.0)), "approach": ts.Approach(10e-3, 0.2)}
    whole, torn = (simulated(protocol, **options, **each) for each in ({}, {"puncture": ts.Puncture(2.5e-3, 0.3)}))
    for name in ("Fx", "Fz"):
        before, after = whole.channel(name), torn.channel(name)
        np.testing.assert_allclose(after[:3], before[:3], rtol=1e-12)
        np.testing.assert_allclose(after[3:], 0.7 * before[3:], rtol=1e-12)
