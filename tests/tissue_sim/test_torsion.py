"""Torsion of a cylinder: closed form against formulas, energy, and the solid with held ends."""

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.closed_form.torsion import TORSION, TORSION_WITH_AXIAL_FORCE, compute_torque_and_axial_force
from tissue_sim.fem.solid.solver import SolidSolver
from tissue_sim.fem.solver import StepStatus
from tissue_sim.mesh.solid import create_cylinder_mesh
from tissue_sim.mesh.solid_element import HEX27P1
from tissue_sim.pose import Pose

#: Radius and height, m.
RADIUS = 0.010
HEIGHT = 0.012
MOONEY = {"C10": 1000.0, "C01": 500.0}
LAWS = {"neo_hooke": {"C10": 1000.0}, "mooney_rivlin": MOONEY, "reduced_polynomial_2": {"C10": 1404.9, "C20": 699.4},
        "ogden_2": {"mu1": 2000.0, "alpha1": 3.0, "mu2": 800.0, "alpha2": -2.0}}
EVERY = pytest.mark.parametrize("name", LAWS)


def test_mooney_rivlin_written_out():
    """M = pi psi a^4 (C10 + C01), N = -pi/2 psi^2 a^4 (C10 + 2 C01)."""
    psi = np.array([0.0, 10.0, 80.0])
    torque, force = compute_torque_and_axial_force(ts.find_law("mooney_rivlin"), MOONEY, psi, RADIUS)
    np.testing.assert_allclose(torque, np.pi * psi * RADIUS**4 * 1500.0, rtol=1e-12)
    np.testing.assert_allclose(force, -np.pi / 2 * psi**2 * RADIUS**4 * 2000.0, rtol=1e-12)


@EVERY
@pytest.mark.parametrize("stretch", [0.7, 1.0, 1.2])
def test_torque_and_force_are_derivatives_of_the_energy(name, stretch):
    """W per undeformed length is 2 pi int W R dR; M and N are its derivatives by psi and by the stretch."""
    law, values, psi = ts.find_law(name), LAWS[name], 60.0

    def energy(twist, axial):
        x, w = np.polynomial.legendre.leggauss(40)
        R = 0.5 * RADIUS * (1 + x)
        F = np.zeros((R.size, 3, 3))
        F[:, 0, 0] = F[:, 1, 1] = axial**-0.5
        F[:, 1, 2], F[:, 2, 2] = twist * R * axial**-0.5, axial
        W, _ = law.compute_energy_and_kirchhoff_stresses(np.linalg.svd(F, compute_uv=False), values)
        return np.pi * RADIUS * np.sum(w * W * R)

    torque, force = compute_torque_and_axial_force(law, values, psi, RADIUS, stretch)
    assert torque == pytest.approx((energy(psi + 1e-3, stretch) - energy(psi - 1e-3, stretch)) / 2e-3, rel=1e-6)
    assert force == pytest.approx((energy(psi, stretch + 1e-5) - energy(psi, stretch - 1e-5)) / 2e-5, rel=1e-6)


@EVERY
def test_axial_force_of_the_calibration(name):
    """-N / (pi a^2), its slope and its parameter derivatives; the first load is the torque."""
    law, values, gamma = ts.find_law(name), np.array(list(LAWS[name].values())), np.array([-0.8, 0.0, 0.3, 1.5])
    form = TORSION_WITH_AXIAL_FORCE.select_load(1)
    _, force = compute_torque_and_axial_force(law, values, gamma / RADIUS, RADIUS)
    np.testing.assert_allclose(form.stress(law, gamma, values), -force / (np.pi * RADIUS**2), rtol=1e-10, atol=1e-10)
    ahead, behind = (form.stress(law, gamma + step, values) for step in (1e-4, -1e-4))
    np.testing.assert_allclose(form.slope(law, gamma, values), (ahead - behind) / 2e-4, rtol=1e-6, atol=1e-4)
    derivatives = form.stress_parameter_derivatives(law, gamma, values)
    for i, step in enumerate(1e-4 * np.diag(np.abs(values))):
        numeric = (form.stress(law, gamma, values + step) - form.stress(law, gamma, values - step)) / (2 * step[i])
        np.testing.assert_allclose(derivatives[:, i], numeric, rtol=1e-6, atol=1e-9)
    np.testing.assert_array_equal(form.select_load(1).stress(law, gamma, values), TORSION.stress(law, gamma, values))


