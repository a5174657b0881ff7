"""True curves of the hidden-effect study: readings without noise.

Plain curves are those of independent programs in tests/reference and, under lubricated plates, the closed form, written
out here once more. What transforms a curve (rigs, tilt, slip, puncture, relaxation on the force) is written here, too,
and never taken from the packages. What bulges onto the plates beyond 6.5 mm, which the independent program leaves out,
is added from our finite elements. What needs a field (layers, friction, gravity, other laws, relaxing tissue) comes
from our finite elements on finer meshes than any diagnosis uses: "same solver" in the tables.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator

import tissue_sim as ts
from benchmarks import ROOT
from tissue_sim.errors import ConvergenceError
from tissue_sim.material.material import with_changed_or_added_parameters
from tissue_sim.mesh.axisymmetric import (
    cylinder_mesh,
    cylinder_mesh_refined_under_needle,
    insert_interfaces_and_refine_layers,
    structured_mesh,
)
from tissue_sim.mesh.elements import Q9P1

REFERENCE = ROOT / "tests" / "reference"
#: Of computed curves, by what they were computed from. Another study may share it; delete it freely.
CACHE = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "tissue_sim" / "hidden_effects"
#: Pa, of the reference study.
C10 = 1404.9
#: Pa, of the reference study.
C20 = 699.4
#: Radius of the specimen, m.
RADIUS = 0.040
#: Height of the specimen, m.
HEIGHT = 0.070
#: Radius of the needle, m.
NEEDLE = 0.008
#: Depth of a test, m.
DEPTH = 10e-3
#: Speed of the reference study, m/s.
SLOW = 0.248e-3
#: Ten times the slow speed, m/s.
FAST = 2.48e-3
#: Speed between both, m/s.
BETWEEN = 0.79e-3
#: Duration of a hold, s.
HOLD = 60.0
#: Up to this depth the bulge between bonded plates does not touch them, m.
FREE = 6.5e-3
#: K / mu of all truths; exact incompressibility would move no force by more than 0.01 %.
BULK_RATIO = 1e4
_STORED = {"B": "bonded_RP.csv", "C": "punch_bonded_face_side_wall_RP.csv"}
#: Knots of a simulation along the path of the tool.
_WAY = 41
#: Knots of a simulation in a hold.
_HOLD = 25
#: Smallest element at the needle's edge, m, growth and largest, m; elements of the cylinder and their grading. The
#: catalogue's refits use 80 and 48 elements, and learn the mesh error from 468 and 320.
_NEEDLE_MESH = {"smallest": 0.04e-3, "growth": 1.4, "largest": 8e-3}
#: Where an element folds at the edge: coarser there, finer elsewhere.
_NEEDLE_EDGE = {"smallest": 0.15e-3, "growth": 1.3, "largest": 6e-3}
_PLATE_MESH = {"elements": (22, 28), "grading": (150.0, 25.0)}
_LAYER_ELEMENTS = 6
#: Prefixes of parameters of effects that depend on time.
_AGES = ("viscoelastic.", "poroelasticity.")
#: Prefixes of parameters of effects that depend on the path only.
_REMEMBERS = ("softening.", "experiment.friction")
_VERSION = 1


@dataclass(frozen=True)
class VirtualTest:
    """A test of the study.

    Attributes:
        name: in the campaign. kind: A lubricated plates, B bonded plates, C needle. speed: m/s.
        returns: whether a hold and a return follow the ramp. rate: Hz. held_out: whether no fit sees it.
        specimen: number of it. contact: where the tissue begins, m of what is reported; the curves leave it out, what
            happens at a depth of the tissue does not.
    """

    name: str
    kind: str
    speed: float
    returns: bool
    rate: float
    held_out: bool = False
    specimen: int = 0
    contact: float = 0.0

    @property
    def depth(self) -> np.ndarray:
        """Depth of the tool in the tissue, m."""
        return self.displacement - self.contact

    @property
    def ramp(self) -> float:
        """Duration of loading, s."""
        return DEPTH / self.speed

    @property
    def corners(self) -> tuple[list[float], list[float]]:
        """Times (s) and displacements (m) of the corners of the motion."""
        if not self.returns:
            return [0.0, self.ramp], [0.0, DEPTH]
        return [0.0, self.ramp, self.ramp + HOLD, 2 * self.ramp + HOLD], [0.0, DEPTH, DEPTH, 0.0]

    @cached_property
    def time(self) -> np.ndarray:
        """Times of the samples, s; corners of the motion are samples."""
        corners = self.corners[0]
        return np.unique(np.concatenate([np.linspace(start, end, max(2, round((end - start) * self.rate) + 1))
                                         for start, end in itertools.pairwise(corners)]))

    @cached_property
    def displacement(self) -> np.ndarray:
        return np.interp(self.time, *self.corners)

    @cached_property
    def direction(self) -> np.ndarray:
        """1 during loading, 0 at the first sample and in the hold, -1 during unloading; a corner belongs to what ends
        there."""
        answer = np.zeros(self.time.size)
        answer[(self.time > 0) & (self.time <= self.ramp)] = 1.0
        answer[self.time > self.ramp + HOLD] = -1.0
        return answer


def ramps() -> tuple[VirtualTest, ...]:
    """Return the tests of the basic protocol: loading only."""
    return tuple(VirtualTest(kind, kind, SLOW, False, 10.0) for kind in "ABC")


def full() -> tuple[VirtualTest, ...]:
    """Return tests with ramp, hold and return at two speeds, and a held-out compression at a third speed."""
    return (*(VirtualTest(kind, kind, SLOW, True, 4.0) for kind in "ABC"),
            *(VirtualTest(f"{kind}_fast", kind, FAST, True, 10.0) for kind in "ABC"),
            VirtualTest("A_unseen", "A", BETWEEN, True, 4.0, held_out=True))


def animals() -> tuple[VirtualTest, ...]:
    """Return compression and needle tests on four specimens, loading only, for scatter between specimens."""
    return tuple(VirtualTest(f"{kind}{number + 1}", kind, SLOW, False, 5.0, specimen=number)
                 for number in range(4) for kind in "AC")


PROTOCOLS = {"ramps": ramps, "full": full, "animals": animals}


def lubricated(depth: np.ndarray, values: Mapping[str, float] | None = None, radius: float = RADIUS,
               height: float = HEIGHT) -> np.ndarray:
    """Return the force of Biderman's incompressible law between lubricated plates, N: F = A dW/dlambda."""
    given = {"C10": C10, "C20": C20, **(values or {})}
    stretch = 1.0 - np.asarray(depth) / height
    excess = stretch**2 + 2.0 / stretch - 3.0
    first = given["C10"] + 2.0 * given["C20"] * excess + 3.0 * given.get("C30", 0.0) * excess**2
    second = given.get("C01", 0.0)
    return -np.pi * radius**2 * 2.0 * (stretch - stretch**-2) * (first + second / stretch)


