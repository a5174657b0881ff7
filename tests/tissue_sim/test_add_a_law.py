"""The law that CONTRIBUTING.md adds, taken from its page: a newcomer's class is complete as printed."""

import re
from pathlib import Path

import numpy as np
import pytest

import tissue_sim as ts

PAGE = Path(__file__).resolve().parents[2] / "CONTRIBUTING.md"
VALUES = {"mu": 2800.0, "alpha": 1.5}


@pytest.fixture(scope="module")
def law():
    """Law of Lopez-Pamies, registered for the tests of this file only."""
    namespace = {"__name__": "contributing"}
    python = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    assert len(python) == 2
    for block in python:
        exec(compile(block, PAGE.name, "exec"), namespace)
    yield ts.find_law("lopez_pamies")
    ts.LAWS.unregister("lopez_pamies")


def energy_along(stretch, mu, alpha):
    """Energy in uniaxial loading, written out here once more, Pa."""
    I1 = stretch**2 + 2 / stretch
    return 3 * mu / (2 * alpha) * ((I1 / 3)**alpha - 1)


def test_stress_is_the_slope_of_the_energy(law):
    stretch, h = np.linspace(0.6, 1.6, 21), 1e-5
    slope = (energy_along(stretch + h, **VALUES) - energy_along(stretch - h, **VALUES)) / (2 * h)
    scale = np.abs(slope).max()
    np.testing.assert_allclose(law.nominal_stress(stretch, VALUES), slope, rtol=1e-7, atol=1e-9 * scale)


def test_parameter_derivatives(law):
    stretch = np.linspace(0.6, 1.6, 11)
    exact = law.nominal_stress_parameter_derivatives(stretch, VALUES)
    for column, name in enumerate(law.parameters):
        h = 1e-5 * VALUES[name]
        up, down = ({**VALUES, name: VALUES[name] + sign * h} for sign in (1, -1))
        difference = (law.nominal_stress(stretch, up) - law.nominal_stress(stretch, down)) / (2 * h)
        np.testing.assert_allclose(exact[:, column], difference, rtol=1e-7, atol=1e-7 * np.abs(difference).max())


def test_moduli_and_stability(law):
    assert law.mu0(VALUES) == pytest.approx(VALUES["mu"], rel=1e-12)
    assert law.E0(VALUES) == pytest.approx(3 * VALUES["mu"], rel=1e-12)
    assert ts.find_stability_range(law, VALUES).is_stable_in_whole_range


def test_is_neo_hooke_for_the_exponent_one(law):
    stretch = np.linspace(0.6, 1.6, 11)
    neo_hooke = ts.find_law("neo_hooke").nominal_stress(stretch, {"C10": VALUES["mu"] / 2})
    np.testing.assert_allclose(law.nominal_stress(stretch, {"mu": VALUES["mu"], "alpha": 1.0}), neo_hooke, rtol=1e-12)


@pytest.mark.slow
def test_finite_elements_follow_the_closed_form(law):
    """Lubricated compression is uniaxial: the force is the closed form's up to K/mu = 1e5."""
    from scenes import SCENES

    radius, height = 0.04, 0.07
    protocol = ts.Protocol.ramp(0.010, points=6)
    experiment = SCENES["lubricated_compression"].experiment(
        specimen=ts.Specimen(radius, height), protocol=protocol)
    recording = ts.simulate(ts.Model(experiment, ts.Material("lopez_pamies", VALUES, ts.Bulk("bulk_ratio", 1e5))))
    closed = -np.pi * radius**2 * law.nominal_stress(1 - recording.displacement / height, VALUES)
    np.testing.assert_allclose(recording.force[1:], closed[1:], rtol=1e-4)
