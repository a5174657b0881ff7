"""Softening of the form erf (Ogden and Roxburgh; *MULLINS EFFECT of Abaqus): function, closed form, finite elements."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.special import erf

import tissue_sim as ts
from tissue_sim.fem.elements.softening import ERF, make_softening_shape_function
from tissue_sim.fem.taichi.runtime import get_initialised_taichi
from tissue_sim.material.softening import SOFTENING_FORMS
from tissue_sim.mesh.solid import create_cylinder_mesh_under_needle
from tissue_sim.mesh.solid_element import HEX8P0
from tissue_sim.parameters import parameter_values, with_values

#: Shear modulus, Pa.
MU = 3000.0
#: Abaqus' R, 1.
R = 2.5
#: Abaqus' M, Pa.
M = 20.0
#: Abaqus' BETA, 1.
BETA = 0.3
SOFT = ts.Softening(1.0 / R, M, BETA, "erf")
GEL = ts.Material("neo_hooke", {"C10": MU / 2}, ts.Bulk("bulk_ratio", 1e6), softening=SOFT)
PLATE = ts.Tool()
#: Radius, m.
RADIUS = 0.04
#: Height, m.
HEIGHT = 0.05
#: First load, unloading and reloading beyond the first load.
CYCLE = ts.Protocol.parse("ramp 8mm @1mm/s; unload 2mm; ramp 12mm", points=13)


@pytest.mark.parametrize(("form", "function"), [("erf", erf), ("tanh", np.tanh)])
def test_function_of_the_kernels(form, function):
    """Against SciPy, at small, usual and very large arguments; the slope by the exact derivative."""
    ti, evaluate = get_initialised_taichi(), make_softening_shape_function()

    @ti.kernel
    def fill(x: ti.types.ndarray(), found: ti.types.ndarray(), number: ti.f64):
        for i in range(x.shape[0]):
            value, slope = evaluate(ti.Vector([x[i], 0.5 * x[i]]), number)
            found[0, i], found[1, i], found[2, i] = value[0], value[1], slope[0]

    x = np.concatenate([[0.0], np.geomspace(1e-12, 1e300, 20001), np.linspace(0.0, 7.0, 20001)])
    found = np.zeros((3, x.size))
    fill(x, found, float(SOFTENING_FORMS.index(form)))
    np.testing.assert_allclose(found[:2], [function(x), function(0.5 * x)], rtol=0, atol=1e-13)
    bounded = np.minimum(x, 100.0)
    slope = 2.0 / math.sqrt(math.pi) * np.exp(-bounded**2) if form == "erf" else 1.0 / np.cosh(bounded)**2
    np.testing.assert_allclose(found[2], slope, rtol=0, atol=1e-13)
    assert SOFTENING_FORMS[ERF] == "erf"


def test_load_unload_and_reload_in_tension():
    """Neo-Hooke, W = mu/2 (l^2 + 2/l - 3), P = eta mu (l - 1/l^2), with eta written out point by point."""
    stretch = np.concatenate([np.linspace(1.0, 1.5, 11), np.linspace(1.45, 1.0, 10), np.linspace(1.05, 1.8, 16)])
    expected, largest = [], 0.0
    for l in stretch.tolist():
        W = 0.5 * MU * (l**2 + 2.0 / l - 3.0)
        largest = max(W, largest)
        eta = 1.0 - math.erf((largest - W) / (M + BETA * largest)) / R
        expected.append(eta * MU * (l - l**-2))
    found = ts.nominal_stress_history(GEL, np.arange(stretch.size), stretch)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-9)
    tanh = dataclasses.replace(GEL, softening=ts.Softening(1.0 / R, M, BETA))
    assert np.ptp(found / np.maximum(ts.nominal_stress_history(tanh, np.arange(stretch.size), stretch), 1.0)) > 0.02


def model(material, tool=PLATE, friction="frictionless"):
    experiment = ts.Experiment(ts.Specimen(RADIUS, HEIGHT), CYCLE, tool=tool, friction=friction,
                               friction_base=friction)
    return ts.Model(experiment, material)


def solid_mesh():
    return create_cylinder_mesh_under_needle(RADIUS, HEIGHT, 0.024, HEX8P0, smallest=9e-3, growth=2.2, largest=20e-3,
                                             around=2)


def solid_force(material, mesh):
    return ts.simulate(model(material), solver="solid", mesh=mesh).force


def test_axisymmetric_elements_give_the_closed_form():
    found = ts.simulate(model(GEL)).force
    expected = -np.pi * RADIUS**2 * ts.nominal_stress_history(GEL, CYCLE.time, 1.0 - CYCLE.displacement / HEIGHT)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5 * expected.max())


@pytest.mark.slow
def test_solid_elements_give_the_closed_form():
    """The ratio of forces with and without softening is eta, whatever the area of the faceted mesh."""
    mesh, elastic = solid_mesh(), dataclasses.replace(GEL, softening=None)
    found = solid_force(GEL, mesh)[1:] / solid_force(elastic, mesh)[1:]
    strain = 1.0 - CYCLE.displacement / HEIGHT
    soft, stiff = (ts.nominal_stress_history(each, CYCLE.time, strain)[1:] for each in (GEL, elastic))
    assert (soft / stiff).min() < 0.75
    np.testing.assert_allclose(found, soft / stiff, rtol=0, atol=1e-5)


@pytest.mark.parametrize("solver", ["axisymmetric", pytest.param("solid", marks=pytest.mark.slow)])
def test_sensitivities(solver):
    """Exact derivatives against central differences of simulations. The exact solid derivatives allow for the kink."""
    needle = solver == "axisymmetric"
    of = model(dataclasses.replace(GEL, bulk=ts.Bulk("bulk_ratio", 1e4)),
               ts.Tool("flat", 8e-3) if needle else PLATE, "bonded")
    options = {} if needle else {"solver": solver, "mesh": solid_mesh()}
    names = ["C10", "softening.loss", "softening.modulus", "softening.share"]
    answer = ts.sensitivities(of, names, **options)
    assert answer.exact.all()
    for k, name in enumerate(names):
        value = parameter_values(of.material)[name]
        more, less = (ts.simulate(ts.Model(of.experiment, with_values(of.material, {name: factor * value})),
                                  **options).force for factor in (1.0001, 0.9999))
        slope = (more - less) / (2e-4 * value)
        assert abs(slope).max() > 0.0
        np.testing.assert_allclose(answer.values[:, k], slope, rtol=0, atol=1e-5 * abs(slope).max(), err_msg=name)


def test_form_in_the_file(tmp_path):
    """tanh is not written, so that files without it keep their meaning."""
    for soft, written in ((SOFT, {"form": "erf"}), (ts.Softening(0.4, M, BETA), {})):
        path, material = tmp_path / "m.material.json", dataclasses.replace(GEL, softening=soft)
        ts.write_material_file(ts.MaterialFile.of(material), path)
        data = ts.MaterialFile.of(material).softening
        assert ts.load_material(path) == material and data.form == soft.form
        assert ('"form": "erf"' in path.read_text(encoding="utf-8")) == bool(written)
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace('"modulus_Pa"', '"form": "exp", "modulus_Pa"'), encoding="utf-8")
    with pytest.raises(ts.InputError, match=r"softening\.form"):
        ts.load_material(path)
    with pytest.raises(ts.InputError, match="form: must be tanh or erf; got 'exp'"):
        ts.Softening(0.4, form="exp")
