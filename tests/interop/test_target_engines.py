"""Tests in MuJoCo's flex and Newton's soft body: balance, law, contact, and constants that the engines load."""

import importlib.util

import numpy as np
import pytest

import tissue_sim as ts
from calibration.targets.matching import CalibratedForces, match_constants
from calibration.targets.runner import RUNNERS, TargetTest
from calibration.targets.soft_body import compute_nodal_forces
from tissue_sim.exports import ExportContent, find_export_target
from tissue_sim.exports.elastic_constants import ElasticConstants
from tissue_sim.mesh.solid import create_block_mesh_from_boundaries, create_cylinder_mesh_under_needle
from tissue_sim.mesh.solid_element import HEX8P0
from tissue_sim.mesh.tetrahedral import make_tetrahedral_mesh

pytestmark = pytest.mark.slow
MODULES = {"mujoco": "mujoco", "newton": "newton"}
CONSTANTS = ElasticConstants(8000.0, 0.4, 0.05, 1000.0)


@pytest.fixture(params=MODULES)
def engine(request):
    if importlib.util.find_spec(MODULES[request.param]) is None:
        pytest.skip(f"needs {request.param}: pip install tissue_sim[{request.param}]")
    return request.param


@pytest.fixture(scope="module")
def mesh():
    return create_cylinder_mesh_under_needle(0.02, 0.02, 5e-3, HEX8P0, smallest=3e-3, growth=2.0, largest=0.01,
                                             around=2)


def straight_path(*depths):
    positions = np.zeros((len(depths) + 1, 3))
    positions[1:, 2] = -np.array(depths)
    return positions


def run(engine, mesh, constants=CONSTANTS, tool=None, positions=None, **options):
    tool, positions = tool or ts.Tool("flat", radius=5e-3), straight_path(3e-4) if positions is None else positions
    return RUNNERS.find(engine, "target").run(TargetTest(mesh, tool, positions, **options), constants)


def test_uniaxial_stress_of_a_block(engine):
    """A block with a bonded base whose law has no Poisson effect is in uniaxial strain and stress."""
    mesh = create_block_mesh_from_boundaries([0.0, 0.01], [0.0, 0.01], [-0.01, 0.0], HEX8P0)
    mesh.sets["face"] = mesh.sets["top"]
    curve = run(engine, mesh, ElasticConstants(8000.0, 0.0, 0.05, 1000.0), positions=straight_path(1e-3, 2e-3),
                is_bonded=True)
    stretch = 1.0 - curve.depths / 0.01
    if engine == "mujoco":
        stress = 8000.0 * stretch * 0.5 * (stretch**2 - 1.0)
    else:
        mu = 4000.0  # lambda = 0, J = stretch
        stress = mu * stretch + mu * (stretch - 1.0) - mu
    assert curve.ended == ""
    assert curve.forces[1:, 2] == pytest.approx(-stress[1:] * 1e-4, rel=2e-3)


def test_bonded_force_is_that_of_linear_elasticity_on_the_same_tetrahedra(engine, mesh):
    depth, cells, size = 1e-4, make_tetrahedral_mesh(mesh).cells, mesh.nodes.size
    stiffness = np.zeros((size, size))
    for column in range(size):
        moved = mesh.nodes.copy()
        moved.flat[column] += 1e-7
        stiffness[:, column] = compute_nodal_forces(mesh.nodes, cells, moved, lambda F: compute_linear_stress(
            F, CONSTANTS.mu, CONSTANTS.lame)).ravel() / 1e-7
    x = np.zeros(size)
    face = 3 * mesh.sets["face"]
    x[face + 2] = -depth
    fixed = np.concatenate([(3 * mesh.sets[name][:, None] + np.arange(3)).ravel() for name in ("base", "face")])
    free = np.setdiff1d(np.arange(size), fixed)
    x[free] = np.linalg.solve(stiffness[np.ix_(free, free)], -stiffness[np.ix_(free, fixed)] @ x[fixed])
    curve = run(engine, mesh, positions=straight_path(depth), is_bonded=True)
    assert curve.forces[1, 2] == pytest.approx(-(stiffness @ x)[face + 2].sum(), rel=0.02)


def compute_linear_stress(gradient, mu, lame):
    """Return the stress of Hooke's law, Pa."""
    strain = 0.5 * (gradient + np.swapaxes(gradient, 1, 2)) - np.eye(3)
    return 2.0 * mu * strain + lame * np.trace(strain, axis1=1, axis2=2)[:, None, None] * np.eye(3)


