"""Units of ATI's sensors, as their calibration files and configuration pages spell them."""

from __future__ import annotations

from tissue_sim.units import to_si

#: Unit -> in SI, as calibration files and configuration pages of ATI spell them.
FORCE_UNITS = {unit: to_si(unit, "force")[0] for unit in ("N", "kN", "lbf", "lb", "kg", "kgf", "g", "gf")}
FORCE_UNITS |= {"klbf": 1e3 * FORCE_UNITS["lbf"], "klb": 1e3 * FORCE_UNITS["lbf"]}
LENGTH_UNITS = {unit: to_si(unit, "length")[0] for unit in ("m", "cm", "mm", "in")}
LENGTH_UNITS |= {"ft": 12 * LENGTH_UNITS["in"]}
TORQUE_UNITS = {f"{force}-{length}": force_SI * length_SI for force, force_SI in FORCE_UNITS.items()
                for length, length_SI in LENGTH_UNITS.items()}
TORQUE_UNITS |= {f"{length}-{force}": TORQUE_UNITS[f"{force}-{length}"]
                 for force in ("lb", "lbf") for length in ("in", "ft")}
