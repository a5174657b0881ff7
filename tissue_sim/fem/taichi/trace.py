"""Tracing of plug-in formulas, written in Python and NumPy, into code of a kernel.

Taichi compiles the source of functions that carry its decorators only. A formula of a plug-in is therefore called with
`TracedNumber` objects when the kernel is compiled, and each operation becomes an operation of the kernel. The formula
may call functions, loop and index; a branch must not depend on a number, for which ``numpy.where`` is used. Constant
zeros and ones are folded, so that components that vanish in a plane or on an axis take no time.

The key of a compiled kernel consists of its operations, so that two formulas of the same name are two kernels.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields
from functools import reduce
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

from tissue_sim.errors import InputError
from tissue_sim.fem.taichi.runtime import get_initialised_taichi
from tissue_sim.parameters import list_field_declarations

#: Numpy's functions that a formula may use, by the name of Taichi's.
_FUNCTIONS = {np.exp: "exp", np.log: "log", np.sqrt: "sqrt", np.tanh: "tanh", np.sin: "sin", np.cos: "cos",
              np.tan: "tan", np.absolute: "abs", np.maximum: "max", np.minimum: "min", np.power: "pow"}
_OPERATORS: dict[Any, Callable] = {
    np.add: operator.add, np.subtract: operator.sub, np.multiply: operator.mul, np.divide: operator.truediv,
    np.negative: operator.neg, np.less: operator.lt, np.less_equal: operator.le,
    np.greater: operator.gt, np.greater_equal: operator.ge}
#: Whole powers up to this one are products.
_PRODUCTS = 4
#: Placeholder of an expression if a formula is tested without a kernel.
TRIED: Any = object()
Thing = TypeVar("Thing")


class FormulaClassAndConstants(NamedTuple, Generic[Thing]):
    """Formula for which a kernel is compiled: a frozen dataclass and its constants, without its declared parameters.

    Attributes:
        kind: class of the law or effect.
        constants: name and value of each field that is not a declared parameter.
    """

    kind: type[Thing]
    constants: tuple[tuple[str, Any], ...]

    @classmethod
    def from_law_or_effect(cls, thing: Thing) -> FormulaClassAndConstants[Thing]:
        """Return the formula of the class of an effect or a law, with the constants of this instance."""
        kind: Any = type(thing)
        known = list_field_declarations(kind)
        return cls(kind, tuple((entry.name, getattr(thing, entry.name)) for entry in fields(kind)
                               if entry.name not in known))

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the declared parameters of the class, in the order of declaration."""
        return tuple(list_field_declarations(self.kind))

    def get_parameter_values(self, thing: Thing) -> list[float]:
        """Return the values of the declared parameters of a law or effect, in the order of `parameter_names`."""
        return [float(getattr(thing, name)) for name in self.parameter_names]

    def build_unchecked_instance(self, parameters: Iterable[Any]) -> Thing:
        """Return a law or effect with these parameter values, which may be traced numbers and are not checked."""
        thing: Thing = object.__new__(self.kind)
        for name, value in (*self.constants, *zip(self.parameter_names, parameters, strict=True)):
            object.__setattr__(thing, name, value)
        return thing


