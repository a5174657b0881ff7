"""A kind of test in one file: tension of a wide sheet, whose width the grips hold."""

from tissue_sim.closed_form.homogeneous import PLANAR
from tissue_sim.experiment.kinds.kind import DISPLACEMENT_FORCE, STRETCH_STRESS, TestKind

KIND = TestKind(name="planar_tension", title="Planar tension", tool=None, sign=1.0,
                channels=(DISPLACEMENT_FORCE, STRETCH_STRESS), closed_form=PLANAR)
