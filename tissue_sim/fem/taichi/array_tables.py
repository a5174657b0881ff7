"""Named arrays that a kernel gets through one table of their offsets from the origins, instead of one argument each.

A launch of a `BoundKernel` costs a fraction of a microsecond for each array argument, and neighbouring numbers of an
argument are not loaded as a vector (`tissue_sim.fem.taichi.origins`). An `ArrayLayout` names the arrays of one subject.
Outside of kernels, `ArrayLayout.make_offset_table` computes the table of arrays. In a kernel,
``layout.open_table(table)`` returns an object with an attribute for each array: ``arrays.moduli[b]``. Offsets
are loaded once, where the table is opened. A table keeps its arrays alive.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np

from tissue_sim.errors import make_hint_with_similar_or_known_words
from tissue_sim.fem.taichi.origins import AddressOriginKind, compute_array_offset, get_address_origin
from tissue_sim.fem.taichi.runtime import get_initialised_taichi


@dataclass(frozen=True)
class ArrayType:
    """Type of an array in a layout.

    Attributes:
        kind: origin of the array.
        rank: number of indices in kernels. An array of lanes has one index, and its entries are vectors.
    """

    kind: AddressOriginKind
    rank: int = 1

    @property
    def has_lanes(self) -> bool:
        """Whether each entry is a vector with one component for each finite element of a batch."""
        return self.kind in (AddressOriginKind.REAL_LANES, AddressOriginKind.INTEGER_LANES)

    @property
    def table_entry_count(self) -> int:
        """Number of entries in the table: offset, and the lengths of the axes of an array without lanes."""
        return 1 if self.has_lanes else 1 + self.rank

    def compute_table_entries(self, name: str, array: np.ndarray) -> list[int]:
        """Return the entries of an array in the table.

        Raises:
            ValueError: the array has another number of axes or lanes, or kernels cannot address it.
        """
        expected = f"shape (rows, {self.kind.width})" if self.has_lanes else f"{self.rank} axes"
        if array.ndim != (2 if self.has_lanes else self.rank) or (self.has_lanes
                                                                  and array.shape[1] != self.kind.width):
            raise ValueError(f"{name} must have {expected}; got shape {array.shape}.")
        offset = compute_array_offset(array, self.kind)
        return [offset] if self.has_lanes else [offset, *array.shape]


#: Floats, one number for each element of a batch.
LANE_REALS = ArrayType(AddressOriginKind.REAL_LANES)
#: Integers, one number for each element of a batch.
LANE_INTEGERS = ArrayType(AddressOriginKind.INTEGER_LANES)


def real_array_type(rank: int = 1) -> ArrayType:
    """Return the type of an array of floats with `rank` axes."""
    return ArrayType(AddressOriginKind.REAL_BLOCKS, rank)


def integer_array_type(rank: int = 1) -> ArrayType:
    """Return the type of an array of integers with `rank` axes."""
    return ArrayType(AddressOriginKind.INTEGER_BLOCKS, rank)


class ArrayTable(np.ndarray):
    """Table of a layout, an array of int32, which keeps the arrays alive whose offsets it contains.

    Attributes:
        arrays: name -> array.
    """

    arrays: dict[str, np.ndarray]


class ArrayLayout:
    """Names and types of the arrays that one table describes.

    Args:
        types: name -> type, in the order of the table.
    """

    def __init__(self, **types: ArrayType):
        self.types = types

    def make_offset_table(self, arrays: Mapping[str, np.ndarray]) -> ArrayTable:
        """Return the table of arrays. Arrays of other names are ignored.

        Raises:
            ValueError: an array is missing or has another number of axes or lanes, or kernels cannot address it.
            OverflowError: an array is too far from its origin.
        """
        if missing := [name for name in self.types if name not in arrays]:
            raise ValueError(f"arrays must contain {', '.join(missing)}"
                             f"{make_hint_with_similar_or_known_words(missing[0], arrays)}")
        table = np.array([entry for name, kind in self.types.items()
                          for entry in kind.compute_table_entries(name, arrays[name])], dtype=np.int32).view(ArrayTable)
        table.arrays = {name: arrays[name] for name in self.types}
        return table

    def replace_arrays(self, table: ArrayTable, arrays: Mapping[str, np.ndarray]) -> None:
        """Replace all arrays of a table, for every kernel that is bound to it.

        Raises:
            ValueError: as for `make_offset_table`; nothing is changed.
            OverflowError: likewise.
        """
        other = self.make_offset_table(arrays)
        table[:], table.arrays = other, other.arrays

    def open_table(self, table: Any) -> SimpleNamespace:
        """Return an object with an attribute for each array of a table; to be called in a kernel.

        Args:
            table: the kernel's argument for the table.
        """
        impl = get_initialised_taichi().lang.impl
        opened, position = _OpenedTable(), 0
        for name, kind in self.types.items():
            offset, *shape = (impl.expr_init(impl.subscript(None, table, position + i))
                              for i in range(kind.table_entry_count))
            setattr(opened, name, _LaneView(kind.kind, offset) if kind.has_lanes
                    else _NumberView(kind.kind, offset, shape))
            position += kind.table_entry_count
        return opened

    # Taichi warns of calls of functions that are not its own, unless they have this mark.
    open_table._is_wrapped_kernel = True  # type: ignore[attr-defined]


class _OpenedTable(SimpleNamespace):
    """Arrays of a table in a kernel."""

    #: Taichi assigns objects with this mark to variables without a conversion.
    _data_oriented = True


class _LaneView:
    """Array of lanes in a kernel: ``view[row]`` is a vector."""

    _data_oriented = True

    def __init__(self, kind: AddressOriginKind, offset: Any):
        self._field, self._offset = get_address_origin(kind).field, offset

    def __getitem__(self, row: Any) -> Any:
        return get_initialised_taichi().lang.impl.subscript(None, self._field, self._offset + row)


class _NumberView:
    """Array of numbers in a kernel: ``view[i, j]`` is a number, ``view.shape`` the lengths of the axes."""

    _data_oriented = True

    def __init__(self, kind: AddressOriginKind, offset: Any, shape: list[Any]):
        self._field, self._offset, self.shape = get_address_origin(kind).field, offset, shape
        # Both widths are powers of two: entry i is component i & mask of vector i >> shift.
        self._shift, self._mask = kind.width.bit_length() - 1, kind.width - 1

    def __getitem__(self, indices: Any) -> Any:
        impl = get_initialised_taichi().lang.impl
        indices = indices if isinstance(indices, (tuple, list)) else (indices,)
        if len(indices) != len(self.shape):
            raise IndexError(f"the number of indices must be {len(self.shape)}; got {len(indices)}")
        number = indices[0]
        for length, index in zip(self.shape[1:], indices[1:], strict=True):
            number = number * length + index
        if not isinstance(number, int):
            number = impl.expr_init(number)
        vector = impl.subscript(None, self._field, self._offset + (number >> self._shift))
        return impl.subscript(None, vector, number & self._mask)
