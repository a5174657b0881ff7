"""Cache of simulated curves by a hash of model and solver, in memory and in a folder."""

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
from calibration.forward.meshes import make_exact_block_mesh_or_none
from tissue_sim.differentiation import sensitivities
from tissue_sim.errors import ConvergenceError, InputError
from tissue_sim.experiment.tools.tool import Tool
from tissue_sim.files import write_bytes
from tissue_sim.model import Model
from tissue_sim.parameters import list_field_declarations
from tissue_sim.registry import get_modules_of_additions_by_name
from tissue_sim.simulation import simulate
from tissue_sim.specimen import Specimen


class SimulatedForceOrFailure(msgspec.Struct, frozen=True, array_like=True):
    """Simulated force and its derivatives at the knots of a motion, or the reason why the simulation failed.

    Attributes:
        force: force, N, shape (k,) as a list; empty if the simulation failed.
        rates: derivatives dF/dtheta, shape (k, p) as lists.
        problem: reason of the failure; empty if the simulation converged.
        cpu_s: processor time, s.
        exact: for each parameter whether its derivative is exact; False: finite difference of two simulations.
    """

    force: list[float]
    rates: list[list[float]]
    problem: str
    cpu_s: float
    exact: list[bool] = []


class SimulationCache:
    """Cache of simulated curves in memory and in files; the key is the hash of model, motion, mesh and source code.

    Args:
        folder: folder with one file per curve; None: curves are kept in memory only.
    """

    def __init__(self, folder: Path | None = None):
        self.folder = folder
        self._read_folder = folder
        self._curves: dict[str, SimulatedForceOrFailure] = {}
        #: (test, resolution) -> number of simulations that were computed and not found in the cache.
        self.counts: Counter[tuple[str, str]] = Counter()

    def __getstate__(self):
        # A worker process reads curves from the folder and counts its own simulations.
        return {"folder": self.folder, "_read_folder": self._read_folder,
                "_curves": {} if self.folder else self._curves, "counts": Counter()}

    def find_curve(self, key: str) -> SimulatedForceOrFailure | None:
        """Return the curve with a key; None if no curve is cached or the file cannot be read."""
        if key not in self._curves and self._read_folder is not None:
            with contextlib.suppress(OSError, msgspec.DecodeError, msgspec.ValidationError):
                self._curves[key] = msgspec.msgpack.decode((self._read_folder / f"{key}.msgpack").read_bytes(),
                                                           type=SimulatedForceOrFailure)
        return self._curves.get(key)

    def store_curve(self, key: str, curve: SimulatedForceOrFailure) -> None:
        """Store a curve in memory and, if the cache has a folder, in a file."""
        self._curves[key] = curve
        if self.folder is not None:
            write_bytes(self.folder / f"{key}.msgpack", msgspec.msgpack.encode(curve))

    def make_effort_since_now_function(self) -> Callable[[], tuple[dict[tuple[str, str], int], float]]:
        """Return a function that measures the computing effort from now on.

        Returns:
            Function without arguments that returns the effort since this call: (test, resolution) -> number of computed
            simulations, and the processor time in s.
        """
        began, counted = time.process_time(), self.counts.copy()
        return lambda: (dict(self.counts - counted), time.process_time() - began)

    def set_read_folder(self, folder: Path) -> None:
        """Set the folder from which cached curves are read, in place of the previous one; nothing is written there."""
        self._read_folder = folder

    def write_curves_and_use_folder(self, folder: Path) -> None:
        """Write all curves in memory to a folder, and use it for reading and writing; old files are not deleted."""
        # The absolute path is valid in worker processes with another working directory.
        self.folder = self._read_folder = folder.resolve()
        for key, curve in self._curves.items():
            self.store_curve(key, curve)


def simulate_force_or_record_failure(model: Model, topology: Model | None, names: Sequence[str], resolution: str,
                                     solver: str = "axisymmetric", *,
                                     one_sided: bool = False) -> SimulatedForceOrFailure:
    """Simulate a model, and return its force and derivatives, or the reason of a failure instead of an exception.

    Args:
        model: model, see `tissue_sim.simulation.simulate`.
        topology: model whose mesh is moved to the geometry of `model`; None: `model` is meshed.
        names: paths of the parameters with respect to which derivatives are computed.
        resolution: name of the resolution.
        solver: name of the solver.
        one_sided: whether finite differences are one-sided, see `tissue_sim.differentiation.sensitivities`.

    Returns:
        The curve; if the simulation fails, a curve without forces and with the reason in
        `SimulatedForceOrFailure.problem`.
    """
    began = time.process_time()
    try:
        mesh = make_exact_block_mesh_or_none(topology or model, solver)
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
        return SimulatedForceOrFailure([], [], str(error), time.process_time() - began)
    return SimulatedForceOrFailure(force.tolist(), rates.tolist(), "", time.process_time() - began, exact)


def hash_content_and_source_code(*parts: Any) -> str:
    """Return a hash of immutable data and of the source code that computes a curve.

    The hash (SHA-256, 40 hexadecimal digits) covers all numbers to the last digit, the source of the package
    `tissue_sim`, and the source of registered additions (laws, effects, ...).
    """
    added = [[name, _hash_module_file_or_empty(module)] for name, module in get_modules_of_additions_by_name().items()]
    content = msgspec.json.encode([_hash_package_source(), added, _convert_to_plain_data(parts)])
    return hashlib.sha256(content).hexdigest()[:40]


def _hash_module_file_or_empty(module: ModuleType) -> str:
    """Return the SHA-256 of a module's source; empty for a module without a file, such as a notebook session."""
    file = Path(getattr(module, "__file__", None) or "")
    return hashlib.sha256(file.read_bytes()).hexdigest() if file.is_file() else ""


@cache
def _hash_package_source() -> str:
    """Return the SHA-256 of version and source of the package `tissue_sim`, which determine the curve of a model."""
    digest = hashlib.sha256(tissue_sim.__version__.encode())
    for path in sorted(Path(tissue_sim.__file__).parent.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _convert_to_plain_data(value: Any) -> Any:
    """Convert immutable data to nested lists, dictionaries and strings, from which the key of a curve is computed."""
    if isinstance(value, Tool):
        # The geometry determines the contact; the path of the tool's file does not.
        return [value.shape, _convert_to_plain_data({name: getattr(value, name)
                                                     for name in list_field_declarations(type(value))}),
                _convert_to_plain_data(value.profile)]
    if isinstance(value, Specimen) and value.paths:
        # The same holds for a specimen from a file: the digest of the file replaces its path.
        named = {value.texts[key] for key in value.paths}
        return [type(value).__name__, value.digest_of_files,
                {entry.name: _convert_to_plain_data(getattr(value, entry.name))
                 for entry in fields(value) if entry.name not in named}]
    if is_dataclass(value):
        return [type(value).__name__,
                {entry.name: _convert_to_plain_data(getattr(value, entry.name)) for entry in fields(value)}]
    if isinstance(value, np.ndarray):
        return [float(number).hex() if value.dtype.kind == "f" else str(number) for number in value.ravel()]
    if isinstance(value, Mapping):
        return {str(key): _convert_to_plain_data(item) for key, item in sorted(value.items())}
    if isinstance(value, list | tuple):
        return [_convert_to_plain_data(item) for item in value]
    if isinstance(value, float):
        return value.hex()
    return value if isinstance(value, int | str | bool | None) else str(value)
