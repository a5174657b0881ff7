"""What the law of Biderman adds to those that it contains."""

import numpy as np

from calibration.effects.effect import NotTestableError
from tissue_sim.laws import InvariantLaw, find_law

#: Name of the law with all numbers that are looked for.
WIDER = "biderman"


def require_contained(name: str) -> set[str]:
    """Parameters of a law that Biderman's contains.

    Raises:
        NotTestableError: it does not.
    """
    law, wider = find_law(name), find_law(WIDER)
    if isinstance(law, InvariantLaw) and set(law.parameters) <= set(wider.parameters):
        trial = {parameter: 1.0 + place for place, parameter in enumerate(law.parameters)}
        same = law.kernel_energy.key == wider.kernel_energy.key and np.array_equal(
            law.kernel_coefficients(trial),
            wider.kernel_coefficients(dict.fromkeys(wider.parameters, 0.0) | trial))
        if same:
            return set(law.parameters)
    raise NotTestableError(f"the law that is fitted, {law.title}, is no polynomial of the invariants with a term that "
                           "could be added; fit a reduced polynomial or Mooney-Rivlin")


def absent_order(name: str) -> tuple[str, int]:
    """The first power of I1 - 3 that a law does not have: its parameter and the power.

    Raises:
        NotTestableError: it has all that Biderman's has, or is not contained in it.
    """
    known = require_contained(name)
    for order in (2, 3):
        if f"C{order}0" not in known:
            return f"C{order}0", order
    raise NotTestableError("the law that is fitted has the third power of I1 - 3 already, and no law here has a fourth")
