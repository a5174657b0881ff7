"""Rig of `tissue-sim simulate`, and replicates: recordings of one simulation that differ in their noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from scenes.commands.shared.parsing import InputErrorArgumentParser, make_integer_parser, parse_non_negative_number
from tissue_sim.errors import InputError

if TYPE_CHECKING:
    from tissue_sim import Recording, Rig

#: Largest value of ``--replicates``.
MAX_REPLICATES = 1000


def add_rig_flags(parser: InputErrorArgumentParser) -> None:
    """Add the flags of rig file, noise, replicates and seed."""
    rig = parser.add_argument_group("rig")
    rig.add_argument("--rig", type=Path, metavar="FILE",
                     help="rig file NAME.rig.json with the properties of load frame and sensor (default: an ideal rig)")
    rig.add_argument("--noise-N", type=parse_non_negative_number, metavar="N",
                     help="standard deviation of the force noise (default: value of the rig file, or 0)")
    rig.add_argument("--replicates", type=make_integer_parser(1, MAX_REPLICATES), metavar="N",
                     help="number of recordings with independent noise; -o CURVE.csv writes CURVE_1.csv, "
                     "CURVE_2.csv, ...")
    rig.add_argument("--seed", type=make_integer_parser(0), metavar="N",
                     help="seed of the noise; equal seeds give equal files (default: value of the rig file, or 0)")


def load_rig_with_noise_and_seed_flags(arguments) -> Rig:
    """Return the rig of ``--rig`` with the noise and the seed of the flags.

    Raises:
        InputError: an invalid rig file, or replicates or a seed without noise.
    """
    from tissue_sim.rig.file import load_rig
    from tissue_sim.rig.rig import Rig

    rig = Rig() if arguments.rig is None else load_rig(arguments.rig)
    if arguments.noise_N is not None:
        rig = replace(rig, force_noise=arguments.noise_N)
    if not rig.force_noise:
        for flag, value in (("--replicates", arguments.replicates), ("--seed", arguments.seed)):
            if value is not None:
                raise InputError("has an effect only with noise. Add --noise-N 0.02 or a rig with force_noise_N",
                                 field=flag)
    return rig if arguments.seed is None else replace(rig, seed=arguments.seed)


def make_replicate_curve_paths(curve: Path | None, replicates: int | None) -> list[Path]:
    """Return the files of the recordings: CURVE.csv, or CURVE_1.csv, CURVE_2.csv, ... for replicates."""
    if curve is None:
        return []
    if replicates is None:
        return [curve]
    return [curve.with_name(f"{curve.stem}_{number}{curve.suffix}") for number in range(1, replicates + 1)]


def simulate_replicate_readings(rig: Rig, recording: Recording, replicates: int | None) -> Sequence[Recording]:
    """Return replicates: the recording of true forces as the sensor of a rig measures it, with noise.

    The seeds of the replicates follow from the seed of the rig. The first replicates do not change when their number
    grows.

    Args:
        rig: rig with sensor and noise.
        recording: simulated recording.
        replicates: number of readings with different seeds; None makes one reading with the seed of the rig.
    """
    if replicates is None:
        return [rig.read(recording)]
    import numpy as np

    seeds = np.random.SeedSequence(rig.seed).generate_state(replicates).tolist()
    return [replace(rig, seed=seed).read(recording).with_metadata(replicate=number, seed=seed)
            for number, seed in enumerate(seeds, 1)]
