"""An exported USD stage in Newton's importer: moduli, mass and mesh of the soft body."""

import warnings

import numpy as np
import pytest
from pxr import Usd
from solid_meshes import block

import tissue_sim as ts
from tissue_sim.exports import ExportContent
from tissue_sim.exports.elastic_constants import linearise_material
from tissue_sim.exports.unit_systems import UNIT_SYSTEMS
from tissue_sim.exports.usd import USD
from tissue_sim.mesh.solid_element import HEX8P0
from tissue_sim.mesh.tetrahedral import make_tetrahedral_mesh

newton = pytest.importorskip("newton", reason="needs Newton: pip install tissue_sim[newton]")
pytest.importorskip("newton_usd_schemas", reason="needs pip install newton-usd-schemas")

pytestmark = pytest.mark.slow

MATERIAL = ts.Material("neo_hooke", {"C10": 1500.0}, ts.Bulk("bulk_ratio", 10.0), 1040.0)


def import_stage(units):
    """The builder of Newton after the import of a block of 2 x 3 x 1 cm, and the texts of warnings."""
    mesh = block(np.linspace(0.0, 0.02, 3), np.linspace(0.0, 0.03, 4), np.linspace(-0.01, 0.0, 3), HEX8P0)
    stage = Usd.Stage.CreateInMemory()
    stage.GetRootLayer().ImportFromString(USD.write(ExportContent(
        (MATERIAL,), units, (linearise_material(MATERIAL, USD.max_poisson),), mesh=mesh)))
    builder = newton.ModelBuilder()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        builder.add_usd(stage)
    return builder, mesh, [str(warning.message) for warning in caught]


def test_newton_reads_moduli_density_and_mesh():
    builder, mesh, messages = import_stage(UNIT_SYSTEMS["SI"])
    lame = (10.0 - 2.0 / 3.0) * MATERIAL.mu0
    assert not [message for message in messages if "deformable" in message.lower() or "poisson" in message.lower()]
    np.testing.assert_allclose(np.array(builder.tet_materials)[:, :2], [[MATERIAL.mu0, lame]] * builder.tet_count,
                               rtol=1e-6)
    assert builder.tet_count == len(make_tetrahedral_mesh(mesh).cells)
    assert sum(builder.particle_mass) == pytest.approx(1040.0 * 0.02 * 0.03 * 0.01, rel=1e-5)


def test_newton_imports_the_numbers_of_a_stage_in_mm_with_a_warning():
    """Newton imports the numbers of other units unchanged, with a warning: SI is the choice for Newton."""
    builder, _, messages = import_stage(UNIT_SYSTEMS["mm-mN-kPa"])
    assert any("metersPerUnit" in message for message in messages)
    assert builder.tet_materials[0][0] == pytest.approx(MATERIAL.mu0 / 1e3, rel=1e-6)