@cache
def stored(kind: str) -> CubicSpline:
    """Return the force over depth of an independent program, N and m."""
    if kind == "A":
        depth = np.linspace(0.0, 1.06 * DEPTH, 107)
        return CubicSpline(depth, lubricated(depth))
    depth, force = np.loadtxt(REFERENCE / _STORED[kind], delimiter=",", skiprows=2).T
    return CubicSpline(depth * 1e-3, force)


def plain(kind: str, depth: np.ndarray) -> np.ndarray:
    """Force of the study's specimen without any effect, N; 0 in the air. A curve ends at 10 mm and is continued."""
    force = stored(kind)(np.maximum(depth, 0.0))
    if kind == "B":
        force = force + np.interp(depth, *_bulge())
    return np.where(depth > 0, force, 0.0)


def moved(test: VirtualTest, place: np.ndarray) -> np.ndarray:
    """Plain force of a test whose tool is elsewhere than is reported, N: nothing before it touches, and what is bonded
    to it pulls when it comes back past that."""
    force = plain(test.kind, place)
    if test.kind == "A":
        return force
    pulled = (place < 0) & (test.direction < 0)
    return np.where(pulled, -plain(test.kind, -place), force)


@cache
def _bulge() -> tuple[np.ndarray, np.ndarray]:
    """Depth, m, and what the tissue adds that bulges onto the plates, N: the independent program leaves it out."""
    test = VirtualTest("B", "B", SLOW, False, 10.0)
    beyond = test.displacement > FREE
    added = simulated(test, {}) - stored("B")(test.displacement)
    at_touch = np.interp(FREE, test.displacement, added)
    return test.displacement, np.where(beyond, added - at_touch, 0.0)


