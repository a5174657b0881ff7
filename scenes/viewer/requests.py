"""Queue of the requests to a session, with rules for superseded requests and for changes of the material."""

from __future__ import annotations

import queue
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import tissue_sim as ts
from tissue_sim.errors import InputError
from tissue_sim.parameters import parameter_values, with_values


class CommandQueue:
    """Thread-safe queue of commands with their arguments and reply functions."""

    def __init__(self) -> None:
        self._queue: queue.SimpleQueue[tuple[str, Callable | None, dict[str, Any]]] = queue.SimpleQueue()

    def append_command_thread_safely(self, command: str, reply: Callable[[str | None], None] | None,
                                     values: dict[str, Any]) -> None:
        """Queue a command; any thread may call this method."""
        self._queue.put((command, reply, values))

    def execute_commands_except_superseded(self, run: Callable[[str, dict[str, Any]], None]) -> None:
        """Execute the queued commands in order, except superseded ones; call all reply functions.

        A reply function receives None, or the text of the InputError of `run`.

        Args:
            run: Executes a command with its arguments. Its InputError becomes the reply.
        """
        requests = []
        while not self._queue.empty():
            requests.append(self._queue.get())
        for number, (command, reply, values) in enumerate(requests):
            problem = None
            try:
                if not is_command_superseded(command, values, requests[number + 1:]):
                    run(command, values)
            except InputError as error:
                problem = str(error)
            if reply is not None:
                reply(problem)


def is_command_superseded(command: str, values: dict[str, Any],
                          later: list[tuple[str, Callable | None, dict[str, Any]]]) -> bool:
    """Return whether a later request makes a request unnecessary.

    A later ``aim`` with the same arguments replaces an ``aim``; a directly following ``set_parameters`` of the same
    parameters replaces a ``set_parameters``.

    Args:
        command: Command of the request.
        values: Arguments of the request.
        later: Later requests as command, reply and arguments.
    """
    if command == "aim":
        return any(other == "aim" and values.keys() <= named.keys() for other, _, named in later)
    return (command == "set_parameters" and bool(later) and later[0][0] == command
            and later[0][2]["values"].keys() == values["values"].keys())


def differ_at_most_in_parameter_values(a: ts.Material, b: ts.Material) -> bool:
    """Return whether two materials differ at most in the values of their parameters and in their name."""
    values = parameter_values(b)
    if parameter_values(a).keys() != values.keys():
        return False
    try:
        return replace(with_values(a, values), name=b.name) == b
    except InputError:  # the mixture of both is invalid
        return False
