"""Labels and display units of the fields of a simulation.

The module imports nothing, because ``tissue-sim simulate --help`` lists the fields and must answer at once.
"""

#: Field name -> (label with its display unit, factor from SI to that unit); the most useful fields first.
LABELS = {
    "von_mises": ("von Mises stress [kPa]", 1e-3), "energy": ("energy density [J/m³]", 1.0),
    "pressure": ("pressure [kPa]", 1e-3), "displacement": ("displacement [mm]", 1e3),
    "stretch": ("largest stretch", 1.0), "cauchy_zz": ("axial stress [kPa]", 1e-3),
    "cauchy_rr": ("radial stress [kPa]", 1e-3), "cauchy_hoop": ("hoop stress [kPa]", 1e-3),
    "cauchy_rz": ("shear stress [kPa]", 1e-3), "J": ("volume ratio J", 1.0),
}
