"""Scenes of the generator of motions: model, solver, and the construction of a simulator."""

from __future__ import annotations

import functools
import hashlib
import math
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from delayed_bulk import DelayedBulkLink

import tissue_sim as ts
from haptics.loop.multirate import MultiRateTissue
from tissue_sim.fem.solid.discretisation import make_solver
from tissue_sim.fem.solid.linearisation import SolidLineariser
from tissue_sim.mesh.solid import SolidMesh, create_cylinder_mesh_under_needle
from tissue_sim.mesh.solid_element import HEX8P0

#: Version of the cached reduced models; raise it when their scenes or their training change.
REDUCED_VERSION = 4
#: Radius and height of the specimen of spatial scenes, m.
SPATIAL_SPECIMEN = (0.030, 0.020)
#: Radius of the tool of spatial scenes, m.
SPATIAL_TOOL_RADIUS = 8e-3
#: Largest depth of spatial scenes, m.
SPATIAL_DEPTH = 2e-3


@dataclass(frozen=True)
class Scene:
    """Model, solver and mesh of a motion.

    Attributes:
        solver: "axisymmetric", "solid", "reduced" or "multirate".
        shape, radius, friction, tool_options: of the tool, SI, and its interface.
        law, parameters, bulk_ratio: of the material.
        prony: (g, tau in s) of each term.
        specimen: radius and height, m.
        depth: largest depth of a motion, m.
        resolution: of the axisymmetric mesh.
        inertia: "off", "auto" or "on".
        max_solves: bound of a step; None: no bound.
        delay, tangent: of the models of a multirate scene, s; `tangent` None: each model has its own.
    """

    solver: str
    shape: str
    radius: float
    friction: str | float
    law: str = "neo_hooke"
    parameters: tuple[tuple[str, float], ...] = (("C10", 2000.0),)
    bulk_ratio: float = 1e3
    prony: tuple[tuple[float, float], ...] = ()
    specimen: tuple[float, float] = (0.040, 0.040)
    depth: float = 3e-3
    resolution: str = "realtime_20"
    inertia: str = "off"
    max_solves: int | None = None
    delay: float = 0.0
    tangent: float | None = None
    tool_options: tuple[tuple[str, float], ...] = ()

    @property
    def is_elastic(self) -> bool:
        """True if the material has no viscoelastic terms."""
        return not self.prony

    @property
    def is_bonded(self) -> bool:
        """True if the tissue is bonded to the tool."""
        return self.friction == "bonded"

    @property
    def has_friction(self) -> bool:
        """True if the force depends on the path of the tool."""
        return self.friction not in ("bonded", "frictionless")

    @property
    def name(self) -> str:
        """Solver, tool, interface, viscoelasticity and inertia in words."""
        friction = self.friction if isinstance(self.friction, str) else f"mu {self.friction:.2f}"
        parts = [self.solver, self.shape, friction, self.law]
        parts += ["viscoelastic"] * bool(self.prony)
        parts += [f"inertia {self.inertia}"] if self.solver == "axisymmetric" else []
        parts += [f"max_solves {self.max_solves}"] * bool(self.max_solves)
        parts += [f"delay {self.delay:g} s"] if self.solver == "multirate" else []
        return ", ".join(parts)

    def model(self) -> ts.Model:
        """Model of the scene."""
        terms = tuple(ts.PronyTerm(g=g, tau=tau) for g, tau in self.prony)
        material = ts.Material(self.law, dict(self.parameters), ts.Bulk("bulk_ratio", self.bulk_ratio),
                               viscoelastic=ts.Prony(terms) if terms else None)
        is_plate = self.shape == "plate"
        tool = ts.Tool("plate") if is_plate else ts.Tool(self.shape, radius=self.radius, **dict(self.tool_options))
        experiment = ts.Experiment(ts.Specimen(*self.specimen), ts.Protocol.ramp(self.depth, 2), tool=tool,
                                   friction=self.friction)
        return ts.Model(experiment, material)


def scaled_parameters(scene: Scene, factor: float) -> dict[str, float]:
    """Return the parameters of the law with all moduli times a factor, which scales all elastic forces."""
    units = ts.find_law(scene.law).units
    return {name: value * factor if units[name] == "Pa" else value for name, value in scene.parameters}


