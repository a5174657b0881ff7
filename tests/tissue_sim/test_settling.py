"""Self-weight in the finite elements: the specimen has settled when the tool touches, and the sensor reads zero."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

import tissue_sim as ts
from tissue_sim.fem.axisymmetric.discretisation import build_mesh, build_solver_on_mesh

STUDY = {"C10": 1404.9, "C20": 699.4}
#: Density, kg/m3.
DENSITY = 1040.0
#: Gravitational acceleration, m/s2.
GRAVITY = 9.81
AT = [4, 10, 20]  # samples at 2, 5 and 10 mm


def model(friction="frictionless", *, gravity=GRAVITY, radius=0.040, height=0.070, height_is="moulded", tool=None,
          friction_base=None, density=DENSITY, depth=10e-3, points=21):
    specimen = ts.Specimen(radius, height, density=density, gravity=gravity, height_is=height_is)
    experiment = ts.Experiment(specimen, ts.Protocol.ramp(depth, points), tool=tool or ts.Tool(), friction=friction,
                               friction_base=friction_base or friction)
    return ts.Model(experiment, ts.Material("reduced_polynomial_2", STUDY, ts.Bulk("bulk_ratio", 1e4)))


def column_sag(height):
    """Return the sag of the one-dimensional incompressible column: each slice carries the weight above it."""
    def stress(stretch):
        invariant = stretch**2 + 2 / stretch - 3
        return 2 * (STUDY["C10"] + 2 * STUDY["C20"] * invariant) * (stretch - stretch**-2)

    def loss(load):
        return 1 - brentq(lambda stretch: stress(stretch) + load, 0.2, 1.0)

    weight = DENSITY * GRAVITY
    return quad(lambda above: loss(weight * above), 0, height)[0]


def test_the_study_s_column():
    """The figure of the literature of this project: 2.780 mm."""
    assert column_sag(0.070) * 1e3 == pytest.approx(2.780, abs=1e-3)


@pytest.mark.parametrize("resolution", ["fast", "accurate"])
def test_sag_of_a_tall_column(resolution):
    """Slender: what the one-dimensional theory leaves out is of second order in radius over height."""
    m = model(radius=0.010, height=0.100)
    solver = build_solver_on_mesh(m, build_mesh(m.experiment, resolution))
    assert solver.sag == pytest.approx(column_sag(0.100), rel=1e-3)


@pytest.mark.parametrize("resolution", ["fast", "accurate"])
def test_lubricated_force_against_the_column(resolution):
    """1.3979, 3.7793, 8.9293 N with weight, 1.2496, 3.3176, 7.5999 N without (one-dimensional); the solid's slices
    hinder each other a little."""
    weighs, weightless = (ts.simulate(model(gravity=g), resolution=resolution).force[AT] for g in (GRAVITY, 0.0))
    assert abs(weighs / [1.3979, 3.7793, 8.9293] - 1).max() < 1e-3
    assert abs(weightless / [1.2496, 3.3176, 7.5999] - 1).max() < 2e-4
    rise = weighs / weightless - 1
    assert 0.11 < rise[0] < rise[1] < rise[2] < 0.18


@pytest.mark.slow
@pytest.mark.parametrize("resolution", ["fast", "accurate"])
def test_needle_force_rises(resolution):
    """The force of the study's punch rises by 4 to 6 %, slightly more at the largest depth."""
    needle = ts.Tool("flat", 8e-3)
    weighs, weightless = (ts.simulate(model("bonded", gravity=g, tool=needle), resolution=resolution).force[AT]
                          for g in (GRAVITY, 0.0))
    rise = weighs / weightless - 1
    assert 0.035 < rise[0] < rise[1] < rise[2] < 0.07


@pytest.mark.parametrize(("friction", "tool"), [
    ("frictionless", None), ("bonded", None), ("bonded", ts.Tool("flat", 8e-3)), ("stick", ts.Tool("flat", 8e-3))])
def test_the_sensor_is_zeroed_after_settling(friction, tool):
    recording = ts.simulate(model(friction, tool=tool, friction_base="bonded" if tool else None))
    assert abs(recording.force[0]) < 1e-6 < recording.force[1]
    assert recording.metadata["solver"]["self_weight"]["sag_mm"] > 2.0


def test_placed_height_is_what_the_specimen_stands():
    m = model("bonded", height_is="placed")
    solver = build_solver_on_mesh(m, build_mesh(m.experiment))
    moulded = -solver.mesh.nodes[:, 1].min()
    assert moulded > 0.072
    assert moulded - solver.sag == pytest.approx(0.070, abs=1e-9)
    assert ts.simulate(m).metadata["solver"]["self_weight"]["moulded_height_mm"] == pytest.approx(moulded * 1e3)


def test_no_weight_is_the_weightless_solver():
    still = ts.simulate(model("bonded", gravity=0.0)).force
    faint = ts.simulate(model("bonded", gravity=1e-6)).force
    np.testing.assert_allclose(faint[1:], still[1:], rtol=1e-6)


def test_base_carries_the_weight():
    """The reaction of the base is the weight of the whole specimen."""
    m = model("bonded")
    solver = build_solver_on_mesh(m, build_mesh(m.experiment))
    assert solver.step(0.0).status.name == "CONVERGED"
    base = solver.equations.equation[2 * solver.mesh.sets["base"] + 1]
    weight = DENSITY * GRAVITY * np.pi * 0.040**2 * 0.070
    assert solver.equations.residual[base].sum() == pytest.approx(weight, rel=1e-6)


def test_no_moulded_height_fits():
    with pytest.raises(ts.ConvergenceError, match="Check density and moduli"):
        ts.simulate(model(density=1e5, height_is="placed"))


@pytest.mark.parametrize(("change", "words"), [
    ({"density": None, "gravity": 9.81}, "must be given, in kg/m3, if gravity acts"),
    ({"gravity": -1.0, "density": 1.0}, "gravity"),
    ({"density": -1.0}, "must be positive and finite"), ({"height_is": "guessed"}, "'moulded' or 'placed'")])
def test_bad_input(change, words):
    with pytest.raises(ts.InputError, match=words):
        ts.Specimen(0.040, 0.070, **change)


@pytest.mark.parametrize("radius", [1e-3, 5e-3, 15e-3])
def test_a_small_ball_meets_the_sagged_top(radius):
    """Hertz, F = 16/9 E sqrt(r) d^1.5 of incompressible tissue, a little stiffer at its base for its own weight."""
    depth = 0.02 * radius
    tool = ts.Tool("sphere", radius=radius)
    pressed = ts.simulate(model(tool=tool, height=0.040, friction_base="bonded", depth=depth, points=3)).force[-1]
    hertz = 16 / 9 * 6 * STUDY["C10"] * np.sqrt(radius) * depth**1.5
    assert pressed == pytest.approx(hertz, rel=0.12)
