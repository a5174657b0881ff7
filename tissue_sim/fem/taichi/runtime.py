"""Initialisation of Taichi, once per process, and the fields that all kernels share.

Kernels run on one CPU thread: a step is a chain of small dependent operations, and other processes need the other
cores. Taichi's offline cache stores compiled kernels, so that a machine compiles each of them once.

The shared fields are the scratch field for one batch of elements, and the origins of arrays. Taichi numbers its fields
in the order of creation, and the key of a cached kernel contains these numbers. All fields are created together, so
that the key does not depend on the kernels that a process created before.
"""

from __future__ import annotations

import contextlib
import inspect
import io
import logging
import os
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from types import ModuleType
from typing import Any

from tissue_sim.errors import MissingBackendError
from tissue_sim.files import get_cache_folder

#: Taichi compiles and starts kernels for one thread at a time. A running kernel holds the interpreter lock anyway.
LOCK = threading.RLock()
#: Size limit of the cache of compiled kernels, bytes: the largest that Taichi accepts. The default of 100 MB holds
#: seven large kernels, and each process deletes a quarter of a full cache when it ends.
CACHE_BYTES = 2**31 - 1


def get_initialised_taichi():
    """Import and initialise Taichi at the first call, and return the module `taichi`.

    Raises:
        MissingBackendError: no Taichi wheel exists for this platform.
    """
    with LOCK:
        return _import_and_initialise()


@cache
def _import_and_initialise():
    """Import Taichi, initialise it for one CPU thread and 64-bit floats, and return the module `taichi`."""
    # Taichi prints its version at import and its backend at start to stdout, where --json must be alone.
    os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")
    try:
        with _patch_inspect_getmodule():
            import taichi as ti
        from taichi.lang.ast.ast_transformer_utils import ASTTransformerContext
    except ImportError as error:
        raise MissingBackendError(
            "the finite elements need taichi 1.7.4 for Linux x86-64, Windows x86-64 or macOS on Apple silicon; the "
            f"import failed ({error}). Install taichi==1.7.4; analytical calibration works without it") from None
    # For its messages Taichi formats the source of every expression, which takes longer than the rest of the parsing.
    ASTTransformerContext.get_pos_info = _format_source_position
    folder = get_cache_folder()
    folder.mkdir(parents=True, exist_ok=True)
    with contextlib.redirect_stdout(io.StringIO()):
        ti.init(arch=ti.cpu, default_fp=ti.f64, default_ip=ti.i32, cpu_max_num_threads=1, offline_cache=True,
                offline_cache_file_path=str(folder), offline_cache_max_size_of_files=CACHE_BYTES,
                log_level=ti.ERROR, fast_math=True,
                # LLVM eliminates common subexpressions and dead code as well. Taichi's own passes take a time that
                # grows with the square of the length of a kernel.
                cfg_optimization=False, opt_level=0,
                # Loops over the components of tensors are unrolled on purpose.
                unrolling_limit=0,
                # This option would copy array entries to local variables, one for each index expression: writes through
                # one expression are then invisible to the others.
                cache_loop_invariant_global_vars=False)
    logging.getLogger("taichi").setLevel(logging.ERROR)
    return ti


def _format_source_position(context: Any, node: Any) -> str:
    """Return file, line and function of a node of the syntax tree of a kernel, for messages of Taichi."""
    return f'File "{context.file}", line {node.lineno + context.lineno_offset}, in {context.func.func.__name__}:\n'


@contextlib.contextmanager
def _patch_inspect_getmodule() -> Iterator[None]:
    """Replace `inspect.getmodule` by a faster function in a with block, during the import of Taichi.

    `inspect.getmodule` searches all loaded modules for that of each function, which takes a quarter of the import.
    Functions and frames contain the name of their module.
    """
    search, importer = inspect.getmodule, threading.get_ident()

    def get_defining_module(thing: object, _filename: str | None = None) -> ModuleType | None:
        """Return the module that defines a function or runs a frame; other objects are searched by `inspect`."""
        if threading.get_ident() != importer:
            return search(thing, _filename)
        known = getattr(thing, "f_globals", None) or getattr(thing, "__globals__", None) or {}
        return sys.modules.get(known.get("__name__", "")) or search(thing, _filename)

    inspect.getmodule = get_defining_module  # type: ignore[assignment]
    try:
        yield
    finally:
        inspect.getmodule = search


#: Number of components of the vectors of lanes and of the scratch field, one per finite element of a batch. Eight lanes
#: (AVX-512) are no faster on processors with AVX-512, slower on others, and take 1.5 times as long to compile
#: (docs/performance.md).
LANES = 4
#: Number of vectors in the scratch field.
VECTORS = 3200
#: Number of numbers in a vector of the origin of blocks, and in a row of a block of a band matrix.
BLOCK = 8
#: Number of integers in a vector of the origin of integers, as long as a vector of `BLOCK` numbers.
INTEGER_BLOCK = 16
#: Number of vectors of an origin. Kernels use its address only.
ORIGIN_SIZE = 64


@dataclass(frozen=True)
class CountsInLargestElement:
    """Size of the largest element for which a kernel reserves vectors of the scratch field.

    Attributes:
        nodes: number of nodes.
        points: number of quadrature points.
        modes: number of pressure modes.
    """

    nodes: int
    points: int
    modes: int


def get_shared_scratch_field(lanes: int, size: int):
    """Return the shared scratch field; a kernel may use its first `size` vectors while the kernel runs.

    Args:
        lanes: required number of components of a vector.
        size: required number of vectors.

    Raises:
        ValueError: the field has fewer vectors, or vectors of another length.
    """
    if lanes != LANES or size > VECTORS:
        raise ValueError(f"size must be at most {VECTORS} vectors of {LANES} components; got {size} vectors of "
                         f"{lanes}. Increase VECTORS in tissue_sim/fem/taichi/runtime.py.")
    return get_shared_taichi_fields().scratch


@dataclass(frozen=True)
class SharedTaichiFields:
    """The fields of a process. Kernels address arrays relative to the origins (`tissue_sim.fem.taichi.origins`).

    Attributes:
        blocks: origin, vectors of `BLOCK` numbers.
        lanes: origin, vectors of `LANES` numbers.
        integer_blocks: origin, vectors of `INTEGER_BLOCK` integers of 32 bits.
        integer_lanes: origin, vectors of `LANES` integers of 32 bits.
        scratch: scratch field, `VECTORS` vectors of `LANES` numbers.
    """

    blocks: object
    lanes: object
    integer_blocks: object
    integer_lanes: object
    scratch: object


@cache
def get_shared_taichi_fields() -> SharedTaichiFields:
    """Return the fields of this process; the first call creates them."""
    ti = get_initialised_taichi()
    # The first field begins on a page of memory. Arrays aligned to cache lines are whole vectors away from it.
    return SharedTaichiFields(blocks=ti.Vector.field(BLOCK, ti.f64, shape=ORIGIN_SIZE),
                              lanes=ti.Vector.field(LANES, ti.f64, shape=ORIGIN_SIZE),
                              integer_blocks=ti.Vector.field(INTEGER_BLOCK, ti.i32, shape=ORIGIN_SIZE),
                              integer_lanes=ti.Vector.field(LANES, ti.i32, shape=ORIGIN_SIZE),
                              scratch=ti.Vector.field(LANES, ti.f64, shape=VECTORS))
