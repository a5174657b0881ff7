"""Errors of what was measured at a specimen."""

from collections.abc import Sequence

from calibration.campaign.campaign import Test
from calibration.campaign.parameters import declared_around
from calibration.effects.candidates import require_tests, stated_value
from calibration.effects.effect import Candidate, Effect, Situation

#: Largest error that a refit may find, as a share.
_LARGEST = 0.2


def sizes_of_specimens(effect: Effect, situation: Situation, path: str, tests: Sequence[Test],
                       error: float) -> list[Candidate]:
    """A candidate for each specimen whose size is off.

    Args:
        effect, situation: as the candidates have them. path: of the size. tests: with a specimen. error: relative,
            that is tried first.

    Raises:
        NotTestableError: the campaign fits it already, or no specimen has it.
    """
    situation.require_new(path)
    size_name = path.rpartition(".")[2]
    tests = require_tests([test for test in tests if path in declared_around(test.experiment, test.rig)],
                          f"no specimen has a {size_name}")
    groups: dict[str, list[Test]] = {}
    for test in tests:
        groups.setdefault("" if test.specimen is None else test.specimen.name, []).append(test)
    found = []
    for name, group in groups.items():
        size = stated_value(group[0], path)
        found.append(Candidate(
            effect, {path: (1.0 + error) * size}, absent={path: size},
            bounds={path: ((1.0 - _LARGEST) * size, (1.0 + _LARGEST) * size)},
            tests=tuple(test.name for test in group), mark=name if len(groups) > 1 else ""))
    return found
