"""Tension of a sheet: at constant width (planar tension, pure shear), and equal in two directions (equibiaxial).

Source: L. R. G. Treloar, Stress-strain data for vulcanised rubber under various types of deformation, Trans. Faraday
Soc. 40 (1944) 59.
"""

from tissue_sim.closed_form.homogeneous import EQUIBIAXIAL, PLANAR
from tissue_sim.experiment.grip import AXIAL_PULL
from tissue_sim.experiment.kinds.kind import DISPLACEMENT_FORCE, STRETCH_STRESS, SizeNames, TestKind

#: Sizes of a sheet between grips.
_SHEET = SizeNames(("gauge length", "length", "height"), ("thickness",))
#: The grips hold the width of the sheet; the cross-section is width times thickness. Near the free edges the sheet is
#: narrower and softer, so that the width must be large compared with the height between the grips.
PLANAR_TENSION = TestKind(
    name="planar_tension", title="Planar tension", tool=None, grip=AXIAL_PULL, specimen_shapes=("block",), sign=1.0,
    channels=(DISPLACEMENT_FORCE, STRETCH_STRESS), closed_form=PLANAR, size_names=_SHEET, title_words=(
        r"planar ?(tension|tensile|extension|elongation|stretch\w*|zug\w*|test)", r"pure ?shear", r"strip biax\w*",
        r"(width )?constrained (width )?(tension|tensile)", r"plane strain (tension|tensile)", r"wide strip",
        r"eben\w* zug\w*", r"planar\w* (zug\w*|dehnung)", r"rein\w* (scher\w*|schub\w*)", r"reinscher\w*",
        r"cisaillement pur", r"(traction|tension|extension) plan\w*"),
    file_words=("ps", "pt"), sole_words=("planar",))

#: Displacement and force are those of one direction; the cross-section is that normal to it. Grips on four sides have
#: no finite elements.
EQUIBIAXIAL_TENSION = TestKind(
    name="equibiaxial_tension", title="Equibiaxial tension", tool=None, sign=1.0,
    channels=(DISPLACEMENT_FORCE, STRETCH_STRESS), closed_form=EQUIBIAXIAL, size_names=_SHEET, title_words=(
        r"(e|a|ae)qui ?biax\w*( (tension|tensile|extension|zug\w*|test\w*))?", r"gleichbiax\w*"),
    file_words=("eb", "ebt", r"et(?=(?: \d+)*$)"))