def model_of(kind: str, time: np.ndarray, displacement: np.ndarray, values: Mapping[str, float],
             law: Mapping[str, float] | None = None) -> ts.Model:
    """Return a model of the study.

    Args:
        kind: of the test. values: path -> value, SI, of all parts other than the law. law: numbers of Biderman's; None:
            the study's reduced polynomial.
    """
    tool = ts.Tool("flat", NEEDLE) if kind == "C" else ts.Tool("plate")
    held = "frictionless" if kind == "A" else "bonded"
    specimen = ts.Specimen(values.get("radius", RADIUS), values.get("height", HEIGHT), density=1000.0)
    experiment = ts.Experiment(specimen, ts.Protocol(time, displacement), tool, friction=held, friction_base=held)
    numbers = {"C10": C10, "C20": C20}
    material = ts.Material("reduced_polynomial_2", numbers, ts.Bulk("bulk_ratio", BULK_RATIO)) if law is None else \
        ts.Material("biderman", {"C01": 0.0, "C30": 0.0, **numbers, **law}, ts.Bulk("bulk_ratio", BULK_RATIO))
    others = {path: value for path, value in values.items() if "." in path}
    around = {path: value for path, value in others.items() if path.startswith("experiment.")}
    within = {path: value for path, value in others.items() if path not in around}
    model = ts.Model(experiment, with_changed_or_added_parameters(material, within) if within else material, ts.Rig())
    return ts.with_values(model, around) if around else model


def fine_mesh(model: ts.Model, needle: Mapping[str, float]):
    """A finer mesh than any that a diagnosis uses, or None where every mesh is exact; `needle`: sizes at a needle."""
    experiment, specimen = model.experiment, model.experiment.specimen
    layers = model.material.layers
    if experiment.has_homogeneous_deformation and not layers and not specimen.gravity:
        return None
    if experiment.tool.face_radius:
        sizes = dict(needle)
        sizes["smallest"] = max(sizes["smallest"], 0.15 * experiment.tool.edge_radius)
        mesh = cylinder_mesh_refined_under_needle(specimen.radius, specimen.height, experiment.tool.face_radius, Q9P1,
                                                  **sizes)
    else:
        mesh = cylinder_mesh(specimen.radius, specimen.height, _PLATE_MESH["elements"], Q9P1,
                             grading=_PLATE_MESH["grading"])
    if not layers:
        return mesh
    corners = mesh.nodes[mesh.connectivity[:, :4]].reshape(-1, 2)
    r, z = np.unique(corners[:, 0]), np.unique(corners[:, 1])
    interfaces = (-np.cumsum([layer.thickness for layer in layers])).tolist()
    layered = structured_mesh(r, insert_interfaces_and_refine_layers(z, interfaces, _LAYER_ELEMENTS), Q9P1)
    top, old = layered.sets["top"], mesh.sets["top"]
    faces = {name: top[np.isin(old, nodes)] for name, nodes in mesh.sets.items() if name in ("face", "free")}
    return replace(layered, sets={**layered.sets, **faces})


def _knots(test: VirtualTest) -> np.ndarray:
    """Return the times of a simulation, s."""
    corners = test.corners[0]
    parts = [np.linspace(corners[0], corners[1], _WAY)]
    if test.returns:
        parts += [corners[1] + np.geomspace(0.02, HOLD, _HOLD), np.linspace(corners[2], corners[3], _WAY)]
    return np.unique(np.concatenate([corners, *parts]))


