"""Indentation of a cylinder by a needle."""

from scenes.scene import Scene
from tissue_sim.experiment.tools.tool import Tool

#: The study's punch: flat, of radius 8 mm, with a sharp edge.
NEEDLE = Scene("needle_indentation", "Needle indentation", friction="bonded", friction_base="bonded",
               tool=Tool("flat", radius=0.008))
