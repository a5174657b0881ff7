"""Measured silicones: five compositions in compression, influence of friction, and prediction of tension.

    python -m benchmarks measured_silicones [--json] [--report FOLDER] [--figure FILE] [--part PART ...]

Reads the public recordings that docs/measured_silicones.md names from the folder in TISSUE_SIM_DATA, where they lie in
ecoflex_compression and soro_tensile. Writes one campaign for each fit and runs it; --report keeps all of it.
"""

import csv
import os
import tempfile
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console

import tissue_sim as ts
from benchmarks import ROOT
from benchmarks.measure import about, option_parser, show, table
from calibration import CalibrationResult, calibrate
from calibration.fit.fit import Fit
from tissue_sim.errors import ConvergenceError

#: Radius of a specimen, mm.
RADIUS_MM = 25.0
#: Height of a specimen, mm.
HEIGHT_MM = 30.0
#: Speed, mm/s.
SPEED_MM_S = 1.0 / 6.0
COMPOSITIONS = ("EF10_0T", "EF10_50T", "EF10_100T", "EF30_0T", "EF50_0T")
#: Of the same product, another batch in another laboratory.
TENSION = {"EF10_0T": "Ecoflex 00-10", "EF30_0T": "Ecoflex 00-30", "EF50_0T": "Ecoflex 00-50"}
#: Cross-section of a strip, mm2.
STRIP_AREA = 18.0
#: Gauge length of a strip, mm.
STRIP_LENGTH = 33.0
#: Nominal strain to which a strip is predicted, 1.
STRIP_STRAIN = 1.0
STRETCHES = (1.25, 1.5, 2.0)
#: Laws that can follow the curve nearly; the others have nothing to tell about noise.
LAWS_ESTIMATED = ("reduced_polynomial_2", "reduced_polynomial_3", "mooney_rivlin")
LAWS = ("neo_hooke", "reduced_polynomial_2", "reduced_polynomial_3", "mooney_rivlin", "ogden_1")
WINDOW = 0.3
WINDOWS = (0.14, 0.3, 0.5, 0.6)
#: Largest strain at which the fast mesh converges for all frictions, 1.
FRICTION_WINDOW = 0.14
#: Laws whose parameters this window determines.
FRICTION_LAWS = ("neo_hooke", "reduced_polynomial_2")
#: Of both platens.
FRICTIONS = (0.0, 0.05, 0.1, 0.2, 0.4, 0.7, "bonded")
#: Allowed error of a law, as a fraction of the largest force.
MODEL_ERROR = 0.01
#: Correlation length of this error, as a fraction of the ramp.
MODEL_MEMORY = 1.0 / 3.0
ESTIMATED = "estimated"


