"""SI values of the units of ATI's sensors, by their names in calibration files and configuration pages."""

from __future__ import annotations

from tissue_sim.units import get_si_factor_and_offset

#: Forces, N.
FORCE_UNITS = {unit: get_si_factor_and_offset(unit, "force")[0]
               for unit in ("N", "kN", "lbf", "lb", "kg", "kgf", "g", "gf")}
FORCE_UNITS |= {"klbf": 1e3 * FORCE_UNITS["lbf"], "klb": 1e3 * FORCE_UNITS["lbf"]}
#: Lengths, m.
LENGTH_UNITS = {unit: get_si_factor_and_offset(unit, "length")[0] for unit in ("m", "cm", "mm", "in")}
LENGTH_UNITS |= {"ft": 12 * LENGTH_UNITS["in"]}
#: Torques, N m.
TORQUE_UNITS = {f"{force}-{length}": force_SI * length_SI for force, force_SI in FORCE_UNITS.items()
                for length, length_SI in LENGTH_UNITS.items()}
TORQUE_UNITS |= {f"{length}-{force}": TORQUE_UNITS[f"{force}-{length}"]
                 for force in ("lb", "lbf") for length in ("in", "ft")}
