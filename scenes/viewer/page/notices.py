"""Notifications and file downloads for the browser whose user issued a command."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, TypeVar

import viser

Value = TypeVar("Value")
#: Function that receives None when a command has been executed, or a sentence with the reason for its refusal.
Reply = Callable[[str | None], None]
#: Title of a notification about a command that was refused.
FAILED = "Not done"


def assign_control_value(control: viser.GuiInputHandle[Value], value: Value) -> None:
    """Assign a value to a control of the page."""
    # viser defines the setter apart from the getter, so type checkers see a read-only property.
    control.value = value  # type: ignore[misc]


def make_browser_reply_function(event: viser.GuiEvent | viser.SceneNodeDragEvent, done: str = "") -> Reply:
    """Return a reply function that notifies the browser of an event.

    Args:
        event: Event of the browser.
        done: Sentence to show when the command has been executed; empty: show nothing.
    """
    client = event.client

    def notify_of_outcome(problem: str | None) -> None:
        if problem is not None:
            notify_browser_unless_none(client, FAILED, problem, "red")
        elif done:
            notify_browser_unless_none(client, "Done", done, "teal")

    return notify_of_outcome


def notify_browser_unless_none(client: viser.ClientHandle | None, title: str, sentence: str,
                               colour: Literal["red", "teal"]) -> None:
    """Show a notification in a browser for 12 s; do nothing if `client` is None."""
    if client is not None:
        client.add_notification(title, sentence, color=colour, auto_close_seconds=12.0)


def send_download(client: viser.ClientHandle | None, name: str, content: bytes) -> None:
    """Make a browser download a file without asking; do nothing if `client` is None."""
    if client is not None:
        client.send_file_download(name, content, save_immediately=True)