@dataclass(frozen=True)
class Study:
    """Campaign on one composition.

    Attributes:
        name: of its files. composition: key of the recordings. window: nominal strain.
        samples: which of A and B. laws, starts: of the fit. friction: of both platens, or ``"bonded"``.
        noise: ``"estimated"`` or ``"stated"`` (the model error above).
        tension: whether the strip is predicted.
    """

    name: str
    composition: str
    window: float = WINDOW
    samples: str = "AB"
    laws: tuple[str, ...] = LAWS
    starts: int = 3
    friction: float | str = 0.0
    noise: str = "stated"
    tension: bool = False

    def write(self, folder: Path, data: Path) -> Path:
        """Write the campaign file."""
        recordings = data / "ecoflex_compression"
        text = [f'[[specimen]]\nname = "cylinder"\nradius_mm = {RADIUS_MM}\nheight_mm = {HEIGHT_MM}']
        if self.friction == "bonded":
            kind = 'kind = "bonded_compression"'
        elif self.friction:
            kind = f'kind = "friction_compression"\nfriction = {self.friction}\nfriction_base = {self.friction}'
        else:
            kind = 'kind = "lubricated_compression"'
        for sample in self.samples:
            files = (recordings / f"{self.composition}_{sample}*.csv").as_posix()
            text.append(f'[[test]]\nname = "{sample}"\nspecimen = "cylinder"\n{kind}\nrecordings = ["{files}"]\n'
                        f'format = "instron"\nmax_strain = {self.window}')
        if self.tension:
            file = (data / "soro_tensile" / f"{TENSION[self.composition]}.csv").as_posix()
            text.append(f'[[specimen]]\nname = "strip"\nshape = "prism"\narea_mm2 = {STRIP_AREA}\n'
                        f'height_mm = {STRIP_LENGTH}')
            text.append(f'[[test]]\nname = "tension"\nspecimen = "strip"\nkind = "uniaxial_tension"\nhold_out = true\n'
                        f'recordings = ["{file}"]\nformat = "soft_robotics"\nmax_strain = {STRIP_STRAIN}')
        laws = ", ".join(f'"{law}"' for law in self.laws)
        text.append(f'[fit]\nmethod = "inverse_fem"\nlaws = [{laws}]\nbulk_ratio = 10000.0\nstarts = {self.starts}')
        text.append("[noise]\n" + "\n".join(f"{key} = {value}" for key, value in self._noise(recordings).items()))
        path = folder / f"{self.name}.toml"
        path.write_text("\n\n".join(text) + "\n", encoding="utf-8")
        return path

    def _noise(self, recordings: Path) -> dict[str, float]:
        largest = float(np.mean(np.concatenate(list(forces(recordings, self.composition, self.window).values()))))
        found: dict[str, float] = {}
        if self.noise != ESTIMATED:
            ramp = self.window * HEIGHT_MM / SPEED_MM_S
            found |= {"force_N": float(f"{MODEL_ERROR * largest:.2g}"),
                      "correlation_time_s": float(f"{MODEL_MEMORY * ramp:.2g}")}
        return found


def forces(recordings: Path, composition: str, window: float) -> dict[str, list[float]]:
    """Return the force of each recording at the end of the window, N, by sample."""
    found: dict[str, list[float]] = {"A": [], "B": []}
    for file in sorted(recordings.glob(f"{composition}_*.csv")):
        own, = ts.read_recordings(file, format="instron", kind="lubricated_compression")
        found[file.stem.split("_")[-1][0]].append(
            float(np.interp(window * HEIGHT_MM * 1e-3, own.displacement, own.force)))
    return found


def run(study: Study, folder: Path, data: Path, *, figures: bool) -> dict:
    """Calibrate one study; return one entry for each law, the best first, and the cost."""
    started = time.process_time()
    try:
        result, = calibrate([study.write(folder, data)], folder / "results" / study.name, figures=figures)
    except ConvergenceError as error:
        return {"study": study.name, "laws": [], "message": str(error), "cpu_s": time.process_time() - started}
    return {"study": study.name, "composition": study.composition, "window": study.window, "samples": study.samples,
            "friction": study.friction, "noise": study.noise, "message": result.message,
            "samples_in_fit": sum(1 for _ in residuals(result, result.fits[0].law, "AB")),
            "laws": [entry(result, fit) for fit in result.fits], "cpu_s": time.process_time() - started}


def entry(result: CalibrationResult, fit: Fit) -> dict:
    """Return the result of one law of a study."""
    predictions = {p.test: {"RMSE_N": p.RMSE_N, "RMSE_Pa": p.RMSE_Pa, "percent": p.percent, "expected_N": p.expected_N}
                   for p in result.predictions if p.law == fit.law}
    return {
        "law": fit.law, "status": fit.status, "parameters": dict(fit.parameters), "intervals95": dict(fit.intervals95),
        "standard_errors": dict(fit.standard_errors), "E0_Pa": fit.E0, "RMSE_N": fit.RMSE_N, "R2": fit.R2,
        "noise_ratio": fit.noise_ratio, "BIC": fit.BIC, "predictions": predictions, "warnings": list(fit.warnings),
        "not_identifiable": list(fit.not_identifiable), "cpu_s": fit.cpu_s, "fem_solves": fit.fem_solves,
        "contact_jitter_mm": fit.jitter.contact_mm, "zero_jitter_N": fit.jitter.zero_N,
        "largest_offset_mm": max((abs(n.contact_offset_mm) for n in fit.nuisances), default=0.0),
        "largest_zero_N": max((abs(n.zero_offset_N) for n in fit.nuisances), default=0.0),
        "misfit": {f"{r.test} {r.segment}": [r.misfit_N, r.p] for r in fit.regions},
        "tension": tension(result, fit.law)}


