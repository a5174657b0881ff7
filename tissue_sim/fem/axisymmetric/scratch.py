"""Where the batch of elements that a kernel works on keeps what it has computed."""

from tissue_sim.fem.axisymmetric.batches import LANES
from tissue_sim.fem.taichi import scratch as shared

#: Most nodes, points and pressure modes of an element.
_NODES, _POINTS, _MODES = 9, 9, 3
#: Where things of the batch that is worked on stand in the scratch field: motion and forces of nodes, motion still to
#: come, pressure amplitudes, gaps, rates of the volume, and at each point stress, tangent, dJ/dF, modes, stress rates;
#: of derivatives with respect to the material what is noted of the law, rates of the energy and of what is left of the
#: past, the stress before and its change.
_sizes = (("UR", _NODES), ("UZ", _NODES), ("FR", _NODES), ("FZ", _NODES), ("SR", _NODES), ("SZ", _NODES),
          ("PRESSURE", _MODES), ("GAP", _MODES), ("VR", _MODES * _NODES), ("VZ", _MODES * _NODES),
          ("STRESS", 5 * _POINTS), ("TANGENT", 15 * _POINTS), ("COFACTOR", 5 * _POINTS), ("MODE", _MODES * _POINTS),
          ("RATE", 10 * _POINTS), ("CENTRE", 4 * _NODES),
          ("LAW", 22 * _POINTS), ("ENERGY_RATE", _POINTS), ("PAST", 4),
          ("BEFORE", 4 * _POINTS), ("CHANGE", 4 * _POINTS))
AT = {name: sum(size for _, size in _sizes[:i]) for i, (name, _) in enumerate(_sizes)}
_SIZE = sum(size for _, size in _sizes)


def scratch():
    """The Taichi field of a batch that is worked on."""
    return shared.scratch(LANES, _SIZE)
