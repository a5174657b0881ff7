"""What a calibration runs with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from calibration.fit.fit import Iteration
from calibration.tasks.executors import Tasks

#: Told what is done now, and how many of its tasks are done, and of how many.
Progress = Callable[..., None]
#: Told the campaign, the law and each solve of an inverse fit.
IterationListener = Callable[[str, str, Iteration], None]


@dataclass(frozen=True)
class Context:
    """Where the parts of a calibration run, and who is told of them.

    Attributes:
        tasks: where they run. say: called with a sentence before each part, and with the number of its tasks that are
            done and of all. listen: told every solve. figures: whether reports get their pictures.
    """

    tasks: Tasks
    say: Progress = lambda sentence, done=0, of=0: None
    listen: IterationListener = lambda campaign, law, iteration: None
    figures: bool = True
