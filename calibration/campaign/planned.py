"""Recordings that nobody has made yet: the motion of a planned test, with the noise that its sensor will have."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from calibration.campaign.campaign import Campaign, Test
from calibration.campaign.measured import MeasuredCurve, read_measured
from calibration.statistics.sensor_noise import SensorNoise
from tissue_sim.errors import InputError
from tissue_sim.experiment.protocol import Protocol
from tissue_sim.recording.segmentation import label_motion, number_runs

#: A recording with a hold and a return has at least so many.
MIN_SAMPLES = 20
#: Recordings of a planned test, and samples of each, where nobody says.
REPLICATES, SAMPLES = 3, 500


def planned_curves(test: Test, protocol: Protocol, noise: SensorNoise, replicates: int = REPLICATES,
                   samples: int = SAMPLES) -> tuple[MeasuredCurve, ...]:
    """Recordings of a motion, their force yet unknown (it stands in proportion to the displacement).

    Args:
        test: it belongs to. protocol: the motion. noise: of its sensor. replicates, samples: how many, evenly in time.
    """
    time = np.linspace(protocol.time[0], protocol.time[-1], samples)
    displacement = np.interp(time, protocol.time, protocol.displacement)
    labels = number_runs(label_motion(time, displacement))
    return tuple(MeasuredCurve(f"{test.name}/planned {number + 1}", test, time, displacement, 1e3 * displacement,
                               labels, Path(), "", noise=noise) for number in range(replicates))


def read_planned(campaign: Campaign, replicates: int = REPLICATES,
                 samples: int = SAMPLES) -> dict[str, tuple[MeasuredCurve, ...]]:
    """All tests of a campaign that was loaded as planned: those with recordings as these are, the others as stated.

    Raises:
        InputError: a protocol that is none or goes through the specimen, no stated noise, no recording or too few
            samples of one, what `read_measured` refuses.
    """
    for name, count, least in (("replicates", replicates, 1), ("samples", samples, MIN_SAMPLES)):
        if count < least:
            raise InputError(f"{count} {name} are too few; give at least {least}", field=name)
    planned = [test for test in campaign.tests if not test.recordings]
    if planned and campaign.noise.force is None:
        raise InputError("a planned test has no recordings that tell the noise; state the standard deviation of the "
                         "force sensor", file=campaign.path, field="noise.force_N")
    found = read_measured(replace(campaign, tests=tuple(test for test in campaign.tests if test.recordings)))
    for test in planned:
        if test.experiment is None:
            raise InputError(f"{test.kind.name} is a gripped test; design takes tests with a tool",
                             file=campaign.path, field=f"{test.place}.kind")
        try:
            protocol = Protocol.parse(str(test.protocol))
            replace(test.experiment, protocol=protocol)
        except InputError as error:
            raise InputError(error.problem, file=campaign.path, field=f"{test.place}.protocol") from None
        noise = SensorNoise(float(campaign.noise.force or 0.0), campaign.noise.correlation_time or 0.0)
        found[test.name] = planned_curves(test, protocol, noise, replicates, samples)
    return {test.name: found[test.name] for test in campaign.tests}


def as_simulated(curves: Sequence[MeasuredCurve], forces: Sequence[np.ndarray]) -> tuple[MeasuredCurve, ...]:
    """The recordings with these forces, N, each of shape (n,)."""
    return tuple(replace(curve, force=force) for curve, force in zip(curves, forces, strict=True))
