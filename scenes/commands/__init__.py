"""The commands of `tissue-sim`, one module each.

A command module states `SUMMARY`, `EXAMPLE`, `add_arguments(parser)` and `run(arguments) -> exit code`. It imports
numpy and everything above it inside `run`, so that help is instant.
"""

from scenes.commands import calibrate, demo, doctor, loop, material, serve, simulate, view

COMMANDS = {
    "demo": demo,
    "doctor": doctor,
    "material": material,
    "simulate": simulate,
    "calibrate": calibrate,
    "loop": loop,
    "serve": serve,
    "view": view,
}

#: Names that are settled and answered as not available in this version.
LATER = ("design", "diagnose", "record", "devices", "emulate", "reduce")
