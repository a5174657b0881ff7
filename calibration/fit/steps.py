"""The parts of a campaign's calibration: where they run, and who is told of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from calibration.fit.fit import Iteration
from calibration.tasks.executors import OnDone, Tasks

#: Told what is done now, and how many of its tasks are done, and of how many.
Progress = Callable[..., None]
#: Told the campaign, the law and each solve of an inverse fit.
IterationListener = Callable[[str, str, Iteration], None]


@dataclass(frozen=True)
class Steps:
    """The parts of one campaign.

    Attributes:
        campaign: its name. tasks: where they run.
        progress: called with a sentence before each part, and with the number of its tasks that are done and of all.
        announce: called with what is to be expected of the whole, before it begins.
        listen: told every solve.
    """

    campaign: str
    tasks: Tasks
    progress: Progress | None = None
    listen: IterationListener | None = None
    announce: Callable[[str], None] | None = None

    def say(self, sentence: str, *counts: int) -> None:
        """What is done from now on; how many of its tasks are done, and of how many."""
        if self.progress is not None:
            self.progress(f"{self.campaign}: {sentence}", *counts)

    def descents(self, function: Callable, laws: Sequence[str], arguments: Sequence[tuple], what: str) -> list:
        """As `all_of`, of a function that keeps a history; its solves are told as they come, or with the result."""
        def tell(law: str, iteration: Iteration) -> None:
            if self.listen is not None:
                self.listen(self.campaign, law, iteration)

        if not self.tasks.parallel:
            # In this process even while a task runs; the listener would not travel to another.
            arguments = [(*given, partial(tell, law)) for law, given in zip(laws, arguments, strict=True)]
            return self.all_of(function, arguments, what)

        def replay(index: int, answer: Any) -> None:
            for iteration in answer.history:
                tell(laws[index], iteration)

        return self.all_of(function, arguments, what, replay)

    def all_of(self, function: Callable, arguments: Sequence[tuple], what: str,
               on_done: OnDone | None = None, names: Sequence[str] = ()) -> list:
        """Results of a task for each of the arguments; how many are done is said, and of those that run one after the
        other the name of the one that runs."""
        done: list[int] = []

        def say() -> None:
            running = len(done) < len(names) and not self.tasks.parallel
            self.say(f"{what}: {names[len(done)]}" if running else what, len(done), len(arguments))

        def note(index: int, answer: Any) -> None:
            if on_done is not None:
                on_done(index, answer)
            done.append(index)
            say()

        say()
        return self.tasks.run(function, arguments, note)
