"""The commands of `tissue-sim`: a module each, or a package where a command has tables and reports of its own.

A command states `SUMMARY`, `EXAMPLE`, `add_arguments(parser)` and `run(arguments) -> exit code`. It imports numpy and
everything above it inside `run`, so that help is instant. `scenes.cli` lists them.
"""
