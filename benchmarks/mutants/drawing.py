"""Mutants of the source code: enumeration of all possible single faults, and reproducible random draws.

A mutant is a source file with one changed expression. The kinds of faults are mutation operators of DeMillo, Lipton and
Sayward, "Hints on test data selection", Computer 11 (1978), and two that are typical of numerical programs: units and
indices.
"""

from __future__ import annotations

import ast
import copy
import math
import random
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

#: Packages that mutants are drawn from, in turn.
PACKAGES = ("tissue_sim", "calibration", "haptics", "scenes")
#: Kinds of faults, in turn within each package.
KINDS = ("sign", "factor", "index", "unit", "comparison", "removed guard")
#: Ratio of the units between which a conversion is most often forgotten (m and mm, s and ms, Pa and kPa).
UNIT_RATIO = 1e3
#: Factor of a changed number.
FACTOR = 2.0
#: Functions that convert degrees to radians, or back.
ANGLE_FUNCTIONS = frozenset({"radians", "degrees", "deg2rad", "rad2deg"})

_SIGNS: dict[type[ast.operator], type[ast.operator]] = {ast.Add: ast.Sub, ast.Sub: ast.Add}
_FACTORS: dict[type[ast.operator], type[ast.operator]] = {ast.Mult: ast.Div, ast.Div: ast.Mult}
_COMPARISONS: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.Gt, ast.Gt: ast.Lt, ast.LtE: ast.GtE, ast.GtE: ast.LtE, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In}


@dataclass(frozen=True)
class Mutant:
    """One fault in one file.

    Attributes:
        path: path of the file, relative to the root folder.
        line: line of the changed expression, from 1.
        kind: one of `KINDS`.
        before: source of the expression.
        after: source of the changed expression.
        start: byte offset of the expression in the file.
        end: byte offset behind the expression.
        names: names of the functions and classes that contain the expression, the outermost first.
    """

    path: str
    line: int
    kind: str
    before: str
    after: str
    start: int
    end: int
    names: tuple[str, ...]

    def apply(self, source: bytes) -> bytes:
        """Return the content of the file with the fault."""
        return source[:self.start] + self.after.encode() + source[self.end:]


def changed(node: ast.AST, kind: str) -> ast.AST | None:
    """Return the changed node; None if this kind of fault does not apply to the node."""
    match kind, node:
        case "sign", ast.BinOp(op=operator) if type(operator) in _SIGNS:
            return _with(node, op=_SIGNS[type(operator)]())
        case "sign", ast.UnaryOp(op=ast.USub(), operand=operand):
            return operand
        case "factor", ast.BinOp(op=operator) if type(operator) in _FACTORS:
            return _with(node, op=_FACTORS[type(operator)]())
        case "factor", ast.Constant(value=float(value)) if value and not is_power_of_unit(value):
            return ast.Constant(FACTOR * value)
        case "index", ast.Subscript(slice=ast.Constant(value=int(index))) if not isinstance(index, bool):
            return _with(node, slice=ast.Constant(index + 1))
        case "index", ast.Slice(lower=ast.Constant(value=int(index))):
            return _with(node, lower=ast.Constant(index + 1))
        case "unit", ast.Constant(value=float(value)) if is_power_of_unit(value):
            return ast.Constant(float(f"{value * (UNIT_RATIO if value < 1.0 else 1.0 / UNIT_RATIO):.9g}"))
        case "unit", ast.Call(func=function, args=[argument], keywords=[]) if _last_name(function) in ANGLE_FUNCTIONS:
            return argument
        case "comparison", ast.Compare(ops=[operator]):
            return _with(node, ops=[_COMPARISONS[type(operator)]()])
        case "removed guard", ast.If(body=[ast.Raise() | ast.Return() | ast.Continue() | ast.Break()], orelse=[]):
            return ast.Pass()
    return None


def is_power_of_unit(value: float) -> bool:
    """True if a number is a power of `UNIT_RATIO` other than 1, such as 1e-3, 1e3 or 1e6."""
    exponent = math.log(value, UNIT_RATIO) if value > 0.0 else 0.5
    return abs(exponent - round(exponent)) < 1e-9 and round(exponent) != 0


def _with(node: ast.AST, **fields: object) -> ast.AST:
    other = copy.copy(node)
    for name, value in fields.items():
        setattr(other, name, value)
    return other


def _last_name(function: ast.expr) -> str:
    return ast.unparse(function).rpartition(".")[2]


def mutants_of(root: Path, path: Path) -> Iterator[Mutant]:
    """All mutants of a file, in the order of its syntax tree. A few are not valid programs, see `is_valid`."""
    source = path.read_bytes()
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    for node, names in _expressions(ast.parse(source), ()):
        for kind in KINDS:
            other = changed(node, kind)
            if other is None:
                continue
            start = starts[node.lineno - 1] + node.col_offset
            end = starts[node.end_lineno - 1] + node.end_col_offset
            after = ast.unparse(other)
            # Brackets keep the order of operations of the expression around this one.
            after = f"({after})" if isinstance(other, ast.BinOp) else after
            yield Mutant(path.relative_to(root).as_posix(), node.lineno, kind, source[start:end].decode(), after,
                         start, end, names)


def is_valid(mutant: Mutant, source: bytes) -> bool:
    """True if the mutant of a file with this content is a program, and another one."""
    try:
        return ast.dump(ast.parse(mutant.apply(source))) != ast.dump(ast.parse(source))
    except SyntaxError:
        return False


def _expressions(node: ast.AST, names: tuple[str, ...]) -> Iterator[tuple[ast.AST, tuple[str, ...]]]:
    """Nodes that can be changed, with the names of the functions and classes around them.

    Annotations have no effect. Python 3.11 misstates the positions in f-strings."""
    for field, value in ast.iter_fields(node):
        if field in ("annotation", "returns", "decorator_list"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if not isinstance(child, ast.AST) or isinstance(child, ast.JoinedStr):
                continue
            is_scope = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef)
            inner = (*names, child.name) if is_scope else names
            if hasattr(child, "lineno"):
                yield child, inner
            yield from _expressions(child, inner)


def draw(root: Path, seed: int, count: int) -> list[Mutant]:
    """Draw different mutants. Mutant k of a seed does not depend on the number of mutants.

    Args:
        root: folder of the packages.
        seed: seed of the draws.
        count: number of mutants.
    """
    possible: dict[tuple[str, str], list[Mutant]] = {}
    for package in PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            for mutant in mutants_of(root, path):
                possible.setdefault((package, mutant.kind), []).append(mutant)
    drawn: list[Mutant] = []
    for number in range(count):
        package = PACKAGES[number % len(PACKAGES)]
        kind = KINDS[number // len(PACKAGES) % len(KINDS)]
        left = possible[package, kind]
        chance = random.Random(f"{seed} {number}")
        while True:
            mutant = left.pop(chance.randrange(len(left)))
            if is_valid(mutant, (root / mutant.path).read_bytes()):
                break
        drawn.append(mutant)
    return drawn
