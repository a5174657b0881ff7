"""Tests and recordings in which a diagnosis tests effects, with estimates for trial values."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from calibration.campaign.campaign import Campaign, Test
from calibration.campaign.measured import MeasuredCurve
from tissue_sim.experiment.experiment import Experiment
from tissue_sim.public_names import OldName, with_old_names

#: Smallest decrease of the displacement that counts as unloading, as a fraction of the largest displacement.
UNLOADING_FRACTION = 0.05


class NotTestableError(Exception):
    """No test of a campaign can show an effect; the message gives the reason without a capital letter or full stop."""


@with_old_names(fitted_curves="list_recordings", relaxation_times="list_resolvable_relaxation_times")
@dataclass(frozen=True, eq=False)
class DiagnosisData:
    """Tests and recordings in which a diagnosis tests an effect, with estimates for trial values.

    Attributes:
        campaign: campaign with the fitted tests.
        measured: name of a test -> its recordings.
        law: name of the fitted law.
    """

    campaign: Campaign
    measured: Mapping[str, Sequence[MeasuredCurve]]
    law: str

    @cached_property
    def tests(self) -> tuple[Test, ...]:
        """Tests of the campaign that are fitted, which are all tests that are not held out."""
        return tuple(test for test in self.campaign.tests if not test.hold_out)

    def simulated_tests(self, condition: Callable[[Test], bool] = lambda _: True) -> tuple[Test, ...]:
        """Return the fitted tests that finite elements simulate: those with a specimen, a tool, and recorded forces.

        Args:
            condition: function that selects among these tests.
        """
        return tuple(test for test in self.tests if test.experiment is not None
                     and not self.measured[test.name][0].stressed and condition(test))

    simulated = OldName("simulated_tests")
    fastest_speed = OldName("find_largest_loading_speed")
    curves = OldName("list_recordings")
    step_and_duration = OldName("sampling_interval_and_duration")
    require_new = OldName("require_unused_parameter")
    depth = OldName("largest_displacement")
    force = OldName("largest_force")
    strain = OldName("largest_strain")
    modulus = OldName("estimated_shear_modulus")
    shear_modulus = OldName("estimated_shear_modulus")
    has_unloading = OldName("test_has_unloading")

    def list_recordings(self, tests: Iterable[Test] | None = None) -> list[MeasuredCurve]:
        """Return the recordings of `tests` in one list; None: of all fitted tests."""
        return [curve for test in (self.tests if tests is None else tests) for curve in self.measured[test.name]]

    def largest_displacement(self, test: Test) -> float:
        """Return the largest displacement in a test, m; the largest strain if the test was recorded as strain."""
        return max(float(np.abs(curve.displacement).max()) for curve in self.measured[test.name])

    def largest_force(self, test: Test) -> float:
        """Return the largest force in a test, N."""
        return max(float(np.abs(curve.force).max()) for curve in self.measured[test.name])

    @cached_property
    def has_time(self) -> bool:
        """Whether every recording of the fitted tests has a time channel that advances."""
        return all(curve.time is not None and np.ptp(curve.time) > 0 for curve in self.list_recordings())

    @cached_property
    def sampling_interval_and_duration(self) -> tuple[float, float]:
        """Median sampling interval and duration of the longest recording, s.

        Raises:
            NotTestableError: a recording has no time.
        """
        if not self.has_time:
            raise NotTestableError("the recordings have no time")
        clocks = [curve.sample_times for curve in self.list_recordings()]
        return float(np.median([np.median(np.diff(clock)) for clock in clocks])), \
            max(float(clock[-1] - clock[0]) for clock in clocks)

    @cached_property
    def estimated_shear_modulus(self) -> float:
        """Estimate of the shear modulus mu for trial values, Pa.

        The estimate is the median over the tests of the modulus that linear elasticity assigns to the largest force F
        at the largest displacement d: mu = F h / (3 A d) for plates on a specimen of height h and area A, and mu = F /
        (8 a d) for an indenter with contact radius a, both for an incompressible material.
        """
        found = []
        for test in self.tests:
            force, depth = self.largest_force(test), self.largest_displacement(test)
            if test.experiment is None or self.measured[test.name][0].stressed:
                area, height = (1.0, 1.0) if test.specimen is None else (test.specimen.area, test.specimen.height)
                found.append(force * height / (3.0 * area * depth))
            elif test.experiment.tool.is_plate:
                specimen = test.experiment.specimen
                area = specimen.area if specimen.is_prism else np.pi * specimen.margin() ** 2
                found.append(force * specimen.height / (3.0 * area * depth))
            else:
                found.append(force / (8.0 * self.contact_radius(test) * depth))
        return float(np.median(found))

    def contact_radius(self, test: Test) -> float:
        """Return an estimate of the contact radius of a tool at the largest displacement of a test, m."""
        experiment = get_experiment(test)
        return experiment.tool.contact_radius(self.largest_displacement(test), experiment.specimen.margin())

    def largest_strain(self, test: Test) -> float:
        """Return an estimate of the largest strain in a test with a tool.

        The estimate is the displacement divided by the specimen's height (plates) or by the contact diameter (needles).
        """
        experiment = get_experiment(test)
        size = experiment.specimen.height if experiment.tool.is_plate else 2.0 * self.contact_radius(test)
        return self.largest_displacement(test) / size

    def test_has_unloading(self, test: Test) -> bool:
        """Return whether any recording of a test has an unloading above `UNLOADING_FRACTION`."""
        return any(float(np.max(np.maximum.accumulate(curve.displacement) - curve.displacement))
                   > UNLOADING_FRACTION * self.largest_displacement(test) for curve in self.measured[test.name])

    def find_largest_loading_speed(self, tests: Iterable[Test]) -> float:
        """Return the largest loading speed in some tests, m/s.

        Raises:
            NotTestableError: the recordings have no time.
        """
        speeds = [curve.mean_loading_speed for curve in self.list_recordings(tests) if self.has_time
                  and curve.mean_loading_speed]
        if not speeds:
            raise NotTestableError("the recordings have no time")
        return max(speeds)

    def require_unused_parameter(self, path: str) -> None:
        """Raise an error if the campaign already fits or fixes a parameter.

        Args:
            path: path of the parameter in the model.

        Raises:
            NotTestableError: the campaign fits or fixes the parameter.
        """
        if path in self.campaign.fit.start or path in self.campaign.fit.fixed:
            raise NotTestableError("the campaign fits or fixes this parameter already")

    def list_resolvable_relaxation_times(self, per_decade: float = 2.0) -> list[float]:
        """Return relaxation times that the recordings can resolve, s, evenly spaced on a logarithmic axis.

        The times extend from three sampling intervals to the duration of the longest recording.

        Args:
            per_decade: number of times per decade.
        """
        step, longest = self.sampling_interval_and_duration
        shortest = min(3.0 * step, 0.1 * longest)
        count = max(2, int(np.ceil(per_decade * np.log10(longest / shortest))) + 1)
        return np.geomspace(shortest, longest, count).tolist()


def get_experiment(test: Test) -> Experiment:
    """Return `test.experiment`; raise an `AssertionError` for a gripped test, which has no tool and no experiment."""
    assert test.experiment is not None, test.name
    return test.experiment
