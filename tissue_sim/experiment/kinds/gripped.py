"""Tests of a specimen that is gripped at both ends."""

from tissue_sim.closed_form.homogeneous import SIMPLE_SHEAR, UNIAXIAL
from tissue_sim.experiment.kinds.kind import DISPLACEMENT_FORCE, SHEAR_STRESS, STRETCH_STRESS, TestKind

TENSION = TestKind(name="uniaxial_tension", title="Uniaxial tension", tool=None, sign=1.0,
                   channels=(DISPLACEMENT_FORCE, STRETCH_STRESS), closed_form=UNIAXIAL)
SHEAR = TestKind(name="simple_shear", title="Simple shear", tool=None, sign=1.0,
                 channels=(DISPLACEMENT_FORCE, SHEAR_STRESS), closed_form=SIMPLE_SHEAR)
