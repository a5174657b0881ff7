"""The fields of a simulation as people read them. Imports nothing: help lists them."""

#: Field -> (label with the unit people use, factor from SI); those that say most, first.
LABELS = {
    "von_mises": ("von Mises stress [kPa]", 1e-3), "energy": ("energy density [J/m³]", 1.0),
    "pressure": ("pressure [kPa]", 1e-3), "displacement": ("displacement [mm]", 1e3),
    "stretch": ("largest stretch", 1.0), "cauchy_zz": ("axial stress [kPa]", 1e-3),
    "cauchy_rr": ("radial stress [kPa]", 1e-3), "cauchy_hoop": ("hoop stress [kPa]", 1e-3),
    "cauchy_rz": ("shear stress [kPa]", 1e-3), "J": ("volume ratio J", 1.0),
}
