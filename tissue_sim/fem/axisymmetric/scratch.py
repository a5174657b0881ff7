"""Layout of the scratch field in which a kernel stores intermediate results of the batch that it evaluates."""

from tissue_sim.fem.axisymmetric.batches import LANES
from tissue_sim.fem.taichi import scratch as shared

#: Maximum number of nodes of an element.
_NODES = 9
#: Maximum number of quadrature points of an element.
_POINTS = 9
#: Maximum number of pressure modes of an element.
_MODES = 3
#: Names and sizes of the arrays in the scratch field. Nodes: displacements UR and UZ, forces FR and FZ, increments SR
#: and SZ. Pressure modes: amplitude PRESSURE, volume residual GAP, volume derivatives VR and VZ. Quadrature points:
#: STRESS, TANGENT, COFACTOR (dJ/dF), MODE (pressure modes), RATE (stress increments). CENTRE: stiffness rows of the
#: interior node. Sensitivities: LAW (records of the law), ENERGY_RATE, PAST (derivative of the inherited stress),
#: BEFORE and CHANGE (stress of the last step and its change).
_SIZES = (
    ("UR", _NODES), ("UZ", _NODES), ("FR", _NODES), ("FZ", _NODES), ("SR", _NODES), ("SZ", _NODES),
    ("PRESSURE", _MODES), ("GAP", _MODES), ("VR", _MODES * _NODES), ("VZ", _MODES * _NODES),
    ("STRESS", 5 * _POINTS), ("TANGENT", 15 * _POINTS), ("COFACTOR", 5 * _POINTS), ("MODE", _MODES * _POINTS),
    ("RATE", 10 * _POINTS), ("CENTRE", 4 * _NODES),
    ("LAW", 22 * _POINTS), ("ENERGY_RATE", _POINTS), ("PAST", 4), ("BEFORE", 4 * _POINTS), ("CHANGE", 4 * _POINTS))
#: Name -> offset in the scratch field.
AT = {name: sum(size for _, size in _SIZES[:i]) for i, (name, _) in enumerate(_SIZES)}
_SIZE = sum(size for _, size in _SIZES)


def scratch():
    """Return the Taichi field of the batch that is evaluated, shape (vectors,) of `LANES` numbers."""
    return shared.scratch(LANES, _SIZE)
