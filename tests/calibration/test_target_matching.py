"""Fit of an engine's constants: least squares against a program whose forces are known, damping, and draws."""

from dataclasses import replace

import numpy as np
import pytest

import tissue_sim as ts
from calibration.targets.matching import (
    SETTINGS,
    CalibratedForces,
    compare_in_target,
    compute_calibrated_forces,
    compute_damping_time,
    cut_at_falling_force,
    draw_materials,
    fit_scale,
    make_target_test,
    match_constants,
    match_draws,
)
from calibration.targets.mujoco_flex import compute_saint_venant_kirchhoff_stress
from calibration.targets.newton_vbd import compute_neo_hookean_stress
from calibration.targets.runner import TargetCurve, TargetRunner
from calibration.targets.soft_body import (
    compute_nodal_forces,
    compute_penetration,
    require_constants,
    require_sphere_or_cylinder,
)
from tissue_sim.errors import InputError
from tissue_sim.exports.elastic_constants import ElasticConstants
from tissue_sim.exports.newton import compute_k_damp
from tissue_sim.material.file import MaterialFile
from tissue_sim.mesh.solid import create_block_mesh_from_boundaries, create_cylinder_mesh_under_needle
from tissue_sim.mesh.solid_element import HEX8P0
from tissue_sim.mesh.tetrahedral import make_tetrahedral_mesh

MATERIAL = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4), 1040.0)
#: The best Poisson's ratio of the program below, which is locked by 30 %.
BEST_RATIO = 0.42
LOCKING = 1.3


class SoftProgram(TargetRunner):
    """Program whose force is known: E depth (1 + (nu - BEST_RATIO) depth / mm) LOCKING, up to a depth."""

    title = "soft program"

    def __init__(self, deepest=1.0):
        self.deepest = deepest

    def describe_missing_program(self):
        return ""

    def run(self, test, material, progress=None):
        reached = -test.positions[:, 2] <= self.deepest
        depths = -test.positions[reached, 2]
        forces = np.zeros((depths.size, 3))
        forces[:, 2] = LOCKING * material.young * 1e-3 * depths * (1.0 + (material.poisson - BEST_RATIO) * 1e3 * depths)
        return TargetCurve(test.positions[reached], forces, "" if reached.all() else "at 4 mm: not at rest",
                           version="soft 1")


def model(friction="bonded", tool=None, **options):
    experiment = ts.KINDS["needle_indentation"].experiment(
        specimen=ts.Specimen(0.04, 0.07), protocol=ts.Protocol.ramp(4e-3, 5), friction=friction,
        tool=tool or ts.Tool("flat", radius=8e-3), **options)
    return ts.Model(experiment, MATERIAL)


@pytest.fixture(scope="module")
def mesh():
    return create_cylinder_mesh_under_needle(0.04, 0.07, 8e-3, HEX8P0, smallest=8e-3, growth=2.0, largest=0.03,
                                             around=2)


def linear_forces(scale=7.0):
    """Return forces that are proportional to the depth."""
    depths = np.arange(1, 5) * 1e-3
    return CalibratedForces(depths, scale * depths, 1e-3, 16.0)


def test_constants_are_those_of_a_program_with_known_forces(mesh):
    found = match_constants(model(), linear_forces(), 0.49, runner=SoftProgram(), mesh=mesh)
    assert found.constants.poisson == pytest.approx(BEST_RATIO, abs=SETTINGS.poisson_tolerance)
    assert found.constants.young == pytest.approx(7.0 / (LOCKING * 1e-3), rel=0.02)
    assert np.abs(found.errors).max() < 0.02 < np.abs(found.uncompensated_errors).max()
    assert found.reaches_all_depths
    assert found.is_in_target
    assert "soft 1" in found.list_remarks()[0]


def test_a_held_ratio_needs_two_or_three_runs(mesh):
    found = match_constants(model(), linear_forces(), 0.49, runner=SoftProgram(), mesh=mesh, poisson=BEST_RATIO)
    assert found.runs == 3  # the linearised material, the held ratio, and the confirmation
    assert found.constants.young == pytest.approx(7.0 / (LOCKING * 1e-3), rel=1e-9)
    assert found.errors == pytest.approx(0.0, abs=1e-9)


def test_a_program_that_ends_early_states_the_depth(mesh):
    found = match_constants(model(), linear_forces(), 0.49, runner=SoftProgram(2.5e-3), mesh=mesh)
    assert found.deepest == pytest.approx(2e-3)
    assert not found.reaches_all_depths
    assert "Valid to a depth of 2 mm. Do not use it deeper" in found.list_remarks()[-1]
    with pytest.raises(InputError, match="does not reach the first depth"):
        match_constants(model(), linear_forces(), 0.49, runner=SoftProgram(0.5e-3), mesh=mesh)


