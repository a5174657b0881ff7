"""Confined compression: a chamber holds the side of the specimen, so that the force measures K + 4/3 mu0.

Source: aggregate modulus: Mow, Kuei, Lai and Armstrong, J. Biomech. Eng. 102 (1980) 73.
"""

from tissue_sim.closed_form.confined import CONFINED
from tissue_sim.experiment.kinds.kind import DISPLACEMENT_FORCE, STRETCH_STRESS, FaceInterface, TestKind
from tissue_sim.experiment.tools.shapes import Plate

#: Tissue does not slide on the platens, because the wall prevents its lateral motion. Bonded platens never lift off.
_HELD = FaceInterface("bonded", fixed=True)

#: The fluid of a porous specimen leaves through the platen.
CONFINED_COMPRESSION = TestKind(
    name="confined_compression", title="Confined compression", tool=Plate(), has_lateral_wall=True, face=_HELD,
    base=_HELD, sign=-1.0, channels=(DISPLACEMENT_FORCE, STRETCH_STRESS), closed_form=CONFINED,
    file_words=("conf ?comp",), title_words=(
        r"confined( compress\w*)?", r"confining", r"confinement", r"porous (platens?|plates?|filters?)",
        r"(radially |laterally )?(confined|constrained|restrained) compress\w*", r"compress\w* confinee?",
        r"confinee?", r"o?edomet\w*", r"laterally (confined|constrained|restrained)", r"uniaxial strain",
        r"(ein|um)geschlossen\w*( (kompress\w*|druck\w*))?",
        r"(seitlich|radial) (begrenzt|behindert|gehalten|gefuhrt)\w*",
        r"(behindert\w*|verhindert\w*) (quer|seiten)dehnung", r"eingeschrankt\w* (kompress\w*|druck\w*)",
        r"aggregate modulus"))
