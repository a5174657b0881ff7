"""Public names of the package; `__init__.py` imports each name on its first use."""

from scenes.catalogue import SCENES as SCENES
from scenes.demo.hidden_effect_demo import run_hidden_demo as run_hidden_demo
from scenes.demo.virtual_test import run_demo as run_demo
from scenes.figures import draw_simulation as draw_simulation
