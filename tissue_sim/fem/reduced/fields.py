"""Fields of a reduced solid: of all elements, also those that nobody looks at in a step.

Displacements are those of the modes. Their change of volume is that of nearly incompressible tissue to a few percent,
which the bulk modulus would make pressures of that are wrong several times over: there is no pressure.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from tissue_sim.fem.solid.batches import quadrature
from tissue_sim.fem.solid.fields import SolidFields
from tissue_sim.fem.solid.tissue import layer_ratios
from tissue_sim.material.material import Material
from tissue_sim.mesh.solid import SolidMesh

#: Kept for so many meshes.
_quadrature = lru_cache(maxsize=2)(quadrature)


def reduced_fields(mesh: SolidMesh, material: Material, displacements: Sequence[np.ndarray],
                   datum: float, layers: np.ndarray) -> SolidFields | None:
    """Fields of states of a reduced solid.

    Args:
        mesh: of the whole solid.
        material: elastic; of one that remembers its past there are none, since most elements remember nothing.
        displacements: of the nodes, m, each of shape (nodes, 3).
        datum: height at which the tool first touches, m.
        layers: see `element_layers`.
    """
    if material.remembers:
        return None
    weights, gradients, modes = _quadrature(mesh)
    return SolidFields(mesh, material, np.array(material.bulk_modulus), np.array(displacements), None, gradients,
                       modes, weights, layer_ratios(material, layers), None, datum)