def test_ball_in_contact_is_proportional_to_the_modulus_and_stays_outside(engine, mesh):
    soft, hard = (run(engine, mesh, ElasticConstants(young, 0.4, 0.05, 1000.0), ts.Tool("sphere", radius=8e-3),
                      straight_path(1e-3)) for young in (8000.0, 16000.0))
    assert soft.ended == hard.ended == ""
    assert hard.forces[1, 2] / soft.forces[1, 2] == pytest.approx(2.0, rel=0.02)
    assert 0.0 <= soft.penetrations[1] < 5e-5
    assert np.abs(soft.forces[1, :2]).max() < 0.1 * soft.forces[1, 2]


def test_dragged_ball_has_the_force_of_friction(engine, mesh):
    """A flat ball: the normals of its contact are nearly upright, so that ploughing adds little."""
    down, along = np.linspace(0.0, 5e-4, 11), np.linspace(0.0, 3e-3, 61)
    positions = np.concatenate([np.column_stack([0.0 * down, 0.0 * down, -down]),
                                np.column_stack([along, 0.0 * along, 0.0 * along - 5e-4])[1:]])
    curve = run(engine, mesh, tool=ts.Tool("sphere", radius=15e-3), positions=positions, friction=0.2,
                times=np.arange(len(positions)) * 0.02, time_step=0.01)
    assert curve.ended == ""
    sliding = curve.forces[-20:]
    assert -sliding[:, 0].mean() / sliding[:, 2].mean() == pytest.approx(0.2, abs=0.04)


def test_the_engine_loads_the_exported_constants(engine, mesh):
    target = find_export_target(engine)
    material = ts.Material("neo_hooke", {"C10": 1500.0}, name="gel")
    text = target.write(ExportContent((material,), constants=(CONSTANTS,), remarks=("error -- stated",), mesh=mesh))
    loaded = _load_mujoco(text, mesh) if engine == "mujoco" else _load_newton(text, mesh)
    assert loaded == pytest.approx([CONSTANTS.mu, CONSTANTS.lame, CONSTANTS.damping_time], rel=1e-5)


def _load_mujoco(text, mesh):
    """Return mu, lambda and damping time of the loaded model, from its forces on a deformed body."""
    import mujoco

    from calibration.targets.mujoco_flex import compute_saint_venant_kirchhoff_stress

    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    nodes, cells = data.flexvert_xpos.copy(), make_tetrahedral_mesh(mesh).cells
    data.qpos[:] = 1e-4 * np.random.default_rng(1).standard_normal(model.nq)
    mujoco.mj_forward(model, data)
    moved = data.flexvert_xpos.copy()
    free = np.flatnonzero(np.linalg.norm(moved - nodes, axis=1) > 0.0)
    forces = data.qfrc_spring.reshape(-1, 3)
    parts = [-compute_nodal_forces(nodes, cells, moved, lambda F, m=mu, la=lame: compute_saint_venant_kirchhoff_stress(
        F, m, la))[free].ravel() for mu, lame in ((1.0, 0.0), (0.0, 1.0))]
    (mu, lame), *_ = np.linalg.lstsq(np.array(parts).T, forces.ravel(), rcond=None)
    return [mu, lame, float(model.flex_damping[0])]


def _load_newton(text, mesh):
    """Return mu, lambda and damping time of the model that the written function builds."""
    import newton

    space = {}
    exec(compile(text, "tissue.py", "exec"), space)
    builder = newton.ModelBuilder()
    space["add_soft_body"](builder, mesh.nodes, make_tetrahedral_mesh(mesh).cells.ravel())
    mu, lame, damping = np.array(builder.tet_materials)[0]
    return [mu, lame, 2.0 * damping / mu]


def test_matched_constants_reproduce_a_force(engine, mesh):
    depths = np.array([2e-4, 4e-4])
    calibrated = CalibratedForces(depths, np.array([0.05, 0.1]), None, 1.0)
    experiment = ts.KINDS["needle_indentation"].experiment(
        specimen=ts.Specimen(0.02, 0.02), protocol=ts.Protocol.ramp(4e-4, 3), tool=ts.Tool("flat", radius=5e-3))
    model = ts.Model(experiment, ts.Material("neo_hooke", {"C10": 1500.0}))
    found = match_constants(model, calibrated, 0.49, runner=RUNNERS.find(engine, "target"), mesh=mesh, poisson=0.4)
    assert found.reaches_all_depths
    assert np.abs(found.errors).max() < 0.05
    # The constants of the file in another run of the engine.
    again = run(engine, mesh, found.constants, positions=straight_path(*depths), is_bonded=True)
    assert again.forces[1:, 2] == pytest.approx(found.target_forces, rel=2e-3)
