"""scenes: ready-made tests, the command line `tissue-sim`, its viewer and its demo.

Public names are listed once, in `__init__.pyi`, and imported on first use, so that ``tissue-sim --help`` answers at
once.
"""

from tissue_sim.public_names import make_lazy_package_members as _import_on_use

#: Old names of modules that programs of users import -> new names.
_MOVED = {
    "scenes.commands.shared.log_lines": "scenes.commands.shared.console",
    "scenes.commands.shared.report_table": "scenes.commands.shared.campaign_results",
    "scenes.commands.shared.text_table": "scenes.commands.shared.console",
    "scenes.viewer.wedge": "scenes.viewer.solid_body",
}
_names, __getattr__, __dir__ = _import_on_use(__name__, moved=_MOVED)
__all__ = _names
