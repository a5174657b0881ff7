"""Candidates for errors of the stated dimensions of specimens."""

from collections.abc import Sequence

from calibration.campaign.campaign import Test
from calibration.campaign.parameters import get_experiment_and_rig_declarations_by_path
from calibration.effects.candidates import read_stated_value, require_tests
from calibration.effects.effect import Candidate, DiagnosisData, Effect

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
