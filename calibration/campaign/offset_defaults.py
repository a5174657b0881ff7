"""Default priors and bounds of contact offsets and force zeros, for campaigns that do not state them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class OffsetDefaults:
    """Default priors and bounds of contact offsets and force zeros.

    A larger prior lets an offset explain more of a misfit, which increases the standard errors of the moduli. A
    smaller prior makes the moduli depend on the recorded contact.

    Attributes:
        contact_prior: standard deviation of the prior of a contact offset, m; reduced for tests with small
            displacements.
        contact_bound: half width of the bounds of a contact offset in an analytical fit, m; reduced in the same way.
        contact_fraction: largest standard deviation of a contact offset, as a fraction of the displacement of a test.
        strain_fraction: standard deviation of a contact offset, as a fraction of the strain of a test recorded as
            strain.
        zero_prior: standard deviation of the prior of a zero, in units of the noise of the force.
        zero_bound: half width of the bounds of a zero in an analytical fit, in standard deviations of its prior.
        first_zero: first value of the zero's standard deviation in an inverse fit, as a fraction of the largest force;
            it is kept if no test has two recordings.
    """

    contact_prior: float = 0.05e-3
    contact_bound: float = 0.5e-3
    contact_fraction: float = 0.02
    strain_fraction: float = 0.005
    zero_prior: float = 5.0
    zero_bound: float = 10.0
    first_zero: float = 0.002


OFFSET_DEFAULTS = OffsetDefaults()
