"""Torsion of a cylinder between held ends at constant length: the torque over the angle of twist."""

from tissue_sim.closed_form.torsion import TORSION
from tissue_sim.experiment.grip import TWIST
from tissue_sim.experiment.kinds.kind import ANGLE_TORQUE, SHEAR_STRESS, SizeNames, TestKind

#: A recording without angle and torque states the shear strain at the rim and 2 M / (pi a^3).
TORSION_TEST = TestKind(
    name="torsion", title="Torsion", tool=None, grip=TWIST, specimen_shapes=("cylinder",), sign=1.0,
    channels=(ANGLE_TORQUE, SHEAR_STRESS), closed_form=TORSION,
    size_names=SizeNames(("height", "gap", "length", "gauge length", "thickness"), is_round=True), title_words=(
        r"torsion\w*", r"twist(ing)? tests?", r"verdreh\w*", r"verdrill\w*"), sole_words=("twist",))
