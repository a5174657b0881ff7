"""Commands of `tissue-sim`: a module of each command declares its `Command`, and `COMMANDS` finds it by name.

An installed package adds a command by an entry point of the group ``tissue_sim.commands``, a program by
``COMMANDS.register``.
"""

from scenes.commands.shared.command import Command, CommandResult, ExitCode
from tissue_sim.registry import Registry

#: Commands by name, in the order of the help; the module of a command is imported when its help or the command runs.
COMMANDS: Registry[Command] = Registry("command", "tissue_sim.commands", {
    "demo": "scenes.commands.demo:COMMAND",
    "doctor": "scenes.commands.doctor:COMMAND",
    "import": "scenes.commands.import_files:COMMAND",
    "material": "scenes.commands.material:COMMAND",
    "simulate": "scenes.commands.simulate:COMMAND",
    "calibrate": "scenes.commands.calibrate:COMMAND",
    "diagnose": "scenes.commands.diagnose:COMMAND",
    "design": "scenes.commands.design:COMMAND",
    "loop": "scenes.commands.loop:COMMAND",
    "serve": "scenes.commands.serve:COMMAND",
    "view": "scenes.commands.view:COMMAND",
    "reduce": "scenes.commands.reduce:COMMAND",
    "record": "scenes.commands.record:COMMAND",
    "devices": "scenes.commands.devices:COMMAND",
    "emulate": "scenes.commands.emulate:COMMAND",
}, accepts=lambda each: isinstance(each, Command), expected="a scenes.commands.Command",
    is_used_in_tasks=False)

__all__ = ["COMMANDS", "Command", "CommandResult", "ExitCode"]
