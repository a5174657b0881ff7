"""Extension of polynomial laws to Biderman's law, which contains them."""

import numpy as np

from calibration.effects.effect import NotTestableError
from tissue_sim.laws import InvariantLaw, find_law

#: Name of the law that has the terms in C10, C01, C20 and C30.
WIDER = "biderman"


def check_biderman_case_and_get_parameter_names(name: str) -> set[str]:
    """Check that a law is a special case of Biderman's law, and return the names of its parameters.

    Args:
        name: name of the fitted law.

    Raises:
        NotTestableError: the law is not a special case of Biderman's law.
    """
    law, wider = find_law(name), find_law(WIDER)
    if isinstance(law, InvariantLaw) and set(law.parameters) <= set(wider.parameters):
        trial = {parameter: 1.0 + index for index, parameter in enumerate(law.parameters)}
        same = law.kernel_energy.key == wider.kernel_energy.key and np.array_equal(
            law.kernel_coefficients(trial),
            wider.kernel_coefficients(dict.fromkeys(wider.parameters, 0.0) | trial))
        if same:
            return set(law.parameters)
    raise NotTestableError(f"the fitted law, {law.title}, cannot be extended by a polynomial term in the invariants; "
                           "fit a reduced polynomial or Mooney-Rivlin")


def find_lowest_missing_coefficient_and_power(name: str) -> tuple[str, int]:
    """Find the lowest power of I1 - 3 that the strain energy of a law lacks.

    Args:
        name: name of the fitted law.

    Returns:
        Name of the coefficient, such as ``C20``, and the power.

    Raises:
        NotTestableError: the law has all powers of Biderman's law, or it is not a special case of Biderman's law.
    """
    known = check_biderman_case_and_get_parameter_names(name)
    for order in (2, 3):
        if f"C{order}0" not in known:
            return f"C{order}0", order
    raise NotTestableError("the fitted law has the third power of I1 - 3 already, and no available law has the fourth")
