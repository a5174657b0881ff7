"""One raw file: draw, write, import, calibrate, and compare with the truth."""

from __future__ import annotations

import contextlib
import re
import tempfile
import traceback
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

import calibration
from benchmarks.raw_files.drafts import LAYOUTS, Draft, make_draft
from benchmarks.raw_files.trap import Trap
from benchmarks.raw_files.traps_kinds import KIND_TRAPS
from benchmarks.raw_files.traps_meaning import MEANING_TRAPS
from benchmarks.raw_files.traps_numbers import NUMBER_TRAPS
from benchmarks.raw_files.traps_signals import SIGNAL_TRAPS
from benchmarks.raw_files.traps_sizes import SIZE_TRAPS
from benchmarks.raw_files.truth import KINDS, draw_test, with_noise
from tissue_sim.errors import ConvergenceError, InputError

TRAPS: dict[str, Trap] = {trap.name: trap for trap in (*NUMBER_TRAPS, *SIZE_TRAPS, *MEANING_TRAPS, *KIND_TRAPS,
                                                       *SIGNAL_TRAPS)}
AREAS = tuple(dict.fromkeys(trap.area for trap in TRAPS.values()))
#: A modulus is right within this of a truth.
TOLERANCE = 0.05
#: Shares of files with one, two and three traps.
COUNTS = (0.6, 0.3, 0.1)

RIGHT = "right"
QUESTION = "question"
REASON = "refused, true reason"
OTHER_QUESTION = "other question"
OTHER_REFUSAL = "refused, other reason"
CRASH = "crash"
WRONG = "silently wrong"
OUTCOMES = (RIGHT, QUESTION, REASON, OTHER_QUESTION, OTHER_REFUSAL, CRASH, WRONG)


@dataclass(frozen=True)
class Result:
    """Outcome of one file.

    Attributes:
        index, traps, layout, kind: of the file. wants_right: whether one reading is correct.
        outcome: one of `OUTCOMES`. unsaid: traps whose note is missing from a right result.
        mu0: reported shear modulus, Pa. truths: acceptable ones. said: question, refusal or verdict.
    """

    index: int
    traps: tuple[str, ...]
    layout: str
    kind: str
    wants_right: bool
    outcome: str
    mu0: float | None
    truths: tuple[float, ...]
    said: str
    unsaid: tuple[str, ...] = ()

    def to_json(self) -> dict:
        return asdict(self)


def draw_traps(rng: np.random.Generator, only: str | None = None, areas: Sequence[str] = AREAS) -> list[Trap]:
    """Draw one to three compatible traps; areas are drawn first, so that all areas have equal probability."""
    count = 1 + int(rng.choice(len(COUNTS), p=COUNTS))
    if only is not None:
        return [TRAPS[only]]
    picked: list[Trap] = []
    for _ in range(20 * count):
        if len(picked) == count:
            break
        area = str(rng.choice(areas))
        names = [trap for trap in TRAPS.values() if trap.area == area]
        trap = names[int(rng.integers(len(names)))]
        if not any(trap.groups & other.groups for other in picked) and _shared([*picked, trap]):
            picked.append(trap)
    return picked


def _shared(traps: Sequence[Trap]) -> list[tuple[str, str]]:
    """Return kind and layout of files that can have all of these traps."""
    return [(kind, name) for kind in KINDS for name, layout in LAYOUTS.items() if kind in layout.names
            and all(kind in trap.kinds and name in trap.layouts for trap in traps)]


def draw_file(seed: int, index: int, clean: bool = False, only: str | None = None, areas: Sequence[str] = AREAS
              ) -> tuple[Draft, list[Trap]]:
    """Return the draft of one file, and its traps."""
    rng = np.random.default_rng([seed, index, int(clean)])
    traps = [] if clean else draw_traps(rng, only, areas)
    places = _shared(traps)
    weights = np.array([{KINDS[0]: 0.55, KINDS[1]: 0.3, KINDS[2]: 0.15}[kind] for kind, _ in places])
    kind, layout = places[int(rng.choice(len(places), p=weights / weights.sum()))]
    test = draw_test(rng, kind)
    truths = (test.mu,)
    for trap in traps:
        if trap.on_test is not None:
            changed = trap.on_test(test, rng)
            test, truths = changed if isinstance(changed, tuple) else (changed, truths)
    # Creep and oscillation move the displacement, too; the noise of its sensor is below its last digit.
    test = with_noise(test, rng, float(rng.uniform(0.5e-3, 4e-3)))
    draft = make_draft(test, layout, rng)
    draft.truths = truths
    # Further tables first, then units and decimal marks, in which sizes are written; defects change all tables.
    for trap in sorted(traps, key=lambda trap: ("blocks" not in trap.groups, trap.area != "numbers",
                                                "defect" in trap.groups)):
        if trap.on_draft is not None:
            trap.on_draft(draft, rng)
    return draft, traps


