"""Random plausible models: laws, sizes, tools, interfaces, motions, sometimes viscoelasticity, weight, layer or rig.

A seed stands for one model. The order in which `draw` asks for numbers is part of that, and must stay.
"""

from dataclasses import dataclass, field

import numpy as np

import tissue_sim as ts

FAMILIES = ("neo_hooke", "mooney_rivlin", "rp", "rp", "ogden", "ogden")
SCENES = ("lubricated", "bonded", "friction", "needle", "needle", "needle")
EDGES = (0.0, 0.02, 0.05, 0.1, 0.25, 0.5)
MOTIONS = {"ramp": 0.4, "unload": 0.25, "hold": 0.2, "cycles": 0.15}
#: Density, kg/m3.
DENSITY = 1000.0
#: Gravitational acceleration, m/s2.
GRAVITY = 9.81


@dataclass(frozen=True)
class Description:
    """Plain values of the random model of a seed.

    Attributes:
        seed: of it.
        family: of the law; law, parameters: as `ts.Material` takes them, SI.
        E0: initial Young's modulus, Pa; ratio: K over mu0.
        radius, height: of the specimen, m.
        scene: "lubricated", "bonded" or "friction" plates, or "needle"; shape: of the tool; face: its interface.
        options: of `ts.Experiment`, with the tool as options of `ts.Tool`.
        protocol: text; motion: which of `MOTIONS`; points: samples of each segment that moves; depth: m.
        extra: "prony" [(g, s)], "weight" True, "layer" (m, ratio), "rig" options of `ts.Rig`.
    """

    seed: int
    family: str
    law: str
    parameters: dict[str, float]
    E0: float
    ratio: float
    radius: float
    height: float
    scene: str
    shape: str
    face: str
    options: dict
    protocol: str
    motion: str
    points: int
    depth: float
    extra: dict = field(default_factory=dict)


def _between(chance: np.random.Generator, low: float, high: float) -> float:
    """Draw from a log-uniform distribution."""
    return float(np.exp(chance.uniform(np.log(low), np.log(high))))


def _law(chance: np.random.Generator, family: str, mu: float) -> tuple[str, dict[str, float]]:
    """Return name and parameters of a law of initial shear modulus mu, Pa; Mooney-Rivlin splits the modulus."""
    if family == "neo_hooke":
        return family, {"C10": mu / 2}
    if family == "mooney_rivlin":
        share = chance.uniform(0.05, 0.6)
        return family, {"C10": mu / 2 * (1 - share), "C01": mu / 2 * share}
    if family == "rp":
        order = int(chance.integers(2, 4))
        parameters = {"C10": mu / 2, "C20": mu / 2 * chance.uniform(0, 0.6)}
        if order == 3:
            parameters["C30"] = mu / 2 * chance.uniform(0, 0.3)
        return f"reduced_polynomial_{order}", parameters
    terms = int(chance.choice([1, 1, 2, 3]))
    exponents = [float(chance.choice([chance.uniform(-18, -2), chance.uniform(2, 15)])) for _ in range(terms)]
    shares = chance.dirichlet(np.ones(terms) * 3)
    parameters = {}
    for i, (share, exponent) in enumerate(zip(shares, exponents, strict=True), start=1):
        parameters |= {f"mu{i}": mu * share, f"alpha{i}": exponent}
    return f"ogden_{terms}", parameters


def _needle(chance: np.random.Generator, radius: float, height: float) -> tuple[dict, str, str, float, float]:
    """Return options of the experiment, shape and face, radius of the tool (m) and depth (m)."""
    shape = str(chance.choice(["flat", "flat", "round", "sphere", "cone"]))
    a = float(chance.uniform(1, min(15, 0.5 * radius * 1e3))) * 1e-3
    faces = ["bonded"] * (shape == "flat") + ["stick", "frictionless", "mu"]
    face = str(chance.choice(faces))
    friction = _between(chance, 0.05, 1.0) if face == "mu" else face
    tool = {"shape": shape, "radius": a}
    if shape == "flat":
        edge = float(chance.choice(EDGES))
        if face not in ("bonded", "stick") and edge == 0:
            edge = float(chance.choice(EDGES[1:]))
        tool["edge_radius"] = edge * a
    elif shape == "cone":
        tool["half_angle"] = float(np.radians(chance.uniform(25, 80)))
        tool["tip_radius"] = float(chance.choice([0, 0.05, 0.1, 0.2])) * a
    wall: str | float = "frictionless"
    if shape != "sphere":
        wall = ["frictionless", "frictionless", "frictionless", "stick", 0.3][int(chance.integers(5))]
    base = ["bonded", "bonded", "frictionless", 0.3][int(chance.integers(4))]
    depth = min(float(chance.uniform(0.3, 1.5)) * a, 0.35 * height)
    return {"tool": tool, "friction": friction, "friction_wall": wall, "friction_base": base}, shape, face, a, depth