def test_a_program_with_the_law_is_compared_without_a_fit(mesh):
    class Exact(SoftProgram):
        def run(self, test, material, progress=None):
            assert material is MATERIAL
            return super().run(test, ElasticConstants(7.0 / (LOCKING * 1e-3), BEST_RATIO))

    compared = compare_in_target(model(), linear_forces(), Exact(), mesh)
    assert compared.errors == pytest.approx(0.0, abs=1e-12)
    assert compared.list_remarks()[1].startswith("depth 1 mm")


def test_a_falling_force_ends_the_curve():
    positions = np.zeros((5, 3))
    positions[:, 2] = -1e-3 * np.arange(5)
    forces = np.zeros((5, 3))
    forces[:, 2] = [0.0, 1.0, 2.0, 1.5, 3.0]
    cut = cut_at_falling_force(TargetCurve(positions, forces))
    assert cut.depths == pytest.approx([0.0, 1e-3, 2e-3])
    assert cut.ended.startswith("at 3 mm: the force falls")
    whole = TargetCurve(positions[:3], forces[:3])
    assert cut_at_falling_force(whole) is whole


def test_scale_is_the_least_squares_factor_of_relative_errors():
    calibrated, forces = np.array([1.0, 2.0, 3.0]), np.array([1.2, 2.2, 3.0])
    factors = np.linspace(0.8, 1.2, 4001)
    squares = (((factors[:, None] * forces) / calibrated - 1.0)**2).sum(axis=1)
    assert fit_scale(forces, calibrated) == pytest.approx(factors[squares.argmin()], abs=2e-4)


def test_damping_has_the_loss_factor_of_one_maxwell_body():
    series, duration = ts.Prony((ts.PronyTerm(0.4, 2.0),)), 10.0
    omega = 2.0 * np.pi / duration
    modulus = 0.6 + 0.4 * 1j * omega * 2.0 / (1.0 + 1j * omega * 2.0)  # complex modulus of the series
    assert omega * compute_damping_time(series, duration) == pytest.approx(modulus.imag / modulus.real, rel=1e-12)
    assert compute_damping_time(None, duration) == SETTINGS.numerical_damping_time


def test_newton_damping_is_that_of_kelvin_and_voigt_in_shear():
    constants, rate, step = ElasticConstants(3000.0, 0.45, 0.2), 0.05, 1e-4
    before, after = np.eye(3), np.eye(3)
    after[0, 1] = rate * step
    # Newton's stress: 2 k_damp F dC/dt with C = F^T F.
    viscous = 2.0 * compute_k_damp(constants) * after @ (after.T @ after - before.T @ before) / step
    assert viscous[0, 1] == pytest.approx(constants.mu * constants.damping_time * rate, rel=1e-4)


@pytest.mark.parametrize("stress", [compute_saint_venant_kirchhoff_stress, compute_neo_hookean_stress])
def test_stress_has_the_stated_constants_at_small_strains(stress):
    mu, lame, size = 1000.0, 8000.0, 1e-6
    strain = np.array([[1.0, 0.3, 0.0], [0.3, -2.0, 0.5], [0.0, 0.5, 0.7]])
    expected = 2.0 * mu * strain + lame * np.trace(strain) * np.eye(3)
    assert stress(np.eye(3)[None], mu, lame)[0] == pytest.approx(np.zeros((3, 3)), abs=1e-9)
    assert stress((np.eye(3) + size * strain)[None], mu, lame)[0] / size == pytest.approx(expected, rel=1e-4, abs=1.0)


def test_nodal_forces_of_a_stretched_block_are_stress_times_area():
    mesh = create_block_mesh_from_boundaries([0.0, 0.02], [0.0, 0.03], [-0.04, 0.0], HEX8P0)
    cells, stretched = make_tetrahedral_mesh(mesh).cells, mesh.nodes * [1.0, 1.0, 1.1]
    assert make_tetrahedral_mesh(mesh).volume == pytest.approx(0.02 * 0.03 * 0.04)
    forces = compute_nodal_forces(mesh.nodes, cells, stretched,
                                  lambda F: compute_saint_venant_kirchhoff_stress(F, 1000.0, 0.0))
    nominal = 1.1 * 2000.0 * 0.5 * (1.1**2 - 1.0)  # F S
    assert forces[mesh.sets["top"], 2].sum() == pytest.approx(nominal * 0.02 * 0.03)
    assert forces.sum(axis=0) == pytest.approx(np.zeros(3), abs=1e-12)


def test_penetration_is_the_depth_inside_the_tool():
    ball, position = ts.Tool("sphere", radius=8e-3), np.array([1e-3, 0.0, -2e-3])
    points = position + np.array([[0.0, 0.0, 0.5e-3], [0.02, 0.0, 0.0]])
    assert compute_penetration(ball, position, points) == pytest.approx(0.5e-3)
    assert compute_penetration(ball, position, points[1:]) == 0.0


