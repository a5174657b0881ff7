"""Fields of a reduced solid in all elements of the mesh, including elements outside the sample.

Displacements are linear combinations of the modes. Their volume change is wrong by a few percent of the volume, which
the bulk modulus of nearly incompressible tissue would turn into pressures several times too large. Pressure is
therefore not computed.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from tissue_sim.fem.solid.batches import compute_quadrature_volumes_gradients_modes
from tissue_sim.fem.solid.fields import SolidFields
from tissue_sim.fem.solid.tissue import get_modulus_ratios_of_layer_indices
from tissue_sim.material.material import Material
from tissue_sim.mesh.solid import SolidMesh

#: Quadrature data, cached for two meshes.
_quadrature = lru_cache(maxsize=2)(compute_quadrature_volumes_gradients_modes)


def compute_pressureless_fields_or_none(mesh: SolidMesh, material: Material, displacements: Sequence[np.ndarray],
                                        datum: float, layers: np.ndarray) -> SolidFields | None:
    """Return the fields of several states of a reduced solid in all elements of the mesh.

    Args:
        mesh: mesh of the full-order solid.
        material: an elastic material. For a material with history the result is None, because elements outside the
            sample have no history.
        displacements: displacements of the nodes, m, each of shape (nodes, 3).
        datum: height of the scene's origin, which the tool reaches at its first touch, in the frame of the mesh, m.
        layers: number of the material's layer of each element, see `find_element_layer_indices`.

    Returns:
        Fields without pressure, or None for a material with history.
    """
    if material.is_history_dependent:
        return None
    weights, gradients, modes = _quadrature(mesh)
    return SolidFields(mesh, material, np.array(material.bulk_modulus), np.array(displacements), None, gradients,
                       modes, weights, get_modulus_ratios_of_layer_indices(material, layers), None, datum)
