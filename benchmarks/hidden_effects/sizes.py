"""Sizes of the hidden effects and their testability, computed from the true curves and frozen in a table.

The measure is the projected signal over noise: how much an effect moves the force beyond what C10, C20, the contact and
the zero of each recording can take up, in deviations of white noise of 0.02 N, all recordings together. It knows
nothing of the diagnosis.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from benchmarks.hidden_effects.cases import Case, hidden, moduli_change, outside
from benchmarks.hidden_effects.truth import C10, C20, PROTOCOLS, VirtualTest, plain
from tissue_sim.errors import ConvergenceError

TABLE = Path(__file__).with_name("sizes.json")
#: Standard deviation of the force, N.
NOISE = 0.02
#: Jitter of the contact between replicates, m.
CONTACT = 0.03e-3
#: Jitter of the zero between replicates, N.
ZERO = 0.01
#: Number of recordings of a test.
REPLICATES = 3
#: Correlation time of coloured noise, s.
CORRELATED = 0.5
#: Classes of projected signal over noise, and the values that are aimed at in them.
CLASSES = {"< 3": (0.0, 3.0), "3 to 10": (3.0, 10.0), "> 10": (10.0, np.inf)}
AIMS = {"< 3": (2.0,), "3 to 10": (6.0,), "> 10": (15.0, 50.0, 150.0)}
#: Signal at the largest physical size below which an effect is not testable, 1.
TESTABLE = 5.0
#: Cosine of two changes of the force above which two effects are twins, 1.
TWINS = 0.97
#: Less than this signal is nothing that was hidden.
LEAST = 0.5
#: What is hidden in a protocol, where it is not everything.
ONLY = {"animals": ("population/exact", "population/other")}
#: Outsiders are seen: this is aimed at.
_SEEN = (15.0, 50.0)


class Projection:
    """Part of a change of all forces that the moduli, contact and zero of the recordings cannot explain.

    Args:
        tests: tests of the protocol. memory: correlation time of the noise, s; 0: white noise.
    """

    def __init__(self, tests: Sequence[VirtualTest], memory: float = 0.0):
        self._memory = memory
        self.tests = [test for test in tests if not test.held_out]
        self.plain = [plain(test.kind, test.displacement) for test in self.tests]
        blocks = [moduli_change(test) * [C10, C20] for test in self.tests]
        rows, count = sum(map(len, blocks)), len(blocks)
        design = np.zeros((rows + 2 * count, 2 + 2 * count))
        start = 0
        for k, (test, block, force) in enumerate(zip(self.tests, blocks, self.plain, strict=True)):
            here = slice(start, start + len(block))
            design[here, :2] = self._white(test, block)
            slope = np.gradient(force, test.displacement + 1e-12 * np.arange(force.size))
            if test.returns:
                # In a hold the displacement stands still.
                step = 1e-6
                slope = (plain(test.kind, test.displacement + step) - plain(test.kind, test.displacement - step)) / (
                    2 * step)
            design[here, 2 + 2 * k] = self._white(test, slope * CONTACT)
            design[here, 3 + 2 * k] = self._white(test, np.full(slope.size, ZERO))
            start += len(block)
        design[rows:, 2:] = np.eye(2 * count)
        self._rows, self._basis = rows, np.linalg.qr(design)[0]

    def _white(self, test: VirtualTest, columns: np.ndarray) -> np.ndarray:
        """Scale forces (N) to deviations of independent noise; correlated noise depends on the previous sample only."""
        columns = columns / NOISE
        if not self._memory:
            return columns
        kept = np.exp(-np.diff(test.time) / self._memory).reshape(-1, *[1] * (columns.ndim - 1))
        return np.concatenate([columns[:1], (columns[1:] - kept * columns[:-1]) / np.sqrt(1 - kept**2)])

    def direction(self, forces: Callable[[VirtualTest], np.ndarray]) -> np.ndarray:
        """Part of a change of force that no other change represents, in standard deviations of all recordings, (n,)."""
        whole = np.zeros(len(self._basis))
        whole[:self._rows] = np.concatenate([self._white(test, forces(test) - force)
                                             for test, force in zip(self.tests, self.plain, strict=True)])
        return np.sqrt(REPLICATES) * (whole - self._basis @ (self._basis.T @ whole))

    def signal(self, case: Case, size: float) -> float:
        return float(np.linalg.norm(self.direction(lambda test: case.force(test, size))))


def three_digits(size: float) -> float:
    return float(f"{size:.3g}")


def size_for(projection: Projection, case: Case, aim: float) -> tuple[float, float] | None:
    """Return a physical size with about this signal, and its signal; None: no such size."""
    size = three_digits(np.sqrt(case.low * case.high))
    for _ in range(4):
        signal = projection.signal(case, size)
        if abs(np.log(max(signal, 1e-9) / aim)) < 0.1:
            break
        better = three_digits(float(np.clip(size * np.clip(aim / max(signal, 1e-9), 0.02, 50), case.low, case.high)))
        if better == size:
            break
        size = better
    signal = projection.signal(case, size)
    if signal < LEAST:
        return None
    low, high = next(limits for limits in CLASSES.values() if limits[0] <= aim < limits[1])
    return (size, signal) if low <= signal < high else None


def tabulate(name: str, say: Callable[[str], None] = print) -> dict:
    """Return sizes and testability of the effects in one protocol.

    Args:
        name: of the protocol. say: what is done.
    """
    projection, coloured = Projection(PROTOCOLS[name]()), Projection(PROTOCOLS[name](), CORRELATED)
    rows, directions = {}, {}
    for key, case in {**hidden(), **outside()}.items():
        if key not in ONLY.get(name, (key,)):
            continue
        aims = {"> 10": _SEEN} if not case.effect else AIMS
        try:
            largest = projection.signal(case, case.high)
        except ConvergenceError:
            # The largest does not go through; the middle tells as well whether it is seen.
            largest = projection.signal(case, three_digits(np.sqrt(case.low * case.high)))
        row: dict = {"sizes": {}, "correlated": {}}
        for words, values in aims.items():
            try:
                found = [size_for(projection, case, aim) for aim in values]
            except ConvergenceError as failure:
                say(f"{name}: {key}: {failure}")
                continue
            kept = {size: round(signal, 2) for size, signal in filter(None, found)}
            if kept:
                row["sizes"][words] = [[size, signal] for size, signal in kept.items()]
                row["correlated"][words] = [round(coloured.signal(case, size), 2) for size in kept]
                # Some are not largest at their largest size (plates that hold all of the tissue).
                largest = max([largest, *kept.values()])
        row |= {"signal_at_most": round(largest, 2), "testable": bool(largest >= TESTABLE)}
        rows[key] = row
        if case.effect and row["sizes"]:
            middle = row["sizes"].get("> 10", next(iter(row["sizes"].values())))[0][0]
            direction = projection.direction(lambda test, case=case, middle=middle: case.force(test, middle))
            if row["signal_at_most"] >= 1.0:
                directions[key] = direction / np.linalg.norm(direction)
        say(f"{name}: {key}: at most {largest:.3g}, sizes {row['sizes']}")
    for key, direction in directions.items():
        effect = key.partition("/")[0]
        twins = {other.partition("/")[0] for other, its in directions.items()
                 if other.endswith("/exact") and abs(float(direction @ its)) > TWINS}
        rows[key]["twins"] = sorted(twins - {effect})
    return rows


def freeze(protocols: Sequence[str], say: Callable[[str], None] = print) -> None:
    """Write the table of sizes, which is part of the code hash of sealed figures."""
    table = {name: tabulate(name, say=say) for name in protocols}
    TABLE.write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")


def class_of(signal: float) -> str:
    """Return the class of a projected ratio of signal to noise."""
    return next(words for words, (low, high) in CLASSES.items() if low <= signal < high)


def frozen() -> Mapping[str, Mapping[str, dict]]:
    """Protocol -> key -> ``signal_at_most``, ``testable``, ``sizes`` (class -> [size, signal in white noise]),
    ``correlated`` (class -> signal in correlated noise, same order), ``twins``."""
    return json.loads(TABLE.read_text(encoding="utf-8"))