class TracedNumber(NDArrayOperatorsMixin):
    """Scalar or vector of a kernel that records the operations of a formula.

    Args:
        value: a Taichi expression.
        lanes: whether it is a vector.
    """

    __slots__ = ("lanes", "value")
    __array_priority__ = 100.0

    def __init__(self, value: Any, lanes: bool):
        # A variable of the kernel: an expression that is used twice would be computed twice.
        self.value, self.lanes = value if value is TRIED else get_initialised_taichi().lang.impl.expr_init(value), lanes

    def __bool__(self):
        raise InputError("a formula in a kernel cannot branch on a number (if, and, or). Choose between values "
                         "with numpy.where.")

    def __array_ufunc__(self, ufunc, method, *inputs, **options):
        """Return the traced result of an operator or a NumPy function."""
        # `a += b` binds the name a to another number.
        in_place = options.pop("out", None)
        if method != "__call__" or options or not (in_place is None or in_place[0] is inputs[0]):
            return NotImplemented
        # NumPy scalars would call this method again.
        operands = [float(x) if isinstance(x, np.generic) else x for x in inputs]
        if len(operands) == 2 and (folded := _simplify_operation(ufunc, *operands)) is not None:
            return folded
        if ufunc in _OPERATORS:
            return _record_taichi_operation(_OPERATORS[ufunc], *operands)
        if ufunc in _FUNCTIONS:
            return _record_taichi_operation(getattr(get_initialised_taichi(), _FUNCTIONS[ufunc]), *operands)
        raise InputError(f"a formula in a kernel cannot use numpy.{ufunc.__name__}. Use exp, log, sqrt, tanh, sin, "
                         "cos, tan, abs, maximum, minimum or where.")

    def __array_function__(self, function, types, arguments, options):
        """Return the traced result of ``numpy.where``, the only other NumPy function that a formula may use."""
        if function is not np.where or options or len(arguments) != 3:
            return NotImplemented
        condition, yes, no = arguments
        vector = next((x for x in arguments if isinstance(x, TracedNumber) and x.lanes), None)
        if vector is not None:
            yes, no = (_spread_over_lanes(x, vector) for x in (yes, no))
            if not condition.lanes:
                condition = _spread_over_lanes(_record_taichi_operation(get_initialised_taichi().select, condition, 1.0,
                                                                        0.0), vector) > 0.5
        return _record_taichi_operation(get_initialised_taichi().select, condition, yes, no)


def wrap_as_traced_numbers(values: Sequence[Any], lanes: bool) -> list[TracedNumber]:
    """Wrap each Taichi expression in a `TracedNumber`; `lanes`: whether the expressions are vectors."""
    return [TracedNumber(value, lanes) for value in values]


def extract_expressions(values: Sequence[Any], like: Any) -> list[Any]:
    """Return results of a formula as Taichi expressions; as vectors if the traced number `like` is a vector."""
    if not like.lanes:
        return [value.value if isinstance(value, TracedNumber) else float(value) for value in values]
    return [_spread_over_lanes(value, like).value for value in values]


def _simplify_operation(ufunc: np.ufunc, left: Any, right: Any) -> Any:
    """Return the simplified result of an operation with a constant 0 or 1 or of a small integer power, else None."""
    if ufunc is np.power and isinstance(right, int) and 1 <= right <= _PRODUCTS:
        return reduce(operator.mul, [left] * right)
    if (ufunc is np.multiply and (_is_plain_number_equal_to(left, 0) or _is_plain_number_equal_to(right, 0))) or (
            ufunc is np.divide and _is_plain_number_equal_to(left, 0)):
        return 0.0
    if (ufunc in (np.add, np.subtract) and _is_plain_number_equal_to(right, 0)) \
        or (ufunc in (np.multiply, np.divide) and _is_plain_number_equal_to(right, 1)):
        return left
    if (ufunc is np.add and _is_plain_number_equal_to(left, 0)) \
        or (ufunc is np.multiply and _is_plain_number_equal_to(left, 1)):
        return right
    return -right if ufunc is np.subtract and _is_plain_number_equal_to(left, 0) else None


def _is_plain_number_equal_to(value: Any, number: int) -> bool:
    """Whether a value is the plain number `number`, not a traced number."""
    return not isinstance(value, TracedNumber) and value == number


def _record_taichi_operation(function: Callable, *operands: Any) -> TracedNumber:
    """Apply a Taichi function to operands and return the traced result; `TRIED` operands give a `TRIED` result."""
    lanes = any(isinstance(x, TracedNumber) and x.lanes for x in operands)
    if any(isinstance(x, TracedNumber) and x.value is TRIED for x in operands):
        return TracedNumber(TRIED, lanes)
    return TracedNumber(function(*(x.value if isinstance(x, TracedNumber) else float(x) for x in operands)), lanes)


def _spread_over_lanes(value: Any, vector: TracedNumber) -> TracedNumber:
    """Return a traced vector with the value in every lane, of the length of the traced vector `vector`."""
    if isinstance(value, TracedNumber) and value.lanes:
        return value
    if vector.value is TRIED:
        return TracedNumber(TRIED, lanes=True)
    plain = value.value if isinstance(value, TracedNumber) else float(value)
    # The lanes of a comparison are no numbers: a select makes them some.
    return TracedNumber(vector.value * 0.0 + plain, lanes=True)
