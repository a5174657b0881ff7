"""Cache of the results of functions of arrays: a recording is analysed several times between import and calibration."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from hashlib import blake2b
from typing import ParamSpec, TypeVar

import numpy as np

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def cache_by_array_content(most: int) -> Callable[[Callable[Parameters, Result]], Callable[Parameters, Result]]:
    """Return a decorator that stores the last results of a function of arrays.

    The function must be pure and its result immutable: a call with equal arguments returns the same object. The key is
    a hash of the arguments, so that the cache keeps no arrays. Errors are not stored. Arguments must be numeric arrays,
    or numbers, texts and tuples of these, whose representation is complete.

    Args:
        most: number of stored results; the oldest one is discarded first.
    """
    def decorate(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
        results: dict[bytes, Result] = {}

        @wraps(function)
        def find_or_compute(*arguments: Parameters.args, **options: Parameters.kwargs) -> Result:
            key = _hash_arguments((*arguments, *(part for option in sorted(options.items()) for part in option)))
            if (stored := results.get(key)) is not None:
                return stored
            result = results[key] = function(*arguments, **options)
            for oldest in list(results)[: max(0, len(results) - most)]:
                results.pop(oldest, None)
            return result

        return find_or_compute

    return decorate


def _hash_arguments(arguments: tuple[object, ...]) -> bytes:
    """Return a hash of arrays (type, shape and content) and of other values (their representation)."""
    content = blake2b(digest_size=16)
    for each in arguments:
        if isinstance(each, np.ndarray):
            content.update(f"{each.dtype.str}{each.shape}".encode())
            content.update(np.ascontiguousarray(each).tobytes())
        else:
            content.update(repr(each).encode() + b"\0")
    return content.digest()
