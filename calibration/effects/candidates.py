"""Construction of the candidates that several effects share.

They are one parameter of the experiment or the rig, an error of a stated dimension of the specimens, or the extension
of a polynomial law to Biderman's law, which contains it.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from calibration.campaign.campaign import Test
from calibration.campaign.parameters import get_experiment_and_rig_declarations_by_path
from calibration.effects.effect import Candidate, DiagnosisData, Effect, NotTestableError
from tissue_sim.laws import InvariantLaw, find_law
from tissue_sim.parameters import parameters

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


#: Largest deviation from the stated value that a refit may find, in units of the trial deviation. A trial deviation is
#: about 1 % of the measured range, so the bound is a fifth of that range: a sensor, drive or load train with a larger
#: error would not have been used, and a larger bound would let the rig replace the tissue in the fit.
MAX_TRIAL_DEVIATIONS = 20.0


def require_tests(tests: Sequence[Test], reason: str) -> Sequence[Test]:
    """Return the tests unchanged; raise an error if there is none.

    Args:
        tests: tests that can show an effect.
        reason: why there is no such test, as the end of a sentence.

    Raises:
        NotTestableError: with `reason`, if `tests` is empty.
    """
    if not tests:
        raise NotTestableError(reason)
    return tests


def make_candidate_per_test(effect: Effect, tests: Sequence[Test], sizes: Callable[[Test], Mapping[str, float]],
                            **options: Any) -> list[Candidate]:
    """Return one candidate per test, each of which acts in its test only.

    Args:
        effect: effect of the candidates.
        tests: tests that get a candidate each.
        sizes: function that returns the trial values of a test: path -> value, SI.
        options: further arguments of `Candidate`.
    """
    return [Candidate(effect, sizes(test), tests=(test.name,), mark=test.name, **options) for test in tests]


def read_stated_value(test: Test, path: str) -> float:
    """Return the value that a test states for a parameter of its experiment or rig, SI.

    Args:
        test: test with a tool.
        path: path that begins with ``experiment.`` or ``rig.``.
    """
    part, _, inside = path.partition(".")
    return parameters(getattr(test, part))[inside].value


def make_experiment_or_rig_candidates(effect: Effect, situation: DiagnosisData, path: str, tests: Sequence[Test],
                                      size: Callable[[Sequence[Test]], float], *, each: bool = False,
                                      two_sided: bool = True,
                                      **options: Any) -> list[Candidate]:
    """Make the candidates of an effect that has one parameter of the experiment or the rig.

    Deviations are counted from the stated value, so that a known rig error is kept and its remaining error is tried.

    Args:
        effect: effect of the candidates.
        situation: campaign and recordings in which the effect is tested.
        path: path of the parameter; begins with ``experiment.`` or ``rig.``.
        tests: tests that have the parameter.
        size: function that returns the trial deviation from the stated value, SI, for tests that share the parameter.
        each: whether each test has its own value; otherwise tests that state the same value share one candidate.
        two_sided: whether the value may be smaller than stated.
        options: further arguments of `Candidate`.

    Raises:
        NotTestableError: the campaign fits or fixes the parameter already.
    """
    situation.require_unused_parameter(path)
    groups: dict[object, list[Test]] = {}
    for test in tests:
        groups.setdefault(test.name if each else read_stated_value(test, path), []).append(test)
    found = []
    for group in groups.values():
        stated, step = read_stated_value(group[0], path), size(group)
        part, _, inside = path.partition(".")
        low, high = parameters(getattr(group[0], part))[inside].declaration.bounds
        least = stated - MAX_TRIAL_DEVIATIONS * step if two_sided else stated
        found.append(Candidate(
            effect, {path: stated + step}, absent={path: stated},
            bounds={path: (max(low, least), min(high, stated + MAX_TRIAL_DEVIATIONS * step))},
            tests=tuple(test.name for test in group), mark=group[0].name if each or len(groups) > 1 else "", **options))
    return found


def _call_candidates_with_former_keyword(*args: Any, both_ways: bool = True,
                                         **options: Any) -> list[Candidate]:
    """Call `make_experiment_or_rig_candidates` with its former keyword ``both_ways`` for ``two_sided``."""
    return make_experiment_or_rig_candidates(*args, two_sided=both_ways, **options)


def __getattr__(name: str) -> Any:
    """Provide the former names of `make_experiment_or_rig_candidates` for one release."""
    if name == "beside_material":
        warnings.warn("calibration.effects.candidates.beside_material is deprecated; use "
                      "make_experiment_or_rig_candidates, whose both_ways is named two_sided", DeprecationWarning,
                      stacklevel=2)
        return _call_candidates_with_former_keyword
    if name == "rig_parameter_candidates":
        warnings.warn("calibration.effects.candidates.rig_parameter_candidates is renamed to "
                      "calibration.effects.candidates.make_experiment_or_rig_candidates", DeprecationWarning,
                      stacklevel=2)
        return make_experiment_or_rig_candidates
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


#: Largest relative error that a refit may find.
_MAX_ERROR = 0.2


def make_specimen_size_candidates(effect: Effect, situation: DiagnosisData, path: str, tests: Sequence[Test],
                                  error: float) -> list[Candidate]:
    """Make one candidate for each specimen: a relative error of one of its dimensions.

    Args:
        effect: effect of the candidates.
        situation: campaign and recordings in which the effect is tested.
        path: path of the dimension, such as ``experiment.specimen.height``.
        tests: tests with a specimen.
        error: trial relative error.

    Raises:
        NotTestableError: the campaign fits or fixes the dimension already, or no specimen has it.
    """
    situation.require_unused_parameter(path)
    size_name = path.rpartition(".")[2]
    tests = require_tests([test for test in tests
                           if path in get_experiment_and_rig_declarations_by_path(test.experiment, test.rig)],
                          f"no specimen has a {size_name}")
    groups: dict[str, list[Test]] = {}
    for test in tests:
        groups.setdefault("" if test.specimen is None else test.specimen.name, []).append(test)
    found = []
    for name, group in groups.items():
        size = read_stated_value(group[0], path)
        found.append(Candidate(
            effect, {path: (1.0 + error) * size}, absent={path: size},
            bounds={path: ((1.0 - _MAX_ERROR) * size, (1.0 + _MAX_ERROR) * size)},
            tests=tuple(test.name for test in group), mark=name if len(groups) > 1 else ""))
    return found
