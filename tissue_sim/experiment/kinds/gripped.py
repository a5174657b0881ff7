"""Tests of a specimen that is gripped at both ends: tension and simple shear."""

from tissue_sim.closed_form.homogeneous import SIMPLE_SHEAR, UNIAXIAL
from tissue_sim.experiment.kinds.kind import DISPLACEMENT_FORCE, SHEAR_STRESS, STRETCH_STRESS, TestKind

TENSION = TestKind(name="uniaxial_tension", title="Uniaxial tension", tool=None, sign=1.0,
                   channels=(DISPLACEMENT_FORCE, STRETCH_STRESS), closed_form=UNIAXIAL, title_words=(
                       r"(uniaxial )?(tensile|tension)", r"(ein ?achs\w* )?zug(?!scher)\w*", r"pull", r"stretching",
                       r"traction( (uniaxiale|simple))?", r"elongation"))
SHEAR = TestKind(name="simple_shear", title="Simple shear", tool=None, sign=1.0,
                 channels=(DISPLACEMENT_FORCE, SHEAR_STRESS), closed_form=SIMPLE_SHEAR, title_words=(
                     r"(simple )?shear", r"(einfach\w* )?scher(ung|versuch|prufung|pruefung|test)?",
                     r"(einfach\w* )?schub(versuch|prufung|pruefung)", r"cisaillement( simple)?"))
