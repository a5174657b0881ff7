"""Hide a random effect in a virtual specimen or rig, measure, diagnose, and judge whether the effect was found."""

from __future__ import annotations

import textwrap
import time
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import tissue_sim as ts
from calibration.diagnosis.diagnosis import (
    Diagnosis,
    EffectParameter,
    describe_effect,
    describe_parameter,
    join_as_enumeration,
)
from calibration.effects.effect import CATALOGUE
from scenes.demo.specimen import BULK_RATIO, PHANTOM, SPECIMEN, VirtualReplicateAndErrorSettings
from scenes.figures import write_figure_file
from tissue_sim.experiment.contact_law import AS_TOOL
from tissue_sim.files import write_text
from tissue_sim.parameters import parameters

if TYPE_CHECKING:
    from calibration import DiagnosisResult, Workers
    from calibration.fit.run_context import Progress

#: Name of the compression test between lubricated plates.
PLATES = "plates"
#: Name of the needle test.
NEEDLE = "needle"


@dataclass(frozen=True)
class HiddenEffect:
    """Effect that is hidden in a virtual experiment, or no effect.

    Attributes:
        name: name of the effect in the catalogue; empty: no effect is hidden.
        values: path in the model -> value of each parameter of the effect, SI units.
        tests: names of the tests that contain the effect.
    """

    name: str = ""
    values: Mapping[str, float] = field(default_factory=dict)
    tests: tuple[str, ...] = ()

    def add_effect_to_test_model(self, test: str, model: ts.Model) -> ts.Model:
        """Return the model of a test with the effect, or the unchanged model if the test does not contain the effect.

        Args:
            test: name of the test.
            model: model of the test without the effect.
        """
        return make_model_with_effect(self.name, self.values, model) if test in self.tests else model

    def describe_with_values(self, models: Mapping[str, ts.Model]) -> str:
        """Return title and values of the effect, such as ``viscoelasticity (g1 = 0.12, tau1 = 14.1 s)``.

        Args:
            models: test -> model without the effect; used for symbols and units of the parameters.
        """
        if not self.name:
            return "nothing"
        known = {path.removeprefix("material."): each
                 for path, each in parameters(self.add_effect_to_test_model(self.tests[0],
                                                                            models[self.tests[0]])).items()}
        numbers = [describe_parameter(EffectParameter(path=path, symbol=known[path].symbol, value=value,
                                                      unit=known[path].declaration.unit))
                   for path, value in self.values.items()]
        return f"{CATALOGUE[self.name].title} ({', '.join(numbers)})"


def make_model_with_effect(name: str, values: Mapping[str, float], model: ts.Model) -> ts.Model:
    """Return a copy of a model with an effect of the catalogue; friction is applied to both plates.

    Args:
        name: name of the effect in the catalogue.
        values: path in the model -> value of each parameter, SI units.
        model: model without the effect.
    """
    model = CATALOGUE[name]().apply(model, values)
    if "experiment.friction" not in values:
        return model
    return replace(model, experiment=replace(model.experiment, friction_base=AS_TOOL))


@dataclass(frozen=True)
class HideableEffectRange:
    """Effect that the two tests of the demonstration can reveal, with the range of its size.

    Attributes:
        name: name of the effect in the catalogue.
        sizes: path in the model -> lowest and highest value, SI units.
        tests: names of the tests that contain the effect.
    """

    name: str
    sizes: Mapping[str, tuple[float, float]]
    tests: tuple[str, ...] = (PLATES, NEEDLE)

    def draw_random_hidden_effect(self, random: np.random.Generator) -> HiddenEffect:
        """Draw the values of the effect from a log-uniform distribution, rounded to three digits.

        Args:
            random: random number generator.
        """
        values = {path: float(f"{np.exp(random.uniform(*np.log(ends))):.3g}") for path, ends in self.sizes.items()}
        return HiddenEffect(self.name, values, self.tests)


