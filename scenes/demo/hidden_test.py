"""A virtual specimen with something hidden: it is measured, diagnosed, and only then the truth is told."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import tissue_sim as ts
from calibration.effects.catalogue import CATALOGUE
from scenes.demo.hidden_effect import NEEDLE, PLATES, Hidden, draw_hidden, judge_answer
from scenes.demo.hidden_figure import draw_before_and_after
from scenes.demo.specimen import BULK_RATIO, PHANTOM, SPECIMEN
from tissue_sim.atomic_write import write_text

if TYPE_CHECKING:
    from calibration import DiagnosisResult, Workers
    from calibration.fit.steps import Progress

#: Motion of both tests; samples of a recording; recordings of a test.
PROTOCOL, SAMPLES, REPLICATES = "ramp 10mm @0.248mm/s; hold 60s; unload", 140, 3
#: Standard deviations of the sensor, N, and between the recordings of the point of contact, m, and of the zero, N.
FORCE_NOISE, CONTACT_JITTER, ZERO_JITTER = 0.02, 0.03e-3, 0.01
KINDS = {PLATES: "lubricated_compression", NEEDLE: "needle_indentation"}

CAMPAIGN = f"""# Lubricated compression and a needle on a virtual specimen in which something may be hidden.
[[specimen]]
name = "virtual phantom"
radius_mm = {1e3 * SPECIMEN.radius:g}
height_mm = {1e3 * SPECIMEN.height:g}

[[test]]
name = "{PLATES}"
kind = "{KINDS[PLATES]}"
recordings = ["measured/{PLATES}_*.csv"]

[[test]]
name = "{NEEDLE}"
kind = "{KINDS[NEEDLE]}"
recordings = ["measured/{NEEDLE}_*.csv"]
tool = "flat"
tool_radius_mm = 8.0
friction = "bonded"

[fit]
method = "inverse_fem"
laws = ["reduced_polynomial_2"]
bulk_ratio = {BULK_RATIO}
starts = 1
start = {{ C10 = 1000.0, C20 = 500.0 }}