@pytest.mark.parametrize(("tool", "shape"), [(ts.Tool("round", radius=8e-3), "round"),
                                             (ts.Tool("flat", radius=8e-3, edge_radius=1e-3), "rounded edge")])
def test_other_tools_are_refused_in_contact(tool, shape):
    with pytest.raises(InputError, match=shape):
        require_sphere_or_cylinder(tool, "MuJoCo flex")
    require_sphere_or_cylinder(ts.Tool("sphere", radius=8e-3), "MuJoCo flex")


def test_materials_are_refused_in_place_of_constants():
    with pytest.raises(InputError, match="ElasticConstants"):
        require_constants(MATERIAL, "MuJoCo flex")


@pytest.mark.parametrize(("changes", "field"), [
    ({"friction": "stick"}, "friction"), ({"friction_base": "frictionless"}, "friction_base"),
    ({"slip": 0.3, "tool": ts.Tool("flat", radius=8e-3, edge_radius=1e-3)}, "slip"),
    ({"approach": ts.Approach(0.0, 0.1)}, "approach.angle"), ({"tilt": 1e-4}, "tilt")])
def test_tests_that_a_program_does_not_have_are_refused(changes, field, mesh):
    with pytest.raises(InputError) as raised:
        make_target_test(model(**changes).experiment, mesh)
    assert raised.value.field == field


def test_a_prescribed_force_is_refused(mesh):
    experiment = replace(model().experiment, protocol=ts.Protocol.parse("ramp 1N @1N/s"))
    with pytest.raises(InputError, match="must prescribe displacements for a match with another program; got a presc"):
        make_target_test(experiment, mesh)
    with pytest.raises(InputError, match="must prescribe displacements for a match with another program; got a presc"):
        compute_calibrated_forces(replace(model(), experiment=experiment))


def test_the_path_is_that_of_the_loading(mesh):
    protocol = ts.Protocol(np.arange(6.0), [-1e-3, 0.0, 1e-3, 2e-3, 1e-3, 0.0])
    experiment = ts.KINDS["needle_indentation"].experiment(
        specimen=ts.Specimen(0.04, 0.07), protocol=protocol, tool=ts.Tool("sphere", radius=8e-3), friction=0.3,
        approach=ts.Approach(5e-3))
    test = make_target_test(experiment, mesh)
    assert test.positions == pytest.approx(np.array([[5e-3, 0.0, 0.0], [5e-3, 0.0, -1e-3], [5e-3, 0.0, -2e-3]]))
    assert (test.is_bonded, test.friction) == (False, 0.3)


COVARIANCE = np.diag([100.0**2, 300.0**2])


def test_draws_need_a_covariance():
    with pytest.raises(InputError, match="covariance"):
        draw_materials(MaterialFile.of(MATERIAL), 2, 0)


@pytest.mark.slow
def test_draws_are_repeatable_and_stable():
    file = MaterialFile.of(MATERIAL, covariance=COVARIANCE)
    drawn = draw_materials(file, 40, 3)
    assert drawn[:4] == draw_materials(file, 4, 3) != draw_materials(file, 4, 4)
    values = np.array([list(one.parameters.values()) for one in drawn])
    assert values.std(axis=0) == pytest.approx([100.0, 300.0], rel=0.35)
    assert (values[:, 1] > 0.0).all()  # a negative C20 is unstable


@pytest.mark.slow
def test_draws_without_valid_values_end():
    # One parameter is negative in nearly every draw.
    file = MaterialFile.of(MATERIAL, covariance=1e16 * np.array([[1.0, -1.0], [-1.0, 1.0]]))
    with pytest.raises(InputError, match="valid and stable"):
        draw_materials(file, 2, 0)


@pytest.mark.slow
def test_forces_of_drawn_materials_scale_the_modulus(mesh):
    truth = compute_calibrated_forces(model(), resolution="fast")
    found = match_constants(model(), truth, 0.49, runner=SoftProgram(), mesh=mesh, poisson=BEST_RATIO)
    stiffer = ts.Material("reduced_polynomial_2", {"C10": 1.1 * 1404.9, "C20": 1.1 * 699.4}, MATERIAL.bulk)
    drawn, = match_draws(model(), found, [stiffer], report=lambda sentence: None, resolution="fast")
    assert drawn.young / found.constants.young == pytest.approx(1.1, rel=2e-3)
    assert drawn.poisson == found.constants.poisson


@pytest.mark.slow
def test_the_law_alone_is_neo_hookean():
    truth = compute_calibrated_forces(model(), resolution="fast")
    found = match_constants(model(), truth, 0.49)
    assert not found.is_in_target
    assert np.abs(found.errors).max() < 0.05
    assert any("Use --in-target" in line for line in found.list_remarks())