@functools.cache
def coarse_mesh() -> SolidMesh:
    """Return the coarsest mesh of the spatial scenes on which a ball can slide: 196 nodes."""
    return create_cylinder_mesh_under_needle(*SPATIAL_SPECIMEN, SPATIAL_TOOL_RADIUS, HEX8P0,
                                             smallest=0.45 * SPATIAL_TOOL_RADIUS,
                                             growth=2.4, largest=3.0 * SPATIAL_TOOL_RADIUS, around=2)


@functools.cache
def ball_mesh() -> SolidMesh:
    """A mesh that is as fine under a ball at the largest depth as the estimated faceting error of its force requires:
    847 nodes."""
    return create_cylinder_mesh_under_needle(*SPATIAL_SPECIMEN, SPATIAL_TOOL_RADIUS, HEX8P0,
                                             smallest=0.25 * SPATIAL_TOOL_RADIUS,
                                             growth=2.4, largest=3.0 * SPATIAL_TOOL_RADIUS, around=4)


def solid_mesh(scene: Scene) -> SolidMesh:
    """Return the mesh of a whole 3D solid."""
    return coarse_mesh() if scene.is_bonded or scene.solver == "multirate" else ball_mesh()


@functools.cache
def reduced_model(scene: Scene) -> ts.ReducedModel:
    """Return the reduced model of a scene, cached in the folder for temporary files."""
    label = f"{REDUCED_VERSION} {ts.__version__} {scene!r}"
    path = Path(tempfile.gettempdir()) / f"motions_{hashlib.sha256(label.encode()).hexdigest()[:16]}.reduced.npz"
    if path.exists():
        return ts.load_reduced(path)
    box = ts.PoseBox(1.5e-3, scene.depth, math.radians(5.0) if scene.is_bonded else 0.0)
    strokes, modes = (4, 12) if scene.is_bonded else (8, 24)
    made = ts.reduce_solid(scene.model(), box, strokes=strokes, modes=modes, tried=1)
    ts.write_reduced(made, path)
    return made


def simulator(scene: Scene, *, bounded: bool = True, mesh: SolidMesh | None = None) -> ts.Simulator:
    """Return a new, compiled simulator of a scene.

    Args:
        scene: the scene, not multirate.
        bounded: whether its `max_solves` holds.
        mesh: of a whole solid; None: that of the scene.
    """
    given: dict[str, Any] = {"inertia": scene.inertia, "max_solves": scene.max_solves if bounded else None}
    if scene.solver == "axisymmetric":
        made = ts.Simulator(scene.model(), resolution=scene.resolution, **given)
    elif scene.solver == "reduced":
        reduced = reduced_model(scene)
        made = ts.Simulator(reduced.model, solver="reduced", mesh=reduced, **given)
    else:
        made = ts.Simulator(scene.model(), solver="solid", mesh=mesh or solid_mesh(scene), **given)
    made.warm_up()
    return made


def multirate(scene: Scene) -> MultiRateTissue:
    """Return a new multirate simulator of a scene with a fixed simulated delay of its models."""
    model = scene.model()
    bulk = SolidLineariser(make_solver(model, mesh=coarse_mesh()))
    tissue = MultiRateTissue(model, link=DelayedBulkLink(bulk, scene.delay, scene.tangent))
    tissue.warm_up()
    return tissue


def tissue_of(scene: Scene) -> Any:
    """Return the tested simulator: a `Simulator` or a `MultiRateTissue`."""
    return multirate(scene) if scene.solver == "multirate" else simulator(scene)


def _material(chance: np.random.Generator) -> dict[str, Any]:
    """Draw law and parameters with an initial shear modulus of 1.5 to 12 kPa."""
    mu = float(np.exp(chance.uniform(math.log(1.5e3), math.log(12e3))))
    law = str(chance.choice(["neo_hooke", "reduced_polynomial_2", "mooney_rivlin"], p=[0.5, 0.3, 0.2]))
    parameters = {"neo_hooke": (("C10", mu / 2),),
                  "reduced_polynomial_2": (("C10", mu / 2), ("C20", mu / 2 * float(chance.uniform(0.0, 0.5)))),
                  "mooney_rivlin": (("C10", 0.35 * mu), ("C01", 0.15 * mu))}[law]
    return {"law": law, "parameters": parameters, "bulk_ratio": float(chance.choice([1e3, 1e4]))}


