"""One run of the hidden-effect study, the plan of all runs, and the file of results."""

from __future__ import annotations

import hashlib
import json
import tempfile
import time
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from unittest import mock

import numpy as np

from benchmarks import ROOT
from benchmarks.hidden_effects.cases import PAIRS, Case, both, hidden, outside
from benchmarks.hidden_effects.peers import best_by_bic, gaussian_process, ordinary
from benchmarks.hidden_effects.recordings import draw_scatter, write_campaign
from benchmarks.hidden_effects.sizes import NOISE, REPLICATES, TABLE, class_of, frozen
from benchmarks.hidden_effects.truth import PROTOCOLS, VirtualTest, plain
from calibration.campaign_diagnosis import DiagnosisWithFits, diagnose_campaign, read_campaign_and_curves_for_diagnosis
from calibration.diagnosis import proposals
from calibration.effects.effect import CATALOGUE
from calibration.fit.run_context import RunContext
from calibration.tasks.executors import TaskExecutor
from tissue_sim.errors import ConvergenceError, InputError

#: What the figures depend on; sealed figures stand under the hash of all of it, thresholds included.
HASHED = ("diagnosis", "effects", "statistics", "fit", "forward")
#: Seeds below are for development, those from here on are sealed: drawn once, scored once.
SEALED_FROM = 1000
ROOMS = ("hidden", "other", "none", "outside", "look-alike", "pair")
#: Effects that are hidden while the catalogue lacks them, so that only those that look like them are in it.
LEFT_OUT = ("viscoelasticity", "poroelasticity", "machine_compliance", "latency", "guide_friction", "softening", "tilt",
            "session_scale", "strain_stiffening", "backlash")
_QUICK = ("viscoelasticity", "machine_compliance", "zero_offset", "partial_slip")


@dataclass(frozen=True)
class Planned:
    """Planned run: its name, protocol, seed, and hidden cases.

    Attributes:
        protocol: name. room: of `ROOMS`. cases: keys of what is hidden. words: class of size. number: of the size in
            its class. seed: of the scatter. coloured: whether the noise is; None: drawn.
    """

    protocol: str
    room: str
    cases: tuple[str, ...]
    words: str
    number: int
    seed: int
    coloured: bool | None = None

    @property
    def name(self) -> str:
        return "|".join((self.protocol, self.room, "+".join(self.cases), self.words, str(self.number),
                         "drawn" if self.coloured is None else "coloured" if self.coloured else "white",
                         str(self.seed)))


