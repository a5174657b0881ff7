"""Virtual specimen of the demonstrations: size, silicone material and test depth of the reference study."""

from __future__ import annotations

import tissue_sim as ts

#: Cylinder of 40 mm radius and 70 mm height.
SPECIMEN = ts.Cylinder(0.040, 0.070, name="virtual phantom")
#: Largest depth of the tests, m.
DEPTH = 0.010
#: Parameters of the law ``reduced_polynomial_2`` of the silicone, Pa.
PHANTOM = {"C10": 1404.9, "C20": 699.4}
#: Ratio of bulk modulus to initial shear modulus, K / mu0, 1.
BULK_RATIO = 1e4
