"""Scenes of `soak`: flags of `serve`, and the same model for the replay."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import tissue_sim as ts
from scenes.commands import serve
from scenes.commands.shared.experiment_flags import make_experiment_from_flags, make_protocol_from_flags
from scenes.commands.shared.parsing import InputErrorArgumentParser

LAW = {"C10": 1404.9, "C20": 699.4}
MATERIAL = ts.Material("reduced_polynomial_2", LAW, ts.Bulk("bulk_ratio", 1e4), density=1040.0,
                       viscoelastic=ts.Prony((ts.PronyTerm(0.3, 0.5),)))
#: Largest height of a target above the tissue, m.
HIGHEST = 2e-3
#: Largest depth of a target, m: the radius of the ball, at which its ticks are in time.
DEEPEST = 8e-3
_TOOLS = (("flat", "bonded", "0"), ("flat", "0.7", "0.5"), ("flat", "0", "1"), ("flat", "stick", "0.5"),
          ("sphere", "0.3", "0"))


def draw(rng: np.random.Generator, material: Path) -> tuple[list[str], float]:
    """Draw flags of `tissue-sim serve` with a random tool and contact, and the largest depth, m."""
    shape, friction, edge = _TOOLS[rng.integers(len(_TOOLS))]
    radius = float(rng.choice([4e-3, 8e-3]))
    deepest = radius if shape == "sphere" else DEEPEST
    flags = ["--material", str(material), "--tool", shape, "--tool-radius-mm", f"{radius * 1e3:g}", "--friction",
             friction, "--depth-mm", f"{deepest * 1e3:g}"]
    return (flags if edge == "0" else [*flags, "--edge-radius-mm", edge]), deepest


def model_of(flags: list[str]) -> ts.Model:
    """Return the model that `serve` builds from these flags."""
    parser = InputErrorArgumentParser(prog="soak")
    serve.COMMAND.add_arguments(parser)
    arguments = parser.parse_args(flags)
    return ts.Model(make_experiment_from_flags(arguments, make_protocol_from_flags(arguments), MATERIAL), MATERIAL)
