"""Simulated curves, remembered by the content of what they depend on: in memory, and on disk for a run that goes on."""

from __future__ import annotations

import contextlib
import hashlib
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import msgspec
import numpy as np

import tissue_sim
from calibration.forward.meshes import exact_mesh
from tissue_sim.atomic_write import write_bytes
from tissue_sim.differentiation import sensitivities
from tissue_sim.errors import ConvergenceError, InputError
from tissue_sim.experiment.tools.tool import Tool
from tissue_sim.model import Model
from tissue_sim.parameters import declared
from tissue_sim.registry import modules_of_additions
from tissue_sim.simulation import simulate
from tissue_sim.specimen import Specimen


class SimulatedCurve(msgspec.Struct, frozen=True, array_like=True):
    """Force and its derivatives at the knots of a motion.

    Attributes:
        force: N, shape (k,), as a list; empty where the simulation did not get through.
        rates: dF/dtheta, shape (k, p), as lists.
        problem: why it did not get through; empty otherwise.
        cpu_s: processor seconds that it took.
        exact: whether each derivative is exact, and no difference of two simulations.
    """

    force: list[float]
    rates: list[list[float]]
    problem: str
    cpu_s: float
    exact: list[bool] = []


class Solves:
    """Simulations by key.

    Args:
        folder: where they are kept, a file each; None: in memory only.
    """

    def __init__(self, folder: Path | None = None):
        self.folder = folder
        self._shelf = folder
        self._known: dict[str, SimulatedCurve] = {}
        #: (test, resolution) -> simulations that nobody remembered.
        self.counts: Counter[tuple[str, str]] = Counter()

    def __getstate__(self):
        # Another process reads what it needs from the folder, and counts its own.
        return {"folder": self.folder, "_shelf": self._shelf, "_known": {} if self.folder else self._known,
                "counts": Counter()}

    def find(self, key: str) -> SimulatedCurve | None:
        """The curve of a key, None where nobody computed it; a file that cannot be read does not count."""
        if key not in self._known and self._shelf is not None:
            with contextlib.suppress(OSError, msgspec.DecodeError, msgspec.ValidationError):
                self._known[key] = msgspec.msgpack.decode((self._shelf / f"{key}.msgpack").read_bytes(),
                                                          type=SimulatedCurve)
        return self._known.get(key)

    def keep(self, key: str, curve: SimulatedCurve) -> None:
        """Remember a curve."""
        self._known[key] = curve
        if self.folder is not None:
            write_bytes(self.folder / f"{key}.msgpack", msgspec.msgpack.encode(curve))

    def meter(self) -> Callable[[], tuple[dict[tuple[str, str], int], float]]:
        """What is spent from here on: simulations by (test, resolution), and processor seconds."""
        began, counted = time.process_time(), self.counts.copy()
        return lambda: (dict(self.counts - counted), time.process_time() - began)

    def read_from(self, folder: Path) -> None:
        """Look for curves in a folder, without keeping any there yet."""
        self._shelf = folder

    def move_to(self, folder: Path) -> None:
        """Keep everything in a folder from now on."""
        # Another process may stand elsewhere.
        self.folder = self._shelf = folder.resolve()
        for key, curve in self._known.items():
            self.keep(key, curve)


def simulate_curve(model: Model, topology: Model | None, names: Sequence[str], resolution: str,
                   solver: str = "axisymmetric", *, one_sided: bool = False) -> SimulatedCurve:
    """A simulation with the derivatives of these parameters; what does not get through says why.

    Args:
        model, topology, resolution, solver: as `tissue_sim.simulation.simulate`. names: paths of parameters.
        one_sided: as `tissue_sim.differentiation.sensitivities`.
    """
    began = time.process_time()
    try:
        mesh = exact_mesh(topology or model, solver)
        if names:
            answer = sensitivities(model, names, resolution=resolution, mesh=mesh, topology=topology, solver=solver,
                                   one_sided=one_sided)
            force, rates, exact = answer.recording.force, answer.values, answer.exact.tolist()
        else:
            force = simulate(model, resolution=resolution, mesh=mesh, topology=topology, solver=solver,
                             estimate_error=False).force
            rates = np.zeros((0, 0))
            exact = []
    except (ConvergenceError, InputError) as error:
        return SimulatedCurve([], [], str(error), time.process_time() - began)
    return SimulatedCurve(force.tolist(), rates.tolist(), "", time.process_time() - began, exact)


def content_key(*parts: Any) -> str:
    """SHA-256 of everything in frozen data, numbers to the last digit, and of the source of the solver and of all laws,
    effects, ... that were added to it."""
    added = [[name, _source_digest(module)] for name, module in modules_of_additions().items()]
    return hashlib.sha256(msgspec.json.encode([_solver_digest(), added, _plain(parts)])).hexdigest()[:40]


def _source_digest(module: ModuleType) -> str:
    # A module without a file, such as a session of a notebook, counts by its name only.
    file = Path(getattr(module, "__file__", None) or "")
    return hashlib.sha256(file.read_bytes()).hexdigest() if file.is_file() else ""


@cache
def _solver_digest() -> str:
    """What would make the same model another curve: the source of the package."""
    digest = hashlib.sha256(tissue_sim.__version__.encode())
    for path in sorted(Path(tissue_sim.__file__).parent.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _plain(value: Any) -> Any:
    if isinstance(value, Tool):
        # What the tissue meets counts, not the file that it comes from.
        return [value.shape, _plain({name: getattr(value, name) for name in declared(type(value))}),
                _plain(value.profile)]
    if isinstance(value, Specimen) and value.paths:
        # The same of a specimen: nor does it matter in which folder its file lies.
        named = {value.texts[key] for key in value.paths}
        return [type(value).__name__, value.digest, {entry.name: _plain(getattr(value, entry.name))
                                                     for entry in fields(value) if entry.name not in named}]
    if is_dataclass(value):
        return [type(value).__name__, {entry.name: _plain(getattr(value, entry.name)) for entry in fields(value)}]
    if isinstance(value, np.ndarray):
        return [float(number).hex() if value.dtype.kind == "f" else str(number) for number in value.ravel()]
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in sorted(value.items())}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return value.hex()
    return value if isinstance(value, int | str | bool | None) else str(value)