def axisymmetric_scene(chance: np.random.Generator, *, elastic: bool = False, inertia: str | None = None,
                       lifts: bool = False) -> Scene:
    """Draw an axisymmetric scene.

    Args:
        chance: source of random numbers.
        elastic: no viscoelastic terms.
        inertia: the choice of inertia; None: random.
        lifts: only tools that can lift off.
    """
    tools = [("flat", "bonded"), ("flat", "bonded"), ("plate", "bonded")] * (not lifts)
    tools += [("flat", "stick"), ("flat", "mu"), ("round", "mu"), ("round", "frictionless"), ("round", "mu"),
              ("sphere", "mu"), ("sphere", "frictionless"), ("plate", "mu"), ("plate", "frictionless")]
    shape, friction = tools[int(chance.integers(len(tools)))]
    radius = float(chance.uniform(4e-3, 9e-3))
    specimen = float(chance.uniform(0.030, 0.040)), float(chance.uniform(0.025, 0.060))
    options = (("edge_radius", 0.2 * radius),) if shape == "flat" and friction not in ("bonded", "stick") else ()
    prony: tuple[tuple[float, float], ...] = ()
    if not elastic and chance.random() < 0.4:
        prony = tuple((float(chance.uniform(0.1, 0.35)), float(np.exp(chance.uniform(math.log(0.01), math.log(2.0)))))
                      for _ in range(int(chance.integers(1, 3))))
    depth = 0.05 * specimen[1] if shape == "plate" else float(chance.uniform(0.3, 0.6)) * radius
    inertia = inertia or str(chance.choice(["off", "auto", "on"], p=[0.5, 0.3, 0.2]))
    slides = friction == "frictionless" and shape == "flat"
    return Scene("axisymmetric", shape, radius, float(chance.uniform(0.1, 0.6)) if friction == "mu" else friction,
                 prony=prony, specimen=specimen, depth=depth, inertia=inertia, tool_options=options,
                 resolution="realtime_63" if slides else str(chance.choice(["realtime_20", "realtime_35"])),
                 **_material(chance))


#: Tools and interfaces of spatial scenes.
_SPATIAL_TOOLS = (("flat", "bonded"), ("round", 0.3), ("round", "frictionless"))


def spatial_scene(chance: np.random.Generator, *, solver: str | None = None, bonded: bool | None = None) -> Scene:
    """Draw a 3D solid: a coarse whole one, or one of two reduced ones.

    Args:
        chance: source of random numbers.
        solver: "solid" or "reduced"; None: random.
        bonded: whether the tool holds the tissue; None: random.
    """
    solver = solver or str(chance.choice(["solid", "reduced"], p=[0.4, 0.6]))
    choices = [each for each in _SPATIAL_TOOLS if bonded is None or (each[1] == "bonded") == bonded]
    if solver == "reduced":
        choices = [each for each in choices if each[1] != "frictionless"]
    shape, friction = choices[int(chance.integers(len(choices)))]
    scene = Scene(solver, shape, SPATIAL_TOOL_RADIUS, friction, specimen=SPATIAL_SPECIMEN, depth=SPATIAL_DEPTH)
    if solver == "solid" and chance.random() < 0.3:
        return replace(scene, prony=((0.3, 0.05),))
    return scene


def multirate_scene(chance: np.random.Generator, *, bonded: bool | None = None, slow: bool = False) -> Scene:
    """Draw a multirate scene.

    Args:
        chance: source of random numbers.
        bonded: whether the tool holds the tissue; None: random.
        slow: models that come 0.1 to 0.5 s late; else 4 to 20 ms.
    """
    choices = [each for each in _SPATIAL_TOOLS if bonded is None or (each[1] == "bonded") == bonded]
    shape, friction = choices[int(chance.integers(len(choices)))]
    delay = float(chance.choice([0.1, 0.2, 0.5])) if slow else float(chance.choice([0.004, 0.006, 0.010, 0.016]))
    tangent = None if slow else 5.0 * delay
    return Scene("multirate", shape, SPATIAL_TOOL_RADIUS, friction, specimen=SPATIAL_SPECIMEN, depth=SPATIAL_DEPTH,
                 delay=delay, tangent=tangent)
