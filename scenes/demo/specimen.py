"""The specimen of the study: its size, its silicone, and how deep it was tested."""

from __future__ import annotations

import tissue_sim as ts

SPECIMEN, DEPTH = ts.Cylinder(0.040, 0.070, name="virtual phantom"), 0.010
#: Of the law ``reduced_polynomial_2``, Pa, and K / mu0.
PHANTOM, BULK_RATIO = {"C10": 1404.9, "C20": 699.4}, 1e4