#: Effects that can be hidden.
HIDEABLE_EFFECTS = (
    HideableEffectRange("viscoelasticity",
                        {"viscoelastic.terms[0].g": (0.05, 0.2), "viscoelastic.terms[0].tau": (5.0, 30.0)}),
    HideableEffectRange("softening", {"softening.loss": (0.05, 0.25), "softening.share": (0.7, 1.5)}),
    HideableEffectRange("plate_friction", {"experiment.friction": (0.02, 0.1)}, (PLATES,)),
    HideableEffectRange("machine_compliance", {"rig.compliance": (7e-5, 1.5e-4)}),
    HideableEffectRange("sensor_drift", {"rig.sensor_drift": (3e-4, 1.5e-3)}),
    HideableEffectRange("edge_rounding", {"experiment.tool.edge_radius": (1e-3, 2.5e-3)}, (NEEDLE,)),
    HideableEffectRange("backlash", {"rig.backlash": (5e-5, 2e-4)}))


def choose_hidden_or_no_effect(seed: int) -> HiddenEffect:
    """Draw one of `HIDEABLE_EFFECTS`, or no effect, with equal probability; equal seeds draw the same effect.

    Args:
        seed: seed of the random number generator.
    """
    random = np.random.default_rng(seed)
    number = int(random.integers(len(HIDEABLE_EFFECTS) + 1))
    return HIDEABLE_EFFECTS[number].draw_random_hidden_effect(random) if number < len(HIDEABLE_EFFECTS) \
        else HiddenEffect()


def judge_diagnosis_with_sentence(hidden: HiddenEffect, diagnosis: Diagnosis) -> tuple[bool, str]:
    """Return whether a diagnosis found the hidden effect, and a sentence on it.

    Args:
        hidden: hidden effect, or no effect.
        diagnosis: diagnosis of the virtual measurements.

    Returns:
        Whether the diagnosis is right, and a sentence that states the result.
    """
    named = [each.name for each in diagnosis.effects]
    candidates = [name.partition("@")[0] for name in diagnosis.indistinguishable]
    found = join_as_enumeration([describe_effect(each) for each in diagnosis.effects])
    if not hidden.name:
        right = diagnosis.verdict == "NONE"
        return right, "Nothing was hidden, and nothing was found." if right else \
            f"False alarm: nothing was hidden, and the diagnosis reports {found or 'an unknown effect'}."
    if diagnosis.verdict == "SET" and hidden.name in candidates:
        return True, (f"Found, but not uniquely: it is one of {len(candidates)} effects that these tests cannot "
                      "distinguish.")
    if hidden.name in named:
        others = "" if len(named) == 1 else ", together with an effect that was not hidden"
        confirmation = "" if diagnosis.verdict == "NAMED" else ", its form unconfirmed"
        return len(named) == 1, f"Found{others}{confirmation}: {found}."
    if diagnosis.verdict == "NONE":
        return False, "Missed: the diagnosis reports no effect."
    if diagnosis.verdict == "UNKNOWN":
        return False, ("Partly found: the diagnosis reports that an effect is missing from the model, but does not "
                       "identify it.")
    return False, f"Wrong: the diagnosis reports {found}."


#: Motion of both tests.
PROTOCOL = "ramp 10mm @0.248mm/s; hold 60s; unload"
#: Recordings and errors of the virtual measurements.
MEASUREMENT = VirtualReplicateAndErrorSettings(replicates=3, samples=140, force_noise=0.02, contact_jitter=0.03e-3,
                                               zero_jitter=0.01)
#: Name of each test -> its kind.
KINDS = {PLATES: "lubricated_compression", NEEDLE: "needle_indentation"}
#: Colour of measurements.
MEASURED = "#7F7F7F"
#: Colour of the model without the diagnosed effects.
BEFORE = "#D55E00"
#: Colour of the model with the diagnosed effects.
AFTER = "#0072B2"
#: Number of time bins in which residuals are averaged for the drawing.
_BINS = 40

#: Campaign file of both tests.
CAMPAIGN = f"""# Lubricated compression and needle indentation of a virtual specimen with a possible hidden effect.
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
force_N = {MEASUREMENT.force_noise}
"""


@dataclass(frozen=True)
class HiddenDemoResult:
    """Result of the demonstration with a hidden effect.

    Attributes:
        result: result of the diagnosis.
        hidden: hidden effect.
        truth: description of the hidden effect.
        found: whether the diagnosis found the hidden effect.
        sentence: sentence that states whether it was found.
        figure: path of the picture.
        report: path of the report.
        campaign: path of the campaign file.
        seed: seed of the hidden effect and of the noise.
        wall_s: duration of the demonstration, s.
    """

    result: DiagnosisResult
    hidden: HiddenEffect
    truth: str
    found: bool
    sentence: str
    figure: Path
    report: Path
    campaign: Path
    seed: int
    wall_s: float

    def make_json_object(self) -> dict[str, Any]:
        """Return the object for ``--json``: parameters in SI units, gaps in N."""
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


