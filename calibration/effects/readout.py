"""Effects of a rheometer or DMA on measured moduli: inertia, compliance in series, and delay of the load.

See `tissue_sim.rig.modulus_readout.ModulusReadout`.
"""

from collections.abc import Sequence

import numpy as np

from calibration.campaign.campaign import Test
from calibration.effects.candidates import make_experiment_or_rig_candidates, require_tests
from calibration.effects.effect import Candidate, DiagnosisData, Effect


def require_modulus_tests(situation: DiagnosisData) -> Sequence[Test]:
    """Return the fitted tests of moduli.

    Raises:
        NotTestableError: no test is a table of moduli.
    """
    return require_tests([test for test in situation.tests if test.modulus], "no test is a table of moduli")


def find_largest_modulus_and_angular_frequency(situation: DiagnosisData,
                                               tests: Sequence[Test]) -> tuple[float, float]:
    """Return the largest modulus, Pa, and the largest angular frequency, rad/s, of tables."""
    curves = situation.list_recordings(tests)
    return (float(np.exp(max(curve.force.max() for curve in curves))),
            2.0 * np.pi * max(float(curve.displacement.max()) for curve in curves))


class ReadoutInertia(Effect):
    """Effect of the inertia of the moving parts of a rheometer or DMA, Pa s2."""

    name = "readout_inertia"
    category = "readout"
    title = "inertia of the instrument"
    signature = "the storage modulus is too small in proportion to the square of the frequency"
    separated_by = "a table without a specimen, or lower frequencies"
    #: Trial change of the largest modulus, relative to the modulus.
    trial_fraction = 0.05

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return the candidates with a trial inertia that changes the modulus at the largest frequency."""
        tests = require_modulus_tests(situation)
        modulus, omega = find_largest_modulus_and_angular_frequency(situation, tests)
        return make_experiment_or_rig_candidates(self, situation, "readout.inertia", tests,
                                                 lambda _: self.trial_fraction * modulus / omega**2, two_sided=False)


class ReadoutCompliance(Effect):
    """Effect of a compliance in series with the specimen, 1/Pa."""

    name = "readout_compliance"
    category = "readout"
    title = "compliance of the instrument"
    signature = "both moduli are too small in proportion to the modulus, so stiff tissue appears too soft"
    separated_by = "a table of a stiff specimen, or of another height"
    #: Trial change of the largest modulus, relative to the modulus.
    trial_fraction = 0.05

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return the candidates with a trial compliance that changes the largest modulus."""
        tests = require_modulus_tests(situation)
        modulus, _ = find_largest_modulus_and_angular_frequency(situation, tests)
        return make_experiment_or_rig_candidates(self, situation, "readout.compliance", tests,
                                                 lambda _: self.trial_fraction / modulus, two_sided=False)


class ReadoutDelay(Effect):
    """Effect of a time, s, by which the load is recorded later than the motion of an oscillation."""

    name = "readout_delay"
    category = "readout"
    title = "delay of the load in moduli"
    signature = "the loss modulus is wrong in proportion to the frequency and the storage modulus"
    separated_by = "a table of an elastic specimen, such as a steel spring"
    #: Trial angle at the largest frequency, rad. A larger angle may make the loss modulus negative.
    trial_angle = 0.01

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return the candidates with a trial delay of a small angle at the largest frequency."""
        tests = require_modulus_tests(situation)
        _, omega = find_largest_modulus_and_angular_frequency(situation, tests)
        return make_experiment_or_rig_candidates(self, situation, "readout.delay", tests,
                                                 lambda _: self.trial_angle / omega)
