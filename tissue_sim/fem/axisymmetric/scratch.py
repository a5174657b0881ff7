"""Layout of the scratch field in which a kernel stores intermediate results of the batch that it evaluates."""

from tissue_sim.fem.taichi import shared_fields as shared
from tissue_sim.fem.taichi.shared_fields import LANES, CountsInLargestElement
from tissue_sim.mesh.elements import MAX_NODES

#: Size of the largest element.
_LARGEST = CountsInLargestElement(nodes=MAX_NODES, points=MAX_NODES, modes=3)
#: Names and sizes of the arrays in the scratch field. Nodes: displacements UR and UZ, forces FR and FZ, increments SR
#: and SZ. Pressure modes: amplitude PRESSURE, volume residual GAP, volume derivatives VR and VZ. Quadrature points:
#: STRESS, TANGENT, COFACTOR (dJ/dF), MODE (pressure modes), RATE (stress increments). CENTRE: stiffness rows of the
#: interior node. Sensitivities: LAW (records of the law), ENERGY_RATE, PAST (derivative of the inherited stress),
#: BEFORE and CHANGE (stress of the last step and its change).
_SIZES = (
    ("UR", _LARGEST.nodes), ("UZ", _LARGEST.nodes), ("FR", _LARGEST.nodes), ("FZ", _LARGEST.nodes),
    ("SR", _LARGEST.nodes), ("SZ", _LARGEST.nodes), ("PRESSURE", _LARGEST.modes), ("GAP", _LARGEST.modes),
    ("VR", _LARGEST.modes * _LARGEST.nodes), ("VZ", _LARGEST.modes * _LARGEST.nodes),
    ("STRESS", 5 * _LARGEST.points), ("TANGENT", 15 * _LARGEST.points), ("COFACTOR", 5 * _LARGEST.points),
    ("MODE", _LARGEST.modes * _LARGEST.points), ("RATE", 10 * _LARGEST.points), ("CENTRE", 4 * _LARGEST.nodes),
    ("LAW", 22 * _LARGEST.points), ("ENERGY_RATE", _LARGEST.points), ("PAST", 4), ("BEFORE", 4 * _LARGEST.points),
    ("CHANGE", 4 * _LARGEST.points))
#: Name -> offset in the scratch field.
AT = {name: sum(size for _, size in _SIZES[:i]) for i, (name, _) in enumerate(_SIZES)}
_SIZE = sum(size for _, size in _SIZES)


def get_axisymmetric_scratch_field():
    """Return the Taichi field, shared by all kernels, for intermediate results of the batch that is evaluated.

    The offsets of the arrays are `AT`. Each of the `_SIZE` entries is a vector with one component for each element of
    the batch (`LANES` elements).
    """
    return shared.get_shared_scratch_field(LANES, _SIZE)