@EVERY
def test_form_of_the_calibration(name):
    law, values, gamma = ts.find_law(name), np.array(list(LAWS[name].values())), np.array([-0.8, 1e-6, 0.3, 1.5])
    torque, _ = compute_torque_and_axial_force(law, values, gamma / RADIUS, RADIUS)
    np.testing.assert_allclose(TORSION.stress(law, gamma, values), 2 * torque / (np.pi * RADIUS**3), rtol=1e-10,
                               atol=1e-11)
    ahead, behind = (TORSION.stress(law, gamma + step, values) for step in (1e-6, -1e-6))
    np.testing.assert_allclose(TORSION.slope(law, gamma, values), (ahead - behind) / 2e-6, rtol=1e-6)
    derivatives = TORSION.stress_parameter_derivatives(law, gamma, values)
    for i, step in enumerate(1e-4 * np.diag(np.maximum(np.abs(values), 1.0))):
        ahead, behind = (TORSION.stress(law, gamma, values + sign * step) for sign in (1, -1))
        np.testing.assert_allclose(derivatives[:, i], (ahead - behind) / (2 * step[i]), rtol=1e-5, atol=1e-6)


def test_history_relaxes_as_the_material():
    series = ts.Prony((ts.PronyTerm(0.3, 2.0), ts.PronyTerm(0.4, 50.0)))
    material = ts.Material("reduced_polynomial_2", LAWS["reduced_polynomial_2"], viscoelastic=series)
    held = TORSION.stress_history(material, np.array([0.0, 0.0, 3.0, 400.0]), np.array([0.0, 0.5, 0.5, 0.5]), RADIUS)
    np.testing.assert_allclose(held[1:] / held[1], series.compute_relative_relaxation_modulus([0.0, 3.0, 400.0]),
                               rtol=1e-12)
    assert held[1] == pytest.approx(float(TORSION.stress(material.energy_law, 0.5, material.values)), rel=1e-9)


def test_axial_force_has_no_history():
    material = ts.Material("mooney_rivlin", {"C10": 1000.0, "C01": 500.0})
    form = TORSION_WITH_AXIAL_FORCE.select_load(1)
    for call in (lambda: form.stress_history(material, np.arange(2.0), np.array([0.0, 0.1]), RADIUS),
                 lambda: form.complex_modulus(material, np.array([1.0]))):
        with pytest.raises(ts.InputError, match="must be 'torsion' for a material with memory"):
            call()


@EVERY
def test_solid_with_held_ends(name):
    """Torsion changes no radius and warps no section, so that held ends change nothing."""
    mesh = create_cylinder_mesh(RADIUS, HEIGHT, HEX27P1, around=2, inward=[0.5, 1.0], outward=[0.0, 0.5, 1.0],
                                z=np.linspace(-HEIGHT, 0.0, 4), face_radius=0.5 * RADIUS)
    material = ts.Material(name, LAWS[name], ts.Bulk("bulk_ratio", 1e4))
    solver = SolidSolver(mesh, material, {"base": "xyz"}, mesh.sets["top"], start=Pose((0.0, 0.0, 0.0)))
    for angle in (0.2, 0.4, 0.6):
        step = solver.step(Pose((0.0, 0.0, 0.0), (np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2))))
        assert step.status is StepStatus.CONVERGED
    torque, force = compute_torque_and_axial_force(material.energy_law, material.values, 0.6 / HEIGHT, RADIUS)
    # The tissue resists the rotation and pushes the plates apart.
    assert step.wrench[5] == pytest.approx(-torque, rel=0.005)
    assert step.wrench[2] == pytest.approx(-force, rel=0.005)