def build_plain_models() -> dict[str, ts.Model]:
    """Return the model of each test without a hidden effect; its protocol has samples at the corners of the motion."""
    material = ts.Material("reduced_polynomial_2", PHANTOM, ts.Bulk("bulk_ratio", BULK_RATIO), name="virtual phantom")
    protocol = ts.Protocol.parse(PROTOCOL, points=41)
    return {test: ts.Model(ts.KINDS[kind].experiment(specimen=SPECIMEN, protocol=protocol), material)
            for test, kind in KINDS.items()}


def run_hidden_demo(output: Path, *, seed: int, overwrite: bool = False, console=None,
                    progress: AbstractContextManager[Progress] | None = None,
                    workers: Workers | None = None) -> HiddenDemoResult:
    """Hide an effect, measure, diagnose, and reveal the hidden effect; write all files into a folder.

    Args:
        output: folder of the results.
        seed: seed of the hidden effect, of the noise and of the jitter.
        overwrite: whether to write into a folder that is not empty.
        console: rich console for the messages; None: no messages.
        progress: context manager that is open during the diagnosis and gives its progress function; None: no progress.
        workers: processes of the diagnosis, see `calibration.diagnose`.

    Returns:
        Result of the diagnosis, hidden effect and paths of the files.

    Raises:
        InputError: `output` is not empty and `overwrite` is False.
    """
    import calibration

    began, output = time.perf_counter(), Path(output)
    if output.exists() and (not output.is_dir() or any(output.iterdir())) and not overwrite:
        raise ts.InputError("the folder must be empty; choose another folder or add --overwrite", file=output)
    say = console.print if console else lambda *_, **__: None
    hidden, models = choose_hidden_or_no_effect(seed), build_plain_models()
    say("1 measuring a virtual specimen with a possible hidden effect ...")
    random = np.random.default_rng([seed, 1])
    for test, model in models.items():
        simulate_and_write_replicates(hidden.add_effect_to_test_model(test, model), test, output / "measured", random)
    campaign = output / "campaign.toml"
    write_text(campaign, CAMPAIGN)
    say(f"2 diagnosing: searching the misfit of the plain model for one of {len(CATALOGUE)} effects ...")
    with progress or nullcontext() as show_progress:
        (result,) = calibration.diagnose([campaign], output / "diagnosis", overwrite=overwrite, progress=show_progress,
                                         workers=workers)
    diagnosis, report = result.diagnosis, result.output / "report.html"
    figure = output / "before_and_after.png"
    write_before_and_after_figure(result, figure)
    say(f"\n{diagnosis.message}", markup=False, soft_wrap=True)
    found, sentence = judge_diagnosis_with_sentence(hidden, diagnosis)
    truth = hidden.describe_with_values(models)
    say(f"{'gap':>10}: {diagnosis.gap_before_N:.2g} N before, "
        + ("nothing was added" if diagnosis.gap_after_N is None else f"{diagnosis.gap_after_N:.2g} N after")
        + f"; sensor noise {diagnosis.noise_N:.2g} N", markup=False, soft_wrap=True)
    for name, path in (("figure", figure), ("report", report)):
        say(f"{name:>10}: {path}", markup=False, soft_wrap=True)
    say(f"\n3 hidden effect (seed {seed}): {truth} was hidden.\n  {sentence}", markup=False, soft_wrap=True)
    return HiddenDemoResult(result, hidden, truth, found, sentence, figure, report, campaign, seed,
                            time.perf_counter() - began)


