"""Transfer of a task to another process, together with all additions to registries.

A worker needs the laws, tools or kinds of test that plug-ins have registered. Classes of installed packages are sent by
name. Classes of other modules (a script or a plug-in file) are sent by value, because a worker on another machine
cannot import them.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import cache
from importlib.metadata import packages_distributions
from typing import Any

import cloudpickle

from tissue_sim.registry import (
    get_modules_of_additions_by_name,
    list_registered_groups_names_objects,
    register_objects_of_other_process,
)


def pack_task(function: Callable[..., Any], arguments: tuple) -> bytes:
    """Pickle a function call, with all objects added to registries, for `run_packed_task` in another process."""
    things = list_registered_groups_names_objects()
    by_value = [module for name, module in get_modules_of_additions_by_name().items()
                if not _is_importable_by_workers(name)]
    for module in by_value:
        cloudpickle.register_pickle_by_value(module)
    try:
        # In two parts: the worker registers the additions before it unpickles the arguments, which may need them.
        return cloudpickle.dumps((cloudpickle.dumps(things) if things else b"", cloudpickle.dumps((function,
                                                                                                   arguments))))
    finally:
        for module in by_value:
            cloudpickle.unregister_pickle_by_value(module)


def run_packed_task(task: bytes) -> Any:
    """Execute a task of `pack_task` in this worker process, and return the result of the function."""
    things, call = cloudpickle.loads(task)
    if things:
        register_objects_of_other_process(cloudpickle.loads(things))
    function, arguments = cloudpickle.loads(call)
    return function(*arguments)


def _is_importable_by_workers(module: str) -> bool:
    """Return whether every worker can import the module with this name: standard library or installed package."""
    package = module.partition(".")[0]
    return package in sys.stdlib_module_names or package in _list_importable_packages()


@cache
def _list_importable_packages() -> frozenset[str]:
    """Return the names of the top-level packages of installed distributions and of this program."""
    # The packages of this program are importable also if they run from their sources.
    return frozenset(packages_distributions()) | {"tissue_sim", "calibration", "haptics", "scenes"}
