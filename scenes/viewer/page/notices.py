"""Answers to the one who asked."""

from __future__ import annotations

from collections.abc import Callable

import viser


def answer_to(event: viser.GuiEvent, done: str = "") -> Callable[[str | None], None]:
    """A reply for a command: its problem, or `done` where there is something to say, in the browser that asked."""
    client = event.client

    def reply(problem: str | None) -> None:
        if client is None:
            return
        if problem is not None:
            notify(client, "That did not work", problem, "red")
        elif done:
            notify(client, "Done", done, "teal")

    return reply


def notify(client: viser.ClientHandle, title: str, sentence: str, colour: str) -> None:
    """Show a sentence in a corner of one browser for a while."""
    client.add_notification(title, sentence, color=colour, auto_close_seconds=12.0)


def send_file(client: viser.ClientHandle, name: str, content: bytes) -> None:
    """Let one browser save a file at once."""
    client.send_file_download(name, content, save_immediately=True)