def _motion(chance: np.random.Generator, depth: float) -> tuple[str, str, int]:
    """Draw a motion: its name, its protocol as text, and the number of samples of each segment."""
    points, mm = int(chance.choice([11, 16, 21])), depth * 1e3
    speed = f"@{_between(chance, 0.05, 5.0):.4g}mm/s"
    motion = str(chance.choice(list(MOTIONS), p=list(MOTIONS.values())))
    whole = f"ramp {mm:.6g}mm {speed}"
    text = {"ramp": whole, "unload": f"{whole}; unload", "hold": f"{whole}; hold 20s; unload",
            "cycles": f"ramp {mm * 0.6:.6g}mm {speed}; unload; ramp {mm:.6g}mm; unload; reload; unload"}[motion]
    return motion, text, points


def draw(seed: int) -> Description:
    """Return the description of the model of a seed."""
    chance = np.random.default_rng(seed)
    family = str(chance.choice(FAMILIES))
    E0 = _between(chance, 1e3, 1e5)
    law, parameters = _law(chance, family, E0 / 3)
    ratio = _between(chance, 20.0, 1e5)
    while True:
        radius, height = float(chance.uniform(5, 60)) * 1e-3, float(chance.uniform(3, 100)) * 1e-3
        if 0.2 <= radius / height <= 5:
            break
    scene = str(chance.choice(SCENES))
    a = None
    if scene == "needle":
        options, shape, face, a, depth = _needle(chance, radius, height)
    else:
        depth = float(chance.uniform(0.05, 0.3)) * height
        friction = {"lubricated": "frictionless", "bonded": "bonded"}.get(scene) or _between(chance, 0.05, 1.0)
        options = {"tool": {"shape": "plate"}, "friction": friction, "friction_base": friction}
        shape, face = "plate", "mu" if scene == "friction" else scene
    motion, text, points = _motion(chance, depth)
    extra: dict = {}
    if chance.random() < 0.25:
        count = int(chance.integers(1, 3))
        extra["prony"] = [(float(chance.uniform(0.05, 0.35)), _between(chance, 0.1, 50.0)) for _ in range(count)]
    # Not what would sink by more than a tenth or so; the number is drawn either way.
    if chance.random() < 0.12 and DENSITY * GRAVITY * height / E0 / 2 < 0.1:
        extra["weight"] = True
    if chance.random() < 0.15:
        extra["layer"] = float(chance.uniform(0.05, 0.4)) * height, _between(chance, 0.2, 8.0)
    if chance.random() < 0.15:
        stiffness = E0 * np.pi * radius * radius / height if a is None else 8 / 3 * E0 * a
        extra["rig"] = {"compliance": float(chance.uniform(0.02, 0.5)) / stiffness,
                        "contact_offset": float(chance.uniform(-0.05, 0.1)) * depth,
                        "backlash": float(chance.uniform(0, 0.02)) * depth,
                        "displacement_gain": float(chance.uniform(-0.02, 0.02))}
    return Description(seed, family, law, parameters, E0, ratio, radius, height, scene, shape, face, options, text,
                       motion, points, depth, extra)


def build(one: Description, finer: int = 1, size: float = 1.0, strength: float = 1.0) -> ts.Model:
    """Return the model of a description.

    Args:
        one: the description.
        finer: how many times as many samples there are.
        size: factor of all lengths; strength: factor of all stresses. For powers of two without rounding.
    """
    extra, options = one.extra, dict(one.options)
    law = ts.find_law(one.law)
    parameters = {name: value * strength if law.units[name] == "Pa" else value
                  for name, value in one.parameters.items()}
    viscoelastic = None
    if "prony" in extra:
        viscoelastic = ts.Prony(tuple(ts.PronyTerm(share, time) for share, time in extra["prony"]))
    layers = ()
    if "layer" in extra:
        thickness, ratio = extra["layer"]
        layers = (ts.Layer(thickness * size, ratio),)
    material = ts.Material(one.law, parameters, ts.Bulk("bulk_ratio", one.ratio), viscoelastic=viscoelastic,
                           layers=layers)
    options["tool"] = ts.Tool(**{name: value * size if name in ("radius", "edge_radius", "tip_radius") else value
                                 for name, value in options["tool"].items()})
    weight = {"density": DENSITY * strength / size, "gravity": GRAVITY} if "weight" in extra else {}
    protocol = ts.Protocol.parse(one.protocol, points=(one.points - 1) * finer + 1)
    if size != 1.0:
        protocol = ts.Protocol(protocol.time, protocol.displacement * size, protocol.segment, protocol.cycle)
    experiment = ts.Experiment(ts.Specimen(one.radius * size, one.height * size, **weight), protocol, **options)
    return ts.Model(experiment, material, ts.Rig(**extra["rig"]) if "rig" in extra else ts.Rig())