def run_file(seed: int, index: int, *, clean: bool = False, only: str | None = None,
             areas: Sequence[str] = AREAS, keep: Path | None = None) -> Result:
    """Draw, write, import and calibrate one file; `keep` is a folder in which its files stay."""
    draft, traps = draw_file(seed, index, clean, only, areas)
    with tempfile.TemporaryDirectory(prefix="raw_file_") as place:
        folder = Path(place) if keep is None else keep / f"{index:05d}"
        folder.mkdir(parents=True, exist_ok=True)
        with contextlib.chdir(folder):
            names = []
            for name, content in draft.files().items():
                Path(name).write_bytes(content)
                names.append(name)
            result = _judge(index, draft, traps, names)
            if keep is not None:
                flags = {"kind": draft.stated_kind, "specimen": draft.specimen_flags() if draft.stated_sizes else {},
                         "test": draft.stated_test, "columns": draft.columns_stated, "units": draft.units_stated}
                Path("result.txt").write_text("".join(f"{key}: {value}\n" for key, value in
                                                      {**result.to_json(), "flags": flags}.items()), encoding="utf-8")
    return result


def _wishes(draft: Draft) -> calibration.ImportOptions:
    stated = calibration.InterpretationOverrides(columns=draft.columns_stated, units=draft.units_stated,
                                                 kind=draft.stated_kind)
    sizes = draft.specimen_flags() if draft.stated_sizes else {}
    return calibration.ImportOptions(stated, sizes, dict(draft.stated_test), ("neo_hooke",))


def _judge(index: int, draft: Draft, traps: Sequence[Trap], names: list[str]) -> Result:
    reasons = [reason for trap in traps for reason in trap.reasons]

    def result(outcome: str, said: str, mu0: float | None = None, unsaid: tuple[str, ...] = ()) -> Result:
        return Result(index, tuple(trap.name for trap in traps), draft.layout, draft.test.kind,
                      all(trap.wants_right for trap in traps), outcome, mu0, draft.truths, said, unsaid)

    def to_the_point(said: str) -> bool:
        # Names of files and quoted cells may hold the words without a reason in the message.
        plain = re.sub("'[^']*'", "''", re.sub("|".join(map(re.escape, names)), "", said))
        return any(re.search(reason, plain, re.IGNORECASE) for reason in reasons)

    try:
        imported = calibration.import_files(names, None, _wishes(draft))
        if not imported.is_complete:
            said = "; ".join(filter(None, (*imported.questions, *imported.missing, imported.problem)))
            return result(QUESTION if to_the_point(said) else OTHER_QUESTION, said)
        Path("campaign.toml").write_text(imported.text, encoding="utf-8")
        calibrated, = calibration.calibrate(["campaign.toml"], "results", figures=False, overwrite=True)
    except (InputError, ConvergenceError) as error:
        return result(REASON if to_the_point(str(error)) else OTHER_REFUSAL, str(error))
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        return result(CRASH, f"{type(error).__name__}: {error} ({Path(last.filename).name}:{last.lineno})")
    best = calibrated.best
    if best.unusable is not None:
        said = f"{best.unusable}. {calibrated.message}"
        return result(REASON if to_the_point(said) else OTHER_REFUSAL, said, best.mu0)
    if not any(abs(best.mu0 / truth - 1) <= TOLERANCE for truth in draft.truths):
        return result(WRONG, calibrated.message, best.mu0)
    told = " ".join((*imported.warnings, calibrated.message, imported.text))
    unsaid = tuple(trap.name for trap in traps if trap.note and not re.search(trap.note, told, re.IGNORECASE))
    return result(RIGHT, calibrated.message, best.mu0, unsaid)
