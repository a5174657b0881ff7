"""Materials that tests of exports share: each law, bulk response and relaxation, and their comparison."""

from itertools import product

import numpy as np
import pytest
from hypothesis import strategies as st

import tissue_sim as ts
from tissue_sim.exports import ExportContent
from tissue_sim.exports.unit_systems import UNIT_SYSTEMS

#: Law -> parameters, SI.
PARAMETERS = {
    "neo_hooke": {"C10": 1500.0},
    "mooney_rivlin": {"C10": 800.0, "C01": 760.0},
    "reduced_polynomial_1": {"C10": 1404.9},
    "reduced_polynomial_2": {"C10": 1404.9, "C20": 699.4},
    "reduced_polynomial_3": {"C10": 1404.9, "C20": 699.4, "C30": 30.0},
    "biderman": {"C10": 900.0, "C01": 500.0, "C20": 699.4, "C30": 30.0},
    "ogden_1": {"mu1": 2800.0, "alpha1": 3.7},
    "ogden_2": {"mu1": 1500.0, "alpha1": 3.0, "mu2": 800.0, "alpha2": -2.5},
    "ogden_3": {"mu1": 1500.0, "alpha1": 3.0, "mu2": 800.0, "alpha2": -2.5, "mu3": -200.0, "alpha3": 1.3},
    "ogden_4": {"mu1": 1500.0, "alpha1": 3.0, "mu2": 800.0, "alpha2": -2.5, "mu3": -200.0, "alpha3": 1.3, "mu4": 90.0,
                "alpha4": 5.0},
    "gent": {"mu": 2800.0, "J_m": 9.7},
    "arruda_boyce": {"mu": 2100.0, "lambda_m": 1.7},
    "fung_demiray": {"mu": 2800.0, "b": 0.43},
}
#: Law of compressible foams -> parameters, SI.
FOAMS = {
    "hyperfoam_1": {"mu1": 1000.0, "alpha1": 4.0, "nu1": 0.2},
    "hyperfoam_2": {"mu1": 1000.0, "alpha1": 4.0, "nu1": 0.2, "mu2": 500.0, "alpha2": -2.0, "nu2": 0.35},
    "hyperfoam_3": {"mu1": 1000.0, "alpha1": 4.0, "nu1": 0.2, "mu2": 500.0, "alpha2": -2.0, "nu2": 0.35, "mu3": 200.0,
                    "alpha3": 8.0, "nu3": -0.1},
}
#: Target -> laws that it does not have.
MISSING = {"abaqus": {"gent", "fung_demiray"}, "calculix": {"gent", "fung_demiray", "ogden_4"},
           "febio": {"arruda_boyce"}}
#: Target -> laws that it has.
LAWS = {target: [law for law in PARAMETERS if law not in missing] for target, missing in MISSING.items()}
BULKS = (ts.Bulk(), ts.Bulk("K_Pa", 4.3e6), ts.Bulk("D1_per_Pa", 7.3e-7), ts.Bulk("bulk_ratio", 51.0))
TERMS = (ts.PronyTerm(0.3, 2.0), ts.PronyTerm(0.123456789012345, 41.7))
RELAXATIONS = (None, ts.Prony(TERMS), ts.Prony(TERMS, "long_term"))
#: Stretches along the axis of a specimen, at which stresses of an exported text are compared.
STRETCHES = np.linspace(0.5, 2.0, 31)
#: Relative accuracy of a material that was written and read.
ROUND_TRIP = 1e-12


def list_materials(law, relaxations=RELAXATIONS):
    """Materials of a law with each bulk response and relaxation."""
    return [ts.Material(law, PARAMETERS[law], bulk, 1040.0, "GEL", viscoelastic=relaxation)
            for bulk, relaxation in product(BULKS, relaxations)]


def our_stress(material, K, stretches, factor=1.0, pressure=lambda J: J - 1.0):
    """Principal Cauchy stresses of this package, Pa; `factor` multiplies the deviator, `pressure` is that over K."""
    J = float(np.prod(stretches))
    isochoric = np.asarray(stretches) / J**(1 / 3)
    tau = material.energy_law.compute_energy_and_kirchhoff_stresses(isochoric, material.parameters)[1]
    return factor * (tau - tau.mean()) / J + K * pressure(J)


def chain_pressure(law):
    """Pressure over K of a law in Abaqus and CalculiX: (J - 1/J)/2 for ARRUDA-BOYCE, J - 1 for the others."""
    return (lambda J: 0.5 * (J - 1.0 / J)) if law == "arruda_boyce" else (lambda J: J - 1.0)


@st.composite
def materials(draw, laws, relaxing=True):
    """Any material with one of some laws, a bulk response, a density and perhaps relaxation."""
    moduli = st.floats(1.0, 1e5)
    law = draw(st.sampled_from(laws))
    # Dimensionless parameters with bounds are positive.
    numbers = st.floats(1.0, 20.0) if ts.find_law(law).parameter_bounds else st.floats(0.3, 20.0) | st.floats(-20, -0.3)
    parameters = {name: draw(moduli if ts.find_law(law).units[name] == "Pa" else numbers) for name in PARAMETERS[law]}
    bulk = draw(st.sampled_from((ts.Bulk(), ts.Bulk("K_Pa", draw(st.floats(1e3, 1e9))),
                                 ts.Bulk("D1_per_Pa", draw(st.floats(1e-9, 1e-3))),
                                 ts.Bulk("bulk_ratio", draw(st.floats(2.0, 1e4))))))
    terms = draw(st.lists(st.builds(ts.PronyTerm, st.floats(1e-3, 0.24), st.floats(1e-4, 1e6)), min_size=1, max_size=4))
    relaxation = ts.Prony(tuple(terms), draw(st.sampled_from(("instantaneous", "long_term")))) if (
        relaxing and draw(st.booleans())) else None
    return ts.Material(law, parameters, bulk, draw(st.none() | st.floats(1.0, 3e4)), "GEL", viscoelastic=relaxation)


def write(target, material, units="SI"):
    """Text of a file with one material."""
    return target.write(ExportContent((material,), UNIT_SYSTEMS[units]))


def read(target, text, units="SI"):
    """Only material of a file."""
    [imported] = target.read(text, UNIT_SYSTEMS[units])
    return imported.material


def require_same_after_round_trip(target, material, units):
    """The material that is read from the exported text equals the exported material."""
    same = read(target, write(target, material, units), units)
    assert (same.law, same.name) == (material.law, "GEL")
    assert dict(same.parameters) == pytest.approx(dict(material.parameters), rel=ROUND_TRIP, abs=0.0)
    assert same.bulk_modulus == pytest.approx(target.compute_bulk_modulus(material), rel=ROUND_TRIP)
    assert same.density == (None if material.density is None else pytest.approx(material.density, rel=ROUND_TRIP))
    assert (same.mu0, same.mu_long_term) == pytest.approx((material.mu0, material.mu_long_term), rel=ROUND_TRIP)
    if material.viscoelastic is None:
        assert same.viscoelastic is None
        return
    assert same.viscoelastic.moduli == material.viscoelastic.moduli
    assert same.viscoelastic.g == pytest.approx(material.viscoelastic.g, rel=ROUND_TRIP)
    assert same.viscoelastic.tau == pytest.approx(material.viscoelastic.tau, rel=ROUND_TRIP)
