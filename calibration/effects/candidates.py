"""The candidates that many effects have: one number beside the material, of all tests or of each."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from calibration.campaign.campaign import Test
from calibration.effects.effect import Candidate, Effect, NotTestableError, Situation
from tissue_sim.parameters import parameters

#: A refit may go so many times as far from absence as what is tried first, to a fifth of what is measured: a sensor, a
#: drive or a load train that errs by more would not have been used, and takes the place of the tissue.
REACH = 20.0


def require_tests(tests: Sequence[Test], reason: str) -> Sequence[Test]:
    """The tests, of which there must be one.

    Raises:
        NotTestableError: there is none; with the reason.
    """
    if not tests:
        raise NotTestableError(reason)
    return tests


def per_test(effect: Effect, tests: Sequence[Test], sizes: Callable[[Test], Mapping[str, float]],
             **options) -> list[Candidate]:
    """A candidate for each test alone, of an effect that every test has a size of its own of."""
    return [Candidate(effect, sizes(test), tests=(test.name,), mark=test.name, **options) for test in tests]


def stated_value(test: Test, path: str) -> float:
    """What a test with a tool states of a number beside the material, SI."""
    part, _, inside = path.partition(".")
    return parameters(getattr(test, part))[inside].value


def beside_material(effect: Effect, situation: Situation, path: str, tests: Sequence[Test],
                    size: Callable[[Sequence[Test]], float], *, each: bool = False, both_ways: bool = True,
                    **options) -> list[Candidate]:
    """The candidates of one number of the experiment or the rig, counted from what the tests state of it.

    Args:
        effect, situation: as the candidates have them. path: of the number. tests: that have it.
        size: what is tried first, beyond what is stated, of tests that share the number.
        each: whether each test has a number of its own; else those share it that state the same.
        both_ways: whether it may be less than stated. options: of `Candidate`.

    Raises:
        NotTestableError: the campaign fits it already.
    """
    situation.require_new(path)
    groups: dict[object, list[Test]] = {}
    for test in tests:
        groups.setdefault(test.name if each else stated_value(test, path), []).append(test)
    found = []
    for group in groups.values():
        stated, step = stated_value(group[0], path), size(group)
        part, _, inside = path.partition(".")
        low, high = parameters(getattr(group[0], part))[inside].declaration.bounds
        least = stated - REACH * step if both_ways else stated
        found.append(Candidate(
            effect, {path: stated + step}, absent={path: stated},
            bounds={path: (max(low, least), min(high, stated + REACH * step))},
            tests=tuple(test.name for test in group), mark=group[0].name if each or len(groups) > 1 else "", **options))
    return found
