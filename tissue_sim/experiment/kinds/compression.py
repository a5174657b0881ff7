"""Compression of a specimen between plates: lubricated, bonded, and with friction."""

from tissue_sim.closed_form.homogeneous import UNIAXIAL
from tissue_sim.experiment.contact_law import AS_TOOL
from tissue_sim.experiment.kinds.kind import DISPLACEMENT_FORCE, STRETCH_STRESS, FaceInterface, TestKind
from tissue_sim.experiment.tools.plate import Plate

_SMOOTH = FaceInterface("frictionless", fixed=True)
#: Dry plates. Above a coefficient of about 0.5 the force hardly changes, because most of the faces sticks.
_DRY = FaceInterface(0.7, stated=True)

LUBRICATED = TestKind(name="lubricated_compression", title="Lubricated compression", tool=Plate(), face=_SMOOTH,
                      base=_SMOOTH, sign=-1.0, channels=(DISPLACEMENT_FORCE, STRETCH_STRESS),
                      closed_form=UNIAXIAL, title_words=(
                          r"(unconfined |uniaxial )?compress\w*", r"kompress(?!ionsmodul)\w*", r"druck(?!scher)\w*",
                          r"(ein ?achs\w* )?stauch\w*", r"unconfined", r"(un|non|not) confinee?( compress\w*)?",
                          r"(un|non|not) confined( compress\w*)?", r"compress\w* non confinee?", r"ecrasement"))
BONDED = TestKind(name="bonded_compression", title="Bonded compression", tool=Plate(), sign=-1.0,
                  title_words=(r"(bonded|glued) compress\w*",))
FRICTION = TestKind(name="friction_compression", title="Compression with friction", tool=Plate(), face=_DRY,
                    base=FaceInterface(AS_TOOL), sign=-1.0, title_words=(r"compress\w* with friction",))
