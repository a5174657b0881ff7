"""Answers to the one who asked."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, TypeVar

import viser

Value = TypeVar("Value")
#: Gets None when something is done, or a sentence that says why not.
Reply = Callable[[str | None], None]


def set_value(control: viser.GuiInputHandle[Value], value: Value) -> None:
    """Show another value in a control."""
    # The setter does not stand next to its getter in viser, so that checkers see none.
    control.value = value  # type: ignore[misc]


def answer_to(event: viser.GuiEvent | viser.SceneNodeDragEvent, done: str = "") -> Reply:
    """A reply for a command: its problem, or `done` where there is something to say, in the browser that asked."""
    client = event.client

    def reply(problem: str | None) -> None:
        if problem is not None:
            notify(client, "That did not work", problem, "red")
        elif done:
            notify(client, "Done", done, "teal")

    return reply


def notify(client: viser.ClientHandle | None, title: str, sentence: str, colour: Literal["red", "teal"]) -> None:
    """Show a sentence in a corner of one browser for a while; without one nobody is told."""
    if client is not None:
        client.add_notification(title, sentence, color=colour, auto_close_seconds=12.0)


def send_file(client: viser.ClientHandle | None, name: str, content: bytes) -> None:
    """Let one browser save a file at once."""
    if client is not None:
        client.send_file_download(name, content, save_immediately=True)
