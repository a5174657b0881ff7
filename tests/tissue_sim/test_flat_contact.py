"""The contact of nodes on a flat tool: what it finds fulfils Signorini's and Coulomb's conditions, checked by numpy."""

import numpy as np
import pytest

from tissue_sim.fem.condensed.flat_contact import TangentPlaneContact
from tissue_sim.fem.condensed.tables import (
    LIST_COLUMNS,
    LOCAL_COLUMNS,
    NODE_COLUMNS,
    SETTING_COUNT,
    STATE_COLUMNS,
    KernelSetting,
    LinearisedContactColumn,
    NodeBondAndStatusColumn,
    NodeForceAndAnchorColumn,
    NodeListColumn,
)
from tissue_sim.fem.contact.pairs import ContactBondState

NODES = 40


def tissue(seed, soft, coefficient, friction_of_all=True):
    """Nodes that stand in a tool by up to a millimetre, on a bulk that couples them and has one mode as soft as asked.

    With `friction_of_all` each has friction, else every other one."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(0.0, 5.0, (NODES, 2))
    apart = np.linalg.norm(places[:, None] - places[None], axis=2)
    compliance = np.kron(np.exp(-apart) + 0.3 * np.exp(-0.1 * apart), np.diag([1.0, 1.0, 0.8]))
    mode = rng.standard_normal(3 * NODES)
    compliance += soft * np.outer(mode, mode) / NODES
    normals = rng.uniform(-0.2, 0.2, (NODES, 3))
    normals[:, 2] = 1.0
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    gaps = rng.uniform(-1e-3, 0.5e-3, NODES)
    slips = np.stack([rng.uniform(0.0, 3e-4, NODES), rng.uniform(-1e-4, 1e-4, NODES), np.zeros(NODES)], axis=1)
    slips += (gaps - (slips * normals).sum(axis=1))[:, None] * normals
    local, lists = np.zeros((NODES, LOCAL_COLUMNS)), np.zeros((NODES, LIST_COLUMNS), dtype=np.int32)
    local[:, LinearisedContactColumn.NORMAL:LinearisedContactColumn.NORMAL
          + 3], local[:, LinearisedContactColumn.GAP] = normals, gaps
    local[:, LinearisedContactColumn.SLIP:LinearisedContactColumn.SLIP + 3] = slips
    local[:, LinearisedContactColumn.FRICTION] = coefficient if friction_of_all \
        else coefficient * (np.arange(NODES) % 2)
    lists[:, NodeListColumn.NODE] = np.arange(NODES)
    settings, states = np.zeros(SETTING_COUNT), np.zeros((NODES, STATE_COLUMNS), dtype=np.int32)
    settings[KernelSetting.COUNT], states[:, NodeBondAndStatusColumn.BOND] = NODES, ContactBondState.TOUCHED
    return {"settings": settings, "states": states, "carried": np.zeros((NODES, NODE_COLUMNS)), "lists": lists,
            "local": local, "compliance": compliance}


@pytest.mark.parametrize("soft", [0.0, 1.0, 50.0])
@pytest.mark.parametrize("coefficient", [0.0, 0.3, 0.8])
@pytest.mark.parametrize("seed", range(4))
def test_forces_fulfil_the_conditions_of_contact(seed, coefficient, soft):
    arrays = tissue(seed, soft, coefficient, friction_of_all=seed % 2 == 0)
    assert TangentPlaneContact(arrays, 1.0, 1e-9).try_solving_contact_forces(1e-10)
    local, states = arrays["local"], arrays["states"]
    forces = arrays["carried"][:, NodeForceAndAnchorColumn.FORCE:NodeForceAndAnchorColumn.FORCE + 3]
    normals = local[:, LinearisedContactColumn.NORMAL:LinearisedContactColumn.NORMAL + 3]
    moved = -(arrays["compliance"] @ forces.ravel()).reshape(-1, 3)
    slips = local[:, LinearisedContactColumn.SLIP:LinearisedContactColumn.SLIP + 3] + moved
    gaps, pushes = (slips * normals).sum(axis=1), -(forces * normals).sum(axis=1)
    size, depth = pushes.max(), 1e-3
    assert size > 0.0 and (pushes > -1e-9 * size).all() and (gaps > -1e-8 * depth).all()
    assert np.abs(pushes * gaps).max() < 1e-8 * size * depth
    assert 0 < states[:, NodeBondAndStatusColumn.PRESSED].sum() < NODES
    along, drags = slips - gaps[:, None] * normals, forces + pushes[:, None] * normals
    limits, drag = local[:, LinearisedContactColumn.FRICTION] * pushes, np.linalg.norm(drags, axis=1)
    assert (drag <= limits + 1e-9 * size).all()
    within = drag < limits - 1e-6 * size
    assert np.linalg.norm(along[within], axis=1).max(initial=0.0) < 1e-8 * depth
    # What slips drags the tool along the way that it goes.
    np.testing.assert_allclose((along * drags).sum(axis=1), drag * np.linalg.norm(along, axis=1),
                               atol=1e-7 * size * depth)
    if coefficient:
        assert states[:, NodeBondAndStatusColumn.SLIPS].sum() > 0