def residuals(result: CalibrationResult, law: str, tests: Iterable[str]) -> Iterable[dict[str, str]]:
    """Read the rows of residuals.csv of one law and some tests, column -> cell."""
    with (result.output / "residuals.csv").open(encoding="utf-8", newline="") as table:
        for row in csv.DictReader(table):
            if row["law"] == law and row["replicate"].partition("/")[0] in tests:
                yield row


def tension(result: CalibrationResult, law: str) -> dict[str, list[float]]:
    """Return measured and predicted nominal stress of the strip over stretch, Pa; empty if not part of the study."""
    columns = ("displacement [mm]", "measured [N]", "model [N]")
    rows = [[float(row[column]) for column in columns] for row in residuals(result, law, ["tension"])]
    if not rows:
        return {}
    displacement, measured, model = np.array(rows).T
    return {"stretch": (1.0 + displacement / STRIP_LENGTH).tolist(),
            "measured": (measured / (STRIP_AREA * 1e-6)).tolist(), "model": (model / (STRIP_AREA * 1e-6)).tolist()}


def studies() -> dict[str, list[Study]]:
    """Return the studies of each part of the benchmark."""
    subsets = [(name, samples) for name in COMPOSITIONS for samples in ("AB", "A", "B")]
    stated = [Study(f"{name}_{samples}", name, samples=samples, tension=samples == "AB" and name in TENSION)
              for name, samples in subsets]
    estimated = [Study(f"{name}_{samples}_{ESTIMATED}", name, samples=samples, laws=LAWS_ESTIMATED, noise=ESTIMATED)
                 for name, samples in subsets]
    of_windows = [Study(f"window_{window}_{noise}", "EF10_0T", window, starts=1, noise=noise,
                        tension=noise != ESTIMATED) for noise in (ESTIMATED, "stated") for window in WINDOWS]
    of_frictions = [Study(f"friction_{friction}", "EF10_0T", FRICTION_WINDOW, laws=FRICTION_LAWS, starts=1,
                          friction=friction) for friction in FRICTIONS]
    return {"stated": stated, "estimated": estimated, "windows": of_windows, "friction": of_frictions}


def draw(result: dict, console: Console) -> None:
    """Print the result as tables."""
    drawings = {"stated": draw_samples, "estimated": draw_samples, "windows": draw_windows, "friction": draw_friction}
    draw_scatter(result["scatter"], console)
    for part, found in result["parts"].items():
        drawings[part](found, console)


def draw_scatter(scatter: dict[str, dict[str, list[float]]], console: Console) -> None:
    rows = []
    for composition, found in scatter.items():
        own = {sample: np.array(values) for sample, values in found.items()}
        middle = float(np.mean([values.mean() for values in own.values()]))
        rows.append([composition, *(f"{values.mean():.3g}" for values in own.values()),
                     *(number(100 * float(np.ptp(values)) / middle, 1) for values in own.values()),
                     number(100 * float(own["B"].mean() - own["A"].mean()) / middle, 1)])
    table(console, f"Force at strain {WINDOW}", ["composition", "A (N)", "B (N)", "range of A %", "range of B %",
                                                 "B - A %"], rows)


