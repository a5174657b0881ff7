"""Torsion of a cylinder between held ends at constant length: the torque over the angle of twist, and the axial force.

Source: R. S. Rivlin, Phil. Trans. R. Soc. A 242 (1949) 173.
"""

from tissue_sim.closed_form.torsion import TORSION, TORSION_WITH_AXIAL_FORCE
from tissue_sim.experiment.grip import TWIST
from tissue_sim.experiment.kinds.kind import ANGLE_TORQUE, SHEAR_STRESS, SizeNames, TestKind

#: Sizes of the cylinder.
_CYLINDER = SizeNames(("height", "gap", "length", "gauge length", "thickness"), is_round=True)
#: A recording without angle and torque states the shear strain at the rim and 2 M / (pi a^3).
TORSION_TEST = TestKind(
    name="torsion", title="Torsion", tool=None, grip=TWIST, specimen_shapes=("cylinder",), sign=1.0,
    channels=(ANGLE_TORQUE, SHEAR_STRESS), closed_form=TORSION, size_names=_CYLINDER, title_words=(
        r"torsion\w*", r"twist(ing)? tests?", r"verdreh\w*", r"verdrill\w*"), sole_words=("twist",))
#: The same with the axial force, which is positive if it pushes the ends apart.
TORSION_AXIAL_FORCE = TestKind(
    name="torsion_axial_force", title="Torsion with axial force", tool=None, sign=1.0,
    load_names=("torque", "axial force"), channels=(
        ("angle", "torque", "angle", "force"), ("shear strain", "nominal stress", "shear strain", "nominal stress 2")),
    closed_form=TORSION_WITH_AXIAL_FORCE, size_names=_CYLINDER, title_words=(
        r"torsion\w* (with|and) (axial|normal) force", r"poynting( effect)?"))
