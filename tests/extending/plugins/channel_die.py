"""A kind of test in one file: compression in a channel whose walls hold the width (plane strain compression)."""

from tissue_sim.closed_form.homogeneous import PLANAR
from tissue_sim.experiment.kinds.kind import DISPLACEMENT_FORCE, STRETCH_STRESS, TestKind

KIND = TestKind(name="plane_strain_compression", title="Plane strain compression", tool=None, sign=-1.0,
                channels=(DISPLACEMENT_FORCE, STRETCH_STRESS), closed_form=PLANAR)
