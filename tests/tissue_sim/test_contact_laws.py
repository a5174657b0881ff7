"""Sum of the tractions of several contact laws."""

from dataclasses import dataclass

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.experiment.contact_law import ContactLaw, Traction
from tissue_sim.fem.contact.laws import sum_tractions


@dataclass(frozen=True)
class ConstantPull(ContactLaw):
    """Constant pull up to a distance; the formula changes its argument, as formulas of users may do."""

    name = "constant_pull"
    pull: float = 3.0
    distance: float = 1e-3

    @property
    def reach(self):
        return self.distance

    def traction(self, gap, pressure, slip, face):
        if isinstance(gap, np.ndarray):
            gap *= 0.0
        return Traction(self.pull, (2.0 * slip[0], 0.0), 0.0, ((2.0, 0.0), (0.0, 0.0)))


GAPS = np.array([-1e-4, 5e-4, 2e-3])
SLIPS = (np.array([1.0, 2.0, 3.0]), np.zeros(3))


def add(*laws):
    return sum_tractions(laws, [law.reach for law in laws], GAPS, np.zeros(3), SLIPS, 1.0)


def test_each_law_ends_at_its_reach():
    near, far = ConstantPull(3.0, 1e-3), ConstantPull(5.0, 1e-2)
    for total in (add(near, far), add(far, near)):
        np.testing.assert_array_equal(total.pull, [8.0, 8.0, 5.0])
        np.testing.assert_array_equal(total.drag[0], [4.0, 8.0, 6.0])
        np.testing.assert_array_equal(total.drag_rates[0][0], [4.0, 4.0, 2.0])
        assert total.drag[1] == 0.0 and total.pull_rate == 0.0
    np.testing.assert_array_equal(GAPS, [-1e-4, 5e-4, 2e-3])


def test_a_law_must_return_a_traction():
    class Wrong(ConstantPull):
        def traction(self, gap, pressure, slip, face):
            return 1.0

    with pytest.raises(ts.InputError, match=r"must return a tissue_sim\.Traction; got float"):
        add(Wrong())
