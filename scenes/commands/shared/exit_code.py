"""Exit codes of the commands."""

from enum import IntEnum


class ExitCode(IntEnum):
    """Exit code of a command."""

    #: The command reached its goal.
    DONE = 0
    #: The command ran but did not reach its goal: no convergence, no usable fit, a failed check.
    GOAL_MISSED = 1
    #: The input is invalid; nothing was written.
    BAD_INPUT = 2
    #: Ctrl-C stopped the command (128 + the number of SIGINT).
    INTERRUPTED = 130
