"""The rig of the command line, and its readings of one simulation: replicates that differ in their noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from scenes.commands.shared.parsing import Parser, at_least, not_negative
from tissue_sim.errors import InputError

if TYPE_CHECKING:
    from tissue_sim import Recording, Rig

MOST_REPLICATES = 1000


def add_rig_flags(parser: Parser) -> None:
    """The rig file, noise, replicates and seed."""
    rig = parser.add_argument_group("rig")
    rig.add_argument("--rig", type=Path, metavar="FILE",
                     help="NAME.rig.json, what load frame and sensor do (default: nothing)")
    rig.add_argument("--noise-N", type=not_negative, metavar="N",
                     help="standard deviation of the force noise, in place of the rig's own")
    rig.add_argument("--replicates", type=at_least(1, MOST_REPLICATES), metavar="N",
                     help="recordings with noise of their own; -o CURVE.csv writes CURVE_1.csv, CURVE_2.csv, ...")
    rig.add_argument("--seed", type=at_least(0), metavar="N",
                     help="of the noise; the same seed gives the same files (default: that of the rig file, or 0)")


def make_rig(arguments) -> Rig:
    """The rig of ``--rig`` with the noise and the seed of the flags.

    Raises:
        InputError: a damaged file, or replicates or a seed where there is no noise.
    """
    from tissue_sim.rig.file import load_rig
    from tissue_sim.rig.rig import Rig

    rig = Rig() if arguments.rig is None else load_rig(arguments.rig)
    if arguments.noise_N is not None:
        rig = replace(rig, force_noise=arguments.noise_N)
    if not rig.force_noise:
        for flag, value in (("--replicates", arguments.replicates), ("--seed", arguments.seed)):
            if value is not None:
                raise InputError("counts only where there is noise; add --noise-N 0.02 or a rig with force_noise_N",
                                 field=flag)
    return rig if arguments.seed is None else replace(rig, seed=arguments.seed)


def output_files(curve: Path | None, replicates: int | None) -> list[Path]:
    """Files of the recordings: CURVE.csv, or CURVE_1.csv and so on where replicates are asked for."""
    if curve is None:
        return []
    if replicates is None:
        return [curve]
    return [curve.with_name(f"{curve.stem}_{number}{curve.suffix}") for number in range(1, replicates + 1)]


def read_replicates(rig: Rig, recording: Recording, replicates: int | None) -> Sequence[Recording]:
    """What the rig reads of a recording of true forces, once, or `replicates` times with noise of different seeds.

    The seeds follow from that of the rig, and the first ones do not change when more replicates are asked for.
    """
    if replicates is None:
        return [rig.read(recording)]
    import numpy as np

    seeds = np.random.SeedSequence(rig.seed).generate_state(replicates).tolist()
    return [replace(rig, seed=seed).read(recording).with_metadata(replicate=number, seed=seed)
            for number, seed in enumerate(seeds, 1)]
