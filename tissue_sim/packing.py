"""A task on its way to another process, with everything that this program has registered.

A worker that could not find a law, a tool or a kind of test that a plugin has added would refuse the task. Classes of
installed packages travel by name. Those of other modules, a script or a plugin file of the user's, travel as they are,
because a worker on another machine cannot import them.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import cache
from importlib.metadata import packages_distributions
from typing import Any

import cloudpickle

from tissue_sim.registry import modules_of_additions, register_all, registered


def pack(function: Callable[..., Any], arguments: tuple) -> bytes:
    """A task that `run_packed` runs elsewhere."""
    things = registered()
    travelling = [module for name, module in modules_of_additions().items() if not _is_installed(name)]
    for module in travelling:
        cloudpickle.register_pickle_by_value(module)
    try:
        # In two parts, so that what is registered is known when the arguments are made of it.
        return cloudpickle.dumps((cloudpickle.dumps(things) if things else b"", cloudpickle.dumps((function,
                                                                                                   arguments))))
    finally:
        for module in travelling:
            cloudpickle.unregister_pickle_by_value(module)


def run_packed(task: bytes) -> Any:
    """The result of a task, in the worker."""
    things, call = cloudpickle.loads(task)
    if things:
        register_all(cloudpickle.loads(things))
    function, arguments = cloudpickle.loads(call)
    return function(*arguments)


def _is_installed(module: str) -> bool:
    """Whether every worker can import it."""
    package = module.partition(".")[0]
    return package in sys.stdlib_module_names or package in _packages()


@cache
def _packages() -> frozenset[str]:
    # This program counts also where it runs from its sources.
    return frozenset(packages_distributions()) | {"tissue_sim", "calibration", "haptics", "scenes"}