[noise]
force_N = {FORCE_NOISE}
"""


@dataclass(frozen=True)
class HiddenAnswer:
    """What the demo showed.

    Attributes:
        result: of the diagnosis. hidden, truth: what was hidden, and that in words. found, sentence: whether it was
            found, and that in words.
        figure, report, campaign: files. seed: of what was hidden and of the noise. wall_s: of all of it.
    """

    result: DiagnosisResult
    hidden: Hidden
    truth: str
    found: bool
    sentence: str
    figure: Path
    report: Path
    campaign: Path
    seed: int
    wall_s: float

    def to_json(self) -> dict[str, Any]:
        """For ``--json``: numbers in SI, gaps in N."""
        diagnosis = self.result.diagnosis
        return {
            "verdict": diagnosis.verdict, "message": diagnosis.message,
            "effects": [{"name": each.name, "parameters": {number.path: number.value for number in each.parameters}}
                        for each in diagnosis.effects],
            "indistinguishable": diagnosis.indistinguishable, "gap_before_N": diagnosis.gap_before_N,
            "gap_after_N": diagnosis.gap_after_N, "noise_N": diagnosis.noise_N,
            "hidden": {"name": self.hidden.name, "parameters": dict(self.hidden.values), "sentence": self.truth},
            "found": self.found, "sentence": self.sentence, "figure": str(self.figure), "report": str(self.report),
            "campaign": str(self.campaign), "seed": self.seed, "wall_s": self.wall_s}


def plain_models() -> dict[str, ts.Model]:
    """Test -> its model with nothing hidden, on knots between which the force is smooth."""
    material = ts.Material("reduced_polynomial_2", PHANTOM, ts.Bulk("bulk_ratio", BULK_RATIO), name="virtual phantom")
    protocol = ts.Protocol.parse(PROTOCOL, points=41)
    return {test: ts.Model(ts.KINDS[kind].experiment(specimen=SPECIMEN, protocol=protocol), material)
            for test, kind in KINDS.items()}


def run_hidden_demo(output: Path, *, seed: int, overwrite: bool = False, console=None,
                    progress: AbstractContextManager[Progress] | None = None,
                    workers: Workers | None = None) -> HiddenAnswer:
    """Hide something, measure, diagnose, and tell the truth; write everything into `output`.

    Args:
        output: folder of the results. seed: of what is hidden, and of noise and jitter.
        overwrite: write into a folder that is not empty. console: a rich console for what happens; none: silent.
        progress: open while the diagnosis runs; what it gives, and `workers`, as in `calibration.diagnose`.

    Raises:
        InputError: `output` is not empty and `overwrite` is not set.
    """
    import calibration

    began, output = time.perf_counter(), Path(output)
    if output.exists() and (not output.is_dir() or any(output.iterdir())) and not overwrite:
        raise ts.InputError("the folder is not empty; name another one or add --overwrite", file=output)
    say = console.print if console else lambda *_, **__: None
    hidden, models = draw_hidden(seed), plain_models()
    say("1 measuring a virtual specimen in which something may be hidden ...")
    random = np.random.default_rng([seed, 1])
    for test, model in models.items():
        write_measured(hidden.within(test, model), test, output / "measured", random)
    campaign = output / "campaign.toml"
    write_text(campaign, CAMPAIGN)
    say(f"2 diagnosing: what does a plain model miss, and which of {len(CATALOGUE)} effects is it? ...")
    with progress or nullcontext() as told:
        (result,) = calibration.diagnose([campaign], output / "diagnosis", overwrite=overwrite, progress=told,
                                         workers=workers)
    diagnosis, report = result.diagnosis, result.output / "report.html"
    figure = output / "before_and_after.png"
    draw_before_and_after(result, figure)
    say(f"\n{diagnosis.message}", markup=False, soft_wrap=True)
    found, sentence = judge_answer(hidden, diagnosis)
    truth = hidden.in_words(models)
    say(f"{'gap':>10}: {diagnosis.gap_before_N:.2g} N before, "
        + ("nothing was added" if diagnosis.gap_after_N is None else f"{diagnosis.gap_after_N:.2g} N after")
        + f"; sensor noise {diagnosis.noise_N:.2g} N", markup=False, soft_wrap=True)
    for name, path in (("figure", figure), ("report", report)):
        say(f"{name:>10}: {path}", markup=False, soft_wrap=True)
    say(f"\n3 the truth (seed {seed}): {truth} was hidden.\n  {sentence}", markup=False, soft_wrap=True)
    return HiddenAnswer(result, hidden, truth, found, sentence, figure, report, campaign, seed,
                        time.perf_counter() - began)


def write_measured(model: ts.Model, test: str, folder: Path, random: np.random.Generator) -> Sequence[Path]:
    """Recordings of a model, each with its own noise, point of contact and zero, written as files."""
    from scipy.interpolate import PchipInterpolator

    true = ts.simulate(model, resolution="accurate", estimate_error=False)
    clock = np.linspace(true.time[0], true.time[-1], SAMPLES)
    displacement = np.interp(clock, true.time, true.displacement)
    # Between knots as smooth as the tissue; a corner of the motion is a knot.
    channels = {"time": clock, "displacement": displacement, "force": PchipInterpolator(true.time, true.force)(clock)}
    files = []
    for number in range(1, REPLICATES + 1):
        rig = ts.Rig(contact_offset=random.normal(0.0, CONTACT_JITTER), zero_offset=random.normal(0.0, ZERO_JITTER),
                     force_noise=FORCE_NOISE, seed=int(random.integers(2**31)))
        measured = rig.measure(ts.Recording(channels)).with_metadata(name=f"{test}_{number}", kind=KINDS[test],
                                                                     virtual=True)
        files.append(folder / f"{test}_{number}.csv")
        ts.write_recording(measured, files[-1])
    return files
