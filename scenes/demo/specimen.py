"""Virtual specimen of the demonstrations, and settings of its virtual measurements."""

from __future__ import annotations

from dataclasses import dataclass

import tissue_sim as ts

#: Cylinder of 40 mm radius and 70 mm height, as in the reference study.
SPECIMEN = ts.Cylinder(0.040, 0.070, name="virtual phantom")
#: Largest depth of the tests, m.
DEPTH = 0.010
#: Parameters of the law ``reduced_polynomial_2`` of the silicone, Pa.
PHANTOM = {"C10": 1404.9, "C20": 699.4}
#: Ratio of bulk modulus to initial shear modulus, K / mu0, 1.
BULK_RATIO = 1e4


@dataclass(frozen=True)
class VirtualReplicateAndErrorSettings:
    """Number of recordings of a virtual test, and the errors of the virtual rig.

    Attributes:
        replicates: recordings of each test.
        samples: samples of each recording.
        force_noise: standard deviation of the force sensor, N.
        contact_jitter: standard deviation of the contact point between recordings, m.
        zero_jitter: standard deviation of the zero of the sensor between recordings, N.
    """

    replicates: int
    samples: int
    force_noise: float
    contact_jitter: float = 0.0
    zero_jitter: float = 0.0
