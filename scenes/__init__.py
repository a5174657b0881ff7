"""scenes: what people meet. Ready-made scenes, the command line and the demo.

Public names are listed here once and imported on first use, so that ``tissue-sim --help`` is instant.
"""

from tissue_sim.public_names import import_on_use as _import_on_use

_HOMES = {
    "SCENES": "catalogue",
    "draw_simulation": "figures",
    "run_demo": "demo.virtual_test",
}

__all__ = sorted(_HOMES)
__getattr__, __dir__ = _import_on_use(__name__, _HOMES)