def simulate_and_write_replicates(model: ts.Model, test: str, folder: Path,
                                  random: np.random.Generator) -> Sequence[Path]:
    """Simulate a test, and write replicates with different noise, contact point and zero.

    Args:
        model: model of the test, with the hidden effect.
        test: name of the test.
        folder: folder of the recordings.
        random: random number generator.

    Returns:
        Paths of the recordings.
    """
    from scipy.interpolate import PchipInterpolator

    true = ts.simulate(model, resolution="accurate", estimate_error=False)
    times = np.linspace(true.time[0], true.time[-1], MEASUREMENT.samples)
    displacement = np.interp(times, true.time, true.displacement)
    # The force is smooth between the points of the protocol; each corner of the motion is such a point.
    channels = {"time": times, "displacement": displacement, "force": PchipInterpolator(true.time, true.force)(times)}
    files = []
    for number in range(1, MEASUREMENT.replicates + 1):
        rig = ts.Rig(contact_offset=random.normal(0.0, MEASUREMENT.contact_jitter),
                     zero_offset=random.normal(0.0, MEASUREMENT.zero_jitter),
                     force_noise=MEASUREMENT.force_noise, seed=int(random.integers(2**31)))
        measured = rig.measure(ts.Recording(channels)).with_metadata(name=f"{test}_{number}", kind=KINDS[test],
                                                                     virtual=True)
        files.append(folder / f"{test}_{number}.csv")
        ts.write_recording(measured, files[-1])
    return files


def write_before_and_after_figure(result: DiagnosisResult, path: Path) -> None:
    """Draw force and residuals of every test over time into an image file.

    Args:
        result: result of `calibration.diagnose`; its ``residuals.csv`` contains every sample.
        path: path of the image file.
    """
    from matplotlib.figure import Figure

    table = np.genfromtxt(result.output / "residuals.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    diagnosis = result.diagnosis
    tests = list(dict.fromkeys(region.test for region in diagnosis.regions))
    figure = Figure(figsize=(6.2 * len(tests), 7.0), layout="constrained")
    axes = figure.subplots(2, len(tests), squeeze=False, sharex="col", height_ratios=(1.25, 1.0))
    added = " and ".join(effect.title for effect in diagnosis.effects)
    models = [("model_before_N", "plain model", BEFORE, "--")]
    if diagnosis.effects:
        models.append(("model_after_N", f"model with {added}", AFTER, "-"))
    for (force, residual), test in zip(axes.T, tests, strict=True):
        rows_of_test = table[np.char.startswith(table["replicate"], f"{test}/")]
        recordings = [rows_of_test[rows_of_test["replicate"] == name]
                      for name in dict.fromkeys(rows_of_test["replicate"])]
        for number, rows in enumerate(recordings):
            force.plot(rows["time_s"], rows["measured_N"], ".", color=MEASURED, ms=3.5, alpha=0.7,
                       label=None if number else f"measured, {len(recordings)} recordings")
        noise = float(np.mean(rows_of_test["noise_N"]))
        residual.axhspan(-noise, noise, color=MEASURED, alpha=0.2, lw=0, label="± noise of a sample")
        for column, label, colour, dashes in models:
            first = recordings[0]
            force.plot(first["time_s"], first[column], color=colour, ls=dashes, lw=1.8, label=label)
            misfit = rows_of_test["measured_N"] - rows_of_test[column]
            residual.plot(*_average_in_time_bins(rows_of_test["time_s"], misfit), color=colour, ls=dashes, lw=1.8)
        force.set_title(test, loc="left", fontweight="bold")
        force.set_ylabel("force [N]")
        residual.set(xlabel="time [s]", ylabel="data − model [N]")
        residual.axhline(0.0, color="0.3", lw=0.8)
        largest = max(abs(limit) for limit in residual.get_ylim())
        residual.set_ylim(-1.1 * largest, 1.4 * largest)
        for each in (force, residual):
            each.grid(alpha=0.3)
            each.spines[["top", "right"]].set_visible(False)
        force.legend(frameon=False, fontsize=9)
        residual.legend(frameon=False, fontsize=9, loc="upper right")
    sentences = diagnosis.message.replace(". ", ".\n").splitlines()
    figure.suptitle("\n".join(line for each in sentences for line in textwrap.wrap(each, 62 * len(tests))),
                    fontsize=11)
    write_figure_file(figure, path)


def _average_in_time_bins(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Average samples of all recordings in equal time bins.

    Args:
        time: s, shape (n,).
        values: values to average, shape (n,).

    Returns:
        Centres of the bins, s, and mean values, each of shape (_BINS,). The mean of an empty bin is 0.
    """
    edges = np.linspace(time.min(), time.max(), _BINS + 1)
    bin_number = np.clip(np.searchsorted(edges, time, side="right") - 1, 0, _BINS - 1)
    count = np.maximum(np.bincount(bin_number, minlength=_BINS), 1)
    return 0.5 * (edges[1:] + edges[:-1]), np.bincount(bin_number, values, minlength=_BINS) / count