def draw_samples(found: list[dict], console: Console) -> None:
    rows, predicted = [], []
    for together, *alone in (found[i:i + 3] for i in range(0, len(found), 3)):
        for law in sorted(together["laws"], key=lambda own: LAWS.index(own["law"])):
            low, high = law["intervals95"][next(iter(law["parameters"]))] or (np.nan, np.nan)
            own = [next((each for each in one["laws"] if each["law"] == law["law"]), None) for one in alone]
            cross = [law["predictions"].get(test, {}) for test in "AB"]
            rows.append([f"{together['composition']} {law['law']}",
                         " ".join(f"{value:.5g}" for value in law["parameters"].values()), f"{low:.0f}..{high:.0f}",
                         number(law["E0_Pa"] / 1e3, 1), *("" if each is None else number(each["E0_Pa"] / 1e3, 1)
                                                          for each in own),
                         *(number(each["percent"], 1) for each in cross),
                         *(number(each["RMSE_N"] and each["RMSE_N"] / each["expected_N"], 1) for each in cross),
                         number(law["RMSE_N"], 2), number(law["noise_ratio"], 1), number(law["cpu_s"], 1)])
            if law["tension"]:
                whole, strip = law["predictions"]["tension"], law["tension"]
                ratios = [np.interp(at, strip["stretch"], strip["model"]) / np.interp(
                    at, strip["stretch"], strip["measured"]) for at in STRETCHES]
                predicted.append([f"{together['composition']} {law['law']}", number(whole["RMSE_N"], 3),
                                  number(None if whole["RMSE_Pa"] is None else whole["RMSE_Pa"] / 1e3, 1),
                                  number(whole["percent"], 0), *(number(ratio, 2) for ratio in ratios)])
    table(console, f"Strain to {WINDOW}, frictionless platens, A and B together; noise {found[0]['noise']}",
          ["law", "parameters (Pa)", "95 % of the first", "E0 (kPa)", "A alone", "B alone", "A from B %", "B from A %",
           "/expected", "/expected", "RMSE (N)", "/noise", "CPU s"], rows)
    if predicted:
        table(console, f"Tension to stretch {1 + STRIP_STRAIN:g}, predicted from compression",
              ["law", "RMSE (N)", "(kPa)", "%", *(f"model/data at {stretch:g}" for stretch in STRETCHES)], predicted)


def draw_windows(found: list[dict], console: Console) -> None:
    rows = []
    for one in found:
        for law in LAWS:
            own = next((each for each in one["laws"] if each["law"] == law), None)
            rows.append([f"{one['study']} {law}", *(["not simulated"] + [""] * 8 if own is None else [
                own["status"], number(own["E0_Pa"] / 1e3, 2), number(own["RMSE_N"], 2), number(own["noise_ratio"], 2),
                number(own["contact_jitter_mm"], 3), number(own["largest_offset_mm"], 2),
                number(own["predictions"]["A"]["percent"], 1), number(own["predictions"]["B"]["percent"], 1),
                number(own["cpu_s"], 1)])])
    table(console, "EF10_0T: windows of strain, noise estimated or model error stated",
          ["law", "status", "E0 (kPa)", "RMSE (N)", "residual/noise", "contact jitter (mm)", "largest offset (mm)",
           "A from B %", "B from A %", "CPU s"], rows)


def draw_friction(found: list[dict], console: Console) -> None:
    rows = []
    for law in FRICTION_LAWS:
        entries = [(one, next((each for each in one["laws"] if each["law"] == law), None)) for one in found]
        least = min((own["BIC"] for _, own in entries if own is not None), default=0.0)
        for one, own in entries:
            if own is None:
                rows.append([f"{law}, {one['study']}", "not simulated", *[""] * 9])
                continue
            values = list(own["parameters"].values())
            seen = [region for region, (_, p) in own["misfit"].items() if p <= 0.05]
            low, high = own["intervals95"]["C10"]
            rows.append([f"{law}, {one['friction']}", number(values[0] / 1e3, 2), f"{low / 1e3:.2f}..{high / 1e3:.2f}",
                         number(values[1] / 1e3, 2) if len(values) > 1 else "", number(own["E0_Pa"] / 1e3, 1),
                         number(own["RMSE_N"], 3), number(own["BIC"] - least, 0),
                         f"{len(seen)} of {len(own['misfit'])}",
                         number(own["predictions"]["A"]["percent"], 1), number(own["predictions"]["B"]["percent"], 1),
                         number(one["cpu_s"], 1)])
    table(console, f"EF10_0T to strain {FRICTION_WINDOW}: friction of both platens",
          ["law, friction", "C10 (kPa)", "95 %", "C20 (kPa)", "E0 (kPa)", "RMSE (N)", "BIC - least",
           "misfits", "A from B %", "B from A %", "CPU s"], rows)