def code_hash() -> str:
    """Return the SHA-256 of the code of the diagnosis, its thresholds and the frozen table of sizes."""
    digest = hashlib.sha256()
    files = [ROOT / "calibration" / "campaign_diagnosis.py",
             *(file for folder in HASHED for file in sorted((ROOT / "calibration" / folder).rglob("*.py"))), TABLE]
    for file in files:
        digest.update(file.name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()


def plan(protocols: Sequence[str], rooms: Sequence[str], seeds: Sequence[int], *, effects: Sequence[str] = (),
         empty: int | None = None, quick: bool = False, classes: Sequence[str] = (), one_size: bool = False
         ) -> list[Planned]:
    """Return all planned runs.

    Args:
        protocols, rooms: names. seeds: each case at each of its sizes once with each. effects: only these; empty: all.
        empty: runs with nothing hidden, of each colour of noise; None: as many as seeds. quick: few effects, middle
            and strong. classes: of sizes; empty: all. one_size: of each class one size, drawn by the seed.
    """
    def sizes_of(key: str, words: str, count: int, seed: int) -> list[int]:
        return [zlib.crc32(f"{key}|{words}|{seed}".encode()) % count] if one_size else list(range(count))

    table, planned = frozen(), []
    chosen = effects or (_QUICK if quick else ())
    for protocol in protocols:
        rows = table[protocol]
        for key, case in ((key, case) for key, case in hidden().items() if key in rows):
            room = "hidden" if case.form == "exact" else "other"
            wanted = not chosen or case.effect in chosen
            for words, sizes in rows[key]["sizes"].items():
                if not wanted or room not in rooms or (quick and words == "< 3") or words not in (classes or (words,)):
                    continue
                planned += [Planned(protocol, room, (key,), words, k, seed) for seed in seeds
                            for k in sizes_of(key, words, 1 if quick else len(sizes), seed)]
            strong = rows[key]["sizes"].get("> 10", [])
            if "look-alike" in rooms and case.form == "exact" and case.effect in LEFT_OUT and wanted and strong:
                planned += [Planned(protocol, "look-alike", (key,), "> 10", min(1, len(strong) - 1), seed)
                            for seed in seeds]
        for colour, first in ((False, seeds[0]), (True, seeds[0])):
            if "none" in rooms:
                planned += [Planned(protocol, "none", (), "", 0, first + k, colour)
                            for k in range(len(seeds) if empty is None else empty)]
        if "outside" in rooms and not effects:
            planned += [Planned(protocol, "outside", (key,), "> 10", k, seed) for key in outside() if key in rows
                        for k in range(len(rows[key]["sizes"].get("> 10", []))) for seed in seeds]
        if "pair" in rooms and not effects:
            planned += [Planned(protocol, "pair", pair, "> 10", 0, seed) for pair in PAIRS for seed in seeds
                        if all(key in rows and rows[key]["sizes"].get("> 10") for key in pair)]
    return planned


@contextmanager
def _without(effects: Iterable[str]) -> Iterator[None]:
    """Return the catalogue of the diagnosis without some effects."""
    left = {name: CATALOGUE[name] for name in CATALOGUE if name not in set(effects)}
    with mock.patch.object(proposals, "CATALOGUE", left):
        yield


def forces_of(planned: Planned) -> tuple[Callable[[VirtualTest], np.ndarray], list[Case], list[float]]:
    """Return the force function of a test without scatter, and the hidden cases with their sizes."""
    cases = [{**hidden(), **outside()}[key] for key in planned.cases]
    sizes = [frozen()[planned.protocol][key]["sizes"][planned.words][planned.number][0] for key in planned.cases]
    if not cases:
        return (lambda test: plain(test.kind, test.displacement)), cases, sizes
    if len(cases) == 2:
        return both(*cases, (sizes[0], sizes[1])), cases, sizes
    return (lambda test: cases[0].force(test, sizes[0])), cases, sizes


def run_one(planned: Planned, digest: str = "", with_peers: bool = True) -> dict:
    """Make the recordings of one run, diagnose them, apply the usual methods, and return the numbers to be scored.

    Args:
        planned: the run. digest: of the code, noted with it. with_peers: whether the peers try.
    """
    forces, cases, sizes = forces_of(planned)
    rng = np.random.default_rng([planned.seed, zlib.crc32(planned.name.encode())])
    scatter = draw_scatter(rng, planned.room == "other", planned.coloured)
    tests, began = PROTOCOLS[planned.protocol](), time.monotonic()
    rows = [frozen()[planned.protocol][key] for key in planned.cases]
    # As the noise is that was drawn.
    signals = [row["correlated"][planned.words][planned.number] if scatter.coloured else
               row["sizes"][planned.words][planned.number][1] for row in rows]
    signal = min(signals, default=0.0)
    taken = [case.effect for case in cases] if planned.room == "look-alike" else []
    answer: dict = {
        "name": planned.name, "protocol": planned.protocol, "seed": planned.seed, "hash": digest,
        # Another form of an effect of the catalogue is hidden, too; the forms are told apart by `form`.
        "room": "hidden" if planned.room == "other" else planned.room, "cases": list(planned.cases),
        "form": cases[0].form if cases else "", "class": class_of(signal) if cases else "", "sizes": sizes,
        "signal": signal, "origin": [case.origin for case in cases],
        "effects": [case.effect for case in cases if case.effect and not taken],
        "testable": all(row["testable"] for row in rows), "scatter": asdict(scatter),
        "twins": sorted({twin for row in rows for twin in row.get("twins", [])}),
        "catalogue": [name for name in CATALOGUE if name not in taken]}
    with tempfile.TemporaryDirectory() as folder:
        path = write_campaign(Path(folder), tests, forces, scatter, rng)
        campaign, measured = read_campaign_and_curves_for_diagnosis(path)
        recorded = [(test, np.array([_on(test, curve) for curve in measured[test.name]])) for test in tests]
        try:
            with _without(taken):
                done = diagnose_campaign(campaign, measured, RunContext(campaign.name, TaskExecutor()))
        except (ConvergenceError, InputError) as failure:
            # As a user would see it: no verdict.
            return answer | {"failure": str(failure), "wall_s": time.monotonic() - began}
    answer |= _said(done) | {"wall_s": time.monotonic() - began}
    if with_peers:
        samples = float(done.before.effective_sample_count)
        statements = [{name: getattr(row, name) for name in ("effect", "testable", "score", "delta_BIC")}
                      for row in done.diagnosis.candidates]
        answer["peers"] = {"least squares": ordinary(recorded), "BIC": best_by_bic(statements, samples),
                           "Gaussian process": gaussian_process(recorded, done.diagnosis.noise_N or NOISE)}
    return answer


def _on(test: VirtualTest, curve) -> np.ndarray:
    """Return the force of a recording at the samples of its test, N."""
    time = curve.time if curve.time is not None else curve.displacement / test.speed
    return np.interp(test.time, time, curve.force)


def _said(done: DiagnosisWithFits) -> dict:
    """Return a diagnosis as a dictionary of plain values."""
    said = done.diagnosis
    weights: dict[str, float] = {}
    for row in said.candidates:
        if row.evidence_ratio:
            weights[row.effect] = max(weights.get(row.effect, 0.0), 1.0 / row.evidence_ratio)

    def moduli(fit) -> dict | None:
        return None if fit is None else {name: [fit.parameters[name], fit.standard_errors[name]]
                                         for name in ("C10", "C20")}

    return {
        "verdict": said.verdict, "named": [effect.name for effect in said.effects],
        "indistinguishable": list(said.indistinguishable), "weights": weights,
        "not_testable": [row.name for row in said.candidates if not row.testable],
        "candidates": [[row.name, row.score, row.p, row.delta_BIC, row.explained_percent]
                       for row in said.candidates if row.testable],
        "failures": [f"{row.name}: {row.note}" for row in said.candidates if row.note],
        "regions": [{"where": f"{row.test} {row.segment}", "before_sigma": row.before_sigma,
                     "after_sigma": row.after_sigma} for row in said.regions
                    if not row.adequate_before or row.adequate_after is False],
        "gap_before_N": said.gap_before_N, "gap_after_N": said.gap_after_N, "noise_N": said.noise_N,
        "noise_correlation_s": said.noise_correlation_s, "contact_jitter_mm": said.contact_jitter_mm,
        "zero_jitter_N": said.zero_jitter_N, "fit_before": moduli(said.fit_before), "fit_after": moduli(said.fit_after),
        "held_out": [{name: getattr(row, name) for name in (
            "name", "kind", "before_N", "after_N", "adequate_before", "adequate_after")} for row in said.held_out],
        "stages": {stage.name: [round(stage.wall_s, 2), stage.simulations] for stage in said.stages}}


class Results:
    """Results of finished runs: one JSON line each, one file for each shard, under one code hash.

    Args:
        folder: of all files. digest: of the code. sealed: whether the seeds are. shard: (which, of how many).
    """

    def __init__(self, folder: Path, digest: str, *, sealed: bool, shard: tuple[int, int] = (1, 1)):
        kind = "sealed" if sealed else "development"
        self._pattern = f"{kind}-{digest[:12]}-*.jsonl"
        self._folder = folder
        self._file = folder / f"{kind}-{digest[:12]}-{shard[0]}-of-{shard[1]}.jsonl"

    def read(self) -> list[dict]:
        """Read all finished runs of this hash from all shards; an incomplete last line is ignored."""
        runs: dict[str, dict] = {}
        for file in sorted(self._folder.glob(self._pattern)):
            for line in file.read_text(encoding="utf-8").splitlines():
                try:
                    run = json.loads(line)
                except json.JSONDecodeError:
                    continue
                runs[run["name"]] = run
        return list(runs.values())

    def add(self, run: dict) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        with self._file.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(run) + "\n")


def replicates_of(protocol: str) -> int:
    """Return the number of recordings in a run of a protocol."""
    return REPLICATES * len(PROTOCOLS[protocol]())
