"""Commands of `tissue-sim`: one module for each command, or a package for a command with tables or reports.

The module of a command defines

- ``SUMMARY`` and ``EXAMPLE``, texts of the help;
- ``add_arguments(parser)``, which declares the arguments;
- ``run(arguments)``, which runs the command and returns its exit code.

numpy and the packages that need it are imported inside `run`, so that ``--help`` answers at once. `scenes.cli.COMMANDS`
lists the commands.
"""