def simulated(test: VirtualTest, values: Mapping[str, float], law: Mapping[str, float] | None = None) -> np.ndarray:
    """Return the force of a test by the finite elements on a fine mesh, N; results are cached on disk.

    A model without memory is simulated for loading only, a model with memory at one speed.

    Raises:
        ConvergenceError: it does not get through.
    """
    if any(path.startswith(_AGES) for path in values):
        return _between_knots(test, test, _solved(test, values, law), test.time)
    remembers = test.returns and any(path.startswith(_REMEMBERS) for path in values)
    solved = VirtualTest(test.kind, test.kind, SLOW, remembers, test.rate)
    force = _solved(solved, values, law)
    if not remembers:
        return CubicSpline(np.interp(_knots(solved), *solved.corners), force)(test.displacement)
    # The same place on the way, at the speed that was simulated.
    return _between_knots(solved, test, force, np.interp(test.time, test.corners[0], solved.corners[0]))


def _solved(test: VirtualTest, values: Mapping[str, float], law: Mapping[str, float] | None) -> np.ndarray:
    """Return the force at the knots of a test, N."""
    values, knots = dict(sorted(values.items())), _knots(test)
    key = json.dumps([_VERSION, test.kind, test.speed, test.returns, values, dict(sorted((law or {}).items()))
                      if law is not None else None, _NEEDLE_MESH, _PLATE_MESH, _WAY, _HOLD, DEPTH, HOLD])
    file = CACHE / f"{hashlib.sha256(key.encode()).hexdigest()[:24]}.npy"
    if file.exists():
        return np.load(file)
    model = model_of(test.kind, knots, np.interp(knots, *test.corners), values, law)
    try:
        force = ts.simulate(model, resolution="accurate", mesh=fine_mesh(model, _NEEDLE_MESH)).force
    except ConvergenceError:
        if test.kind != "C":
            raise
        force = ts.simulate(model, resolution="accurate", mesh=fine_mesh(model, _NEEDLE_EDGE)).force
    CACHE.mkdir(parents=True, exist_ok=True)
    partial = file.with_suffix(f".{os.getpid()}.npy")
    np.save(partial, force)
    partial.replace(file)
    return force


def _between_knots(solved: VirtualTest, test: VirtualTest, force: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Interpolate the force of a simulation, N, segment by segment, so that no curve crosses a corner."""
    knots, corners, answer = _knots(solved), solved.corners[0], np.empty(test.time.size)
    for part, (start, end) in enumerate(itertools.pairwise(corners)):
        here, there = (knots >= start) & (knots <= end), (time >= start) & (time <= end)
        # In a hold the force has a kink that a cubic spline would swing about.
        curve = PchipInterpolator if part == 1 else CubicSpline
        answer[there] = curve(knots[here], force[here])(time[there])
    return answer


def difference(test: VirtualTest, values: Mapping[str, float], law: Mapping[str, float] | None = None) -> np.ndarray:
    """Return the force of a test with an effect, N: the independent curve plus the simulated change by the effect."""
    return plain(test.kind, test.displacement) + simulated(test, values, law) - simulated(test, {})


def hereditary(test: VirtualTest, force: np.ndarray, relaxation) -> np.ndarray:
    """Return the force by Fung's quasi-linear viscoelasticity: F(t) = integral of G(t - s) dF_e(s).

    Args:
        force: elastic, at the samples of the test. relaxation: t -> G, with G(0) = 1.
    """
    # On a fine even clock, each step of the elastic force spread over its interval.
    steps = 8 * round(test.time[-1] * test.rate) if test.speed < FAST else 16 * round(test.time[-1] * test.rate)
    clock = np.linspace(0.0, test.time[-1], steps + 1)
    elastic = np.interp(clock, test.time, force)
    # What is lost alone, so that corners between two beats of the clock stay where they are.
    lost = 1.0 - relaxation(0.5 * (clock[1:] + clock[:-1]))
    answer = np.concatenate([[0.0], np.convolve(np.diff(elastic), lost)[:steps]])
    return force - np.interp(test.time, clock, answer)