def number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def picture(result: dict, data: Path, file: Path) -> None:
    """Draw the recordings of EF10_0T, C10 over friction, and the prediction of tension."""
    import matplotlib.pyplot as plt

    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(13, 4), layout="constrained")
    for path in sorted((data / "ecoflex_compression").glob("EF10_0T_*.csv")):
        own, = ts.read_recordings(path, format="instron", kind="lubricated_compression")
        inside = own.displacement > 0.5e-3
        stretch = 1.0 - own.displacement[inside] / (HEIGHT_MM * 1e-3)
        reduced = own.force[inside] / (2 * np.pi * (RADIUS_MM * 1e-3)**2 * (stretch**-2 - stretch))
        sample = path.stem.split("_")[-1]
        left.plot(1.0 - stretch, reduced / 1e3, color="C0" if sample[0] == "A" else "C1", linewidth=0.8,
                  label=f"sample {sample[0]}" if sample[1] == "1" else None)
    for window in WINDOWS:
        left.axvline(window, color="0.8", linewidth=0.8, zorder=0)
    left.set(xlabel="nominal strain", ylabel="P / 2(λ⁻² - λ) (kPa)", title="EF10_0T, frictionless: Neo-Hooke is flat")
    left.legend()
    for place, law in enumerate(FRICTION_LAWS):
        found = [own for one in result["parts"]["friction"] for own in one["laws"] if own["law"] == law]
        C10 = np.array([own["parameters"]["C10"] for own in found]) / 1e3
        ends = np.array([own["intervals95"]["C10"] for own in found]).T / 1e3
        middle.errorbar(np.arange(C10.size) + 0.1 * place, C10, abs(ends - C10), fmt="o", capsize=3, label=law)
    middle.set_xticks(range(len(FRICTIONS)), [str(value) for value in FRICTIONS])
    middle.set(xlabel="friction of the platens", ylabel="C10 (kPa)", ylim=(0, None),
               title=f"C10 from the same data, to strain {FRICTION_WINDOW}")
    middle.legend()
    together = result["parts"]["stated"][0]["laws"]
    for law in LAWS:
        strip = next(own["tension"] for own in together if own["law"] == law)
        if law == LAWS[0]:
            right.plot(strip["stretch"], np.array(strip["measured"]) / 1e3, "k", linewidth=2, label="measured")
        right.plot(strip["stretch"], np.array(strip["model"]) / 1e3, label=law)
    right.set(xlabel="stretch", ylabel="nominal stress (kPa)", ylim=(0, 45), title="Ecoflex 00-10 in tension")
    right.legend()
    figure.savefig(file, dpi=110)


def main() -> None:
    parser = option_parser(__doc__)
    parser.add_argument("--report", type=Path, metavar="FOLDER", help="new folder that keeps campaigns and reports")
    parser.add_argument("--figure", type=Path, metavar="FILE", help="draw it; needs the parts stated and friction")
    parser.add_argument("--part", choices=list(studies()), action="append", help="only this part (may be repeated)")
    arguments = parser.parse_args()
    data = Path(os.environ.get("TISSUE_SIM_DATA", ROOT.parent / "shared" / "data"))
    if not (data / "ecoflex_compression").is_dir():
        raise SystemExit(f"no measured data in {data}; set TISSUE_SIM_DATA to the folder that holds "
                         "ecoflex_compression and soro_tensile")
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.report or Path(temporary)
        if arguments.report:
            arguments.report.mkdir(parents=True)
        parts = {part: [run(study, folder, data, figures=arguments.report is not None) for study in own]
                 for part, own in studies().items() if part in (arguments.part or studies())}
    result = about("measured_silicones") | {"parts": parts, "scatter": {
        name: forces(data / "ecoflex_compression", name, WINDOW) for name in COMPOSITIONS}}
    if arguments.figure:
        picture(result, data, arguments.figure)
    show(result, draw, as_json=arguments.json)


if __name__ == "__main__":
    main()
