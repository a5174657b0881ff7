"""Standard tests: compression between plates, tension and simple shear of a gripped specimen, needle indentation."""

from tissue_sim.closed_form.homogeneous import SIMPLE_SHEAR, UNIAXIAL
from tissue_sim.experiment.contact_law import AS_TOOL
from tissue_sim.experiment.grip import AXIAL_PULL, LATERAL_SHIFT
from tissue_sim.experiment.kinds.kind import (
    DISPLACEMENT_FORCE,
    SHEAR_STRESS,
    STRETCH_STRESS,
    FaceInterface,
    SizeNames,
    TestKind,
)
from tissue_sim.experiment.tools.shapes import Flat, Plate

TENSION = TestKind(name="uniaxial_tension", title="Uniaxial tension", tool=None, grip=AXIAL_PULL, sign=1.0,
                   channels=(DISPLACEMENT_FORCE, STRETCH_STRESS), closed_form=UNIAXIAL,
                   is_default_of_direction=True,
                   size_names=SizeNames(("gauge length", "length", "height"), ("thickness",)), title_words=(
                       r"(uniaxial )?(tensile|tension)", r"(ein ?achs\w* )?zug(?!scher)\w*", r"pull", r"stretching",
                       r"traction( (uniaxiale|simple))?", r"elongation"), file_words=("ut",))
SHEAR = TestKind(name="simple_shear", title="Simple shear", tool=None, grip=LATERAL_SHIFT, sign=1.0,
                 channels=(DISPLACEMENT_FORCE, SHEAR_STRESS), closed_form=SIMPLE_SHEAR,
                 is_default_of_direction=True,
                 size_names=SizeNames(("thickness", "height", "length", "gap"), ("length",)), title_words=(
                     r"(simple )?shear", r"(einfach\w* )?scher(ung|versuch|prufung|pruefung|test)?",
                     r"(einfach\w* )?schub(versuch|prufung|pruefung)", r"cisaillement( simple)?"), file_words=("ss",))


#: The default tool is the punch of the reference study: flat, radius 8 mm, sharp edge.
NEEDLE = TestKind(name="needle_indentation", title="Needle indentation", tool=Flat(0.008), tool_stated=True,
                  face=FaceInterface("bonded"), base=FaceInterface("bonded"), sign=-1.0, title_words=(
                      r"indent\w*", r"needle", r"punch", r"penetrat\w*", r"puncture", r"eindr\w*"))


_SMOOTH = FaceInterface("frictionless", fixed=True)
#: Dry plates. Above a coefficient of about 0.5 the force hardly changes, because most of the faces sticks.
_DRY = FaceInterface(0.7, stated=True)

LUBRICATED = TestKind(name="lubricated_compression", title="Lubricated compression", tool=Plate(), face=_SMOOTH,
                      base=_SMOOTH, sign=-1.0, channels=(DISPLACEMENT_FORCE, STRETCH_STRESS),
                      closed_form=UNIAXIAL, is_default_of_direction=True, title_words=(
                          r"(unconfined |uniaxial )?compress\w*", r"kompress(?!ionsmodul)\w*", r"druck(?!scher)\w*",
                          r"(ein ?achs\w* )?stauch\w*", r"unconfined", r"(un|non|not) confinee?( compress\w*)?",
                          r"(un|non|not) confined( compress\w*)?", r"compress\w* non confinee?", r"ecrasement"),
                      file_words=("uc",))
BONDED = TestKind(name="bonded_compression", title="Bonded compression", tool=Plate(), sign=-1.0,
                  title_words=(r"(bonded|glued) compress\w*",))
FRICTION = TestKind(name="friction_compression", title="Compression with friction", tool=Plate(), face=_DRY,
                    base=FaceInterface(AS_TOOL), sign=-1.0, title_words=(r"compress\w* with friction",))
