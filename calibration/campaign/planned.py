"""Planned motions as curves with noise, for tests without recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calibration.campaign.campaign import Campaign, Test
from calibration.campaign.measured import MeasuredCurve, read_measured_curves
from calibration.statistics.sensor_noise import SensorNoise
from tissue_sim.errors import InputError
from tissue_sim.experiment.protocol import Protocol
from tissue_sim.recording.segmentation import append_numbers_to_repeated_runs, label_samples_ramp_hold_unload


@dataclass(frozen=True)
class PlannedRecordingCounts:
    """Numbers of recordings and samples of a planned test.

    Attributes:
        min_samples: smallest number of samples of a planned recording.
        replicates: default number of recordings of a planned test.
        samples: default number of samples of a planned recording.
    """

    min_samples: int = 20
    replicates: int = 3
    samples: int = 500


PLANNED = PlannedRecordingCounts()


def create_planned_curves_with_placeholder_force(test: Test, protocol: Protocol, noise: SensorNoise,
                                                 replicates: int = PLANNED.replicates,
                                                 samples: int = PLANNED.samples) -> tuple[MeasuredCurve, ...]:
    """Return recordings of a planned motion with a placeholder force proportional to the displacement.

    Args:
        test: the planned test.
        protocol: motion of the tool.
        noise: noise of the force sensor.
        replicates: number of recordings.
        samples: number of samples per recording, evenly spaced in time.
    """
    time = np.linspace(protocol.time[0], protocol.time[-1], samples)
    displacement = np.interp(time, protocol.time, protocol.displacement)
    labels = append_numbers_to_repeated_runs(label_samples_ramp_hold_unload(time, displacement))
    return tuple(MeasuredCurve(f"{test.name}/planned {number + 1}", test, time, displacement, 1e3 * displacement,
                               labels, Path(), "", noise=noise) for number in range(replicates))


def read_or_plan_curves_of_all_tests(campaign: Campaign, replicates: int = PLANNED.replicates,
                                     samples: int = PLANNED.samples) -> dict[str, tuple[MeasuredCurve, ...]]:
    """Read the recordings of tests that have recordings, and create recordings of the planned tests.

    Args:
        campaign: campaign loaded with ``planned=True``.
        replicates: number of recordings of a planned test.
        samples: number of samples of a planned recording.

    Returns:
        The recordings of each test by the name of the test.

    Raises:
        InputError: an invalid protocol or one deeper than the specimen, no stated noise, no replicate or too few
            samples, or an error of `read_measured_curves`.
    """
    for name, count, least in (("replicates", replicates, 1), ("samples", samples, PLANNED.min_samples)):
        if count < least:
            raise InputError(f"{name} must be at least {least}; got {count}", field=name)
    planned = [test for test in campaign.tests if not test.recordings]
    if planned and campaign.noise.force is None:
        raise InputError("the noise of a planned test cannot be estimated; state the standard deviation of the force "
                         "sensor", file=campaign.path, field="noise.force_N")
    found = read_measured_curves(replace(campaign, tests=tuple(test for test in campaign.tests if test.recordings)))
    for test in planned:
        if test.experiment is None:
            raise InputError(f"a planned test must have a tool; {test.kind.name} is a gripped test",
                             file=campaign.path, field=f"{test.place}.kind")
        try:
            protocol = Protocol.parse(str(test.protocol))
            protocol.require_displacement_control("a planned test")
            replace(test.experiment, protocol=protocol)
        except InputError as error:
            raise InputError(error.problem, file=campaign.path, field=f"{test.place}.protocol") from None
        noise = SensorNoise(float(campaign.noise.force or 0.0), campaign.noise.correlation_time or 0.0)
        found[test.name] = create_planned_curves_with_placeholder_force(test, protocol, noise, replicates, samples)
    return {test.name: found[test.name] for test in campaign.tests}


def replace_forces_of_curves(curves: Sequence[MeasuredCurve],
                             forces: Sequence[np.ndarray]) -> tuple[MeasuredCurve, ...]:
    """Return copies of the recordings with other forces, N, one array of shape (n,) for each recording."""
    return tuple(replace(curve, force=force) for curve, force in zip(curves, forces, strict=True))
