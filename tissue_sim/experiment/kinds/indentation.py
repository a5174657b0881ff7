"""Indentation of a specimen by a needle."""

from tissue_sim.experiment.kinds.kind import FaceInterface, TestKind
from tissue_sim.experiment.tools.flat import Flat

#: The default tool is the punch of the reference study: flat, radius 8 mm, sharp edge.
NEEDLE = TestKind(name="needle_indentation", title="Needle indentation", tool=Flat(0.008), tool_stated=True,
                  face=FaceInterface("bonded"), base=FaceInterface("bonded"), sign=-1.0, title_words=(
                      r"indent\w*", r"needle", r"punch", r"penetrat\w*", r"puncture", r"eindr\w*"))
